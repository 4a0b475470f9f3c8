"""The discs that a person's surface is made of: wide enough to close it, and flat."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.model.blendshapes import TangentBlendshapes
from rgbavatar_ns.avatar.prior.mesh_field import MeshField, ramp
from rgbavatar_ns.head.rotations import turn_back

_FLATNESS = math.log(0.25)
"""Logarithm of thickness over width."""
_OVERLAP = math.log(1.4)
"""Logarithm of how much wider discs are than fresh Gaussians where nothing is seen."""
_AT_SEAMS = math.log(1.5)
"""And along a row of texels that ends, at the back: the next is up to two texels away."""
_MOST_SPREAD = math.log(2)
_THICKEST, LONGEST = 1.5, 2.5
"""Of a disc's width: what is seen from the front alone is no thicker along its normal, and no
longer along the view."""
_FRONT, _SIDE = 0.3, 0.7
"""Sideways parts of normals: up to the first a surface faces front, above or below, and from the
second it is a side."""
_NO_THICKNESS = 1e-30
"""Square metres; and where there is no normal."""


def disc_log_scale(avatar: Avatar) -> Float[Tensor, "N 3"]:
    """The logarithms of the scales, in metres, that a Gaussian of the surface has.

    Where texels lie farther apart than fresh ones reach, they are as wide as it takes.
    """
    width_m = avatar.initial_scale_m().maximum(0.5 * avatar.anchors.texel_spacing())
    log_scale = width_m.log()[:, None].repeat(1, 3)
    log_scale[:, :2] += avatar.anchors.texel_stretch().log()
    log_scale[:, 2] += _FLATNESS
    return log_scale


def log_overlap(
    avatar: Avatar, field: MeshField, surface_m: Float[Tensor, "V"]
) -> Float[Tensor, "N 2"]:
    """Logarithms of how much wider discs are, along u and v, where nothing else closes the surface.

    A surface that stands `surface_m` off the mesh is larger than it: hair is wider than a skull.
    """
    surface_m = surface_m.clamp(min=0)  # below it, only folds gape
    first, second = field.edges.unbind(1)
    on_mesh, off_mesh = (
        (places[first] - places[second]).norm(dim=1).clamp(min=1e-6).log()
        for places in (field.rest_m, field.rest_m + surface_m[:, None] * field.normals)
    )
    spread = field.mean_around(off_mesh - on_mesh).clamp(0, _MOST_SPREAD)
    wider = _OVERLAP + field.at_gaussians(spread[:, None])
    return wider + _AT_SEAMS * (_row_ends(avatar) * field.at_gaussians(field.back[:, None]))


def _row_ends(avatar: Avatar) -> Float[Tensor, "N 2"]:
    """1 where a texel has no neighbour on one side, along u and along v."""
    row, column = avatar.anchors.texel_row_col.long().unbind(1)
    size = avatar.anchors.resolution
    used = torch.zeros(size + 2, size + 2, dtype=torch.bool, device=row.device)
    used[row + 1, column + 1] = True
    along_u = used[row + 1, column] & used[row + 1, column + 2]
    along_v = used[row, column + 1] & used[row + 2, column + 1]
    return (~torch.stack([along_u, along_v], 1)).to(avatar.identity)


def flatten(
    shapes: TangentBlendshapes,
    normals: Float[Tensor, "N 3"],
    disc: Float[Tensor, "N 3"],
    share: Float[Tensor, "N"],
    widths: float = _THICKEST,
) -> None:
    """Go by a share to the most thickness along normals that is left to those with such discs.

    Unit normals, or other directions, in the axes that rotations are in; `disc` holds logarithms
    of scales, and so many widths of it are left. Each axis is
    shortened as far as it makes up the thickness. Ours, because from the front a needle along the
    view is a point, and a film that is all front leaves it be: from the side profiles bristled.
    """
    along = turn_back(F.normalize(shapes.rotation_wxyz, dim=-1), normals)
    parts = along.square() * (2 * shapes.log_scale).exp()
    squared = parts.sum(1).clamp(min=_NO_THICKNESS)
    thickest = math.log(widths) + disc[:, :2].mean(1)
    excess = (0.5 * squared.log() - thickest).clamp(min=0) * share
    shapes.log_scale.sub_(excess[:, None] * parts / squared[:, None])


def narrow_ahead(field: MeshField) -> Float[Tensor, "N"]:
    """1 where Gaussians need not reach along the view of a film that is all front.

    Lips, nose and brows bristle, also below, which faces no camera. But sides, which the film
    hardly shows, are closed by what reaches along them, and bodies do not turn with the head.
    """
    sideways = field.at_gaussians(field.normals)[:, 0].abs()
    front = ramp(sideways, _SIDE, _FRONT)
    return front * (~field.body_gaussians).to(front)
