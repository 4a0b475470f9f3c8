"""ARKit's expressions for a head without ARKit's names, such as FLAME: fitted to the same face."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rgbavatar_ns.head.arrays import HeadArrays
from rgbavatar_ns.head.expression_bases import DIRECTION_PRIOR_M
from rgbavatar_ns.head.layout import ThetaLayout
from rgbavatar_ns.head.model import HeadModel
from rgbavatar_ns.head.registration import register
from rgbavatar_ns.head.skin_surface import SkinSurface, skin_points

_STEPS = 12
"""With the slopes at rest: the jaw's turn is the one thing here that is not linear, and each step
leaves less than half of what it has misjudged."""
_SLOPE_STEP = 1e-5
_STILL_M = 1e-3
"""What moves all points together by less has nothing to follow: the eyes' turns, the tongue."""
_JAW_PRIOR_M = 0.002
"""`DIRECTION_PRIOR_M` for a radian of the jaw, which costs no more than it explains."""


def fitted_table(
    arrays: HeadArrays, layout: ThetaLayout, embedded_table: Float[np.ndarray, "52 G"]
) -> tuple[Float[np.ndarray, "52 H"], Float[np.ndarray, "52"]]:
    """Theta of each ARKit expression at 1, and the share of its motion that is left over.

    The embedded head, which has ARKit's expressions, is laid over the other one (`register`); each
    of its expressions moves the points of the face, and the other head's expression, eyelids and
    jaw are found that move the same points alike (least squares with a prior). Gaze stays 0.
    embedded_table: theta of the embedded head for the same expressions.
    Source: ours. Raises UserError for a head on which no face is found.
    """
    embedded = HeadArrays.embedded()
    registration = register(arrays)
    face = registration.face_vertices
    places = SkinSurface(arrays).nearest(skin_points(embedded, registration.placed).select(face))
    wanted = (
        _motions(embedded, embedded_table, face)
        @ (registration.pose.scale * registration.pose.turn).T
    )
    head = HeadModel(arrays, dtype=torch.float64)
    corners = torch.from_numpy(arrays.faces[places.triangle].astype(np.int64))
    barycentric = torch.from_numpy(places.barycentric)
    free = _free_columns(layout)
    prior_m = np.full(len(free), DIRECTION_PRIOR_M)
    jaw = layout.slice("jaw")
    prior_m[(free >= jaw.start) & (free < jaw.stop)] = _JAW_PRIOR_M

    def points(entries: Float[Tensor, "B C"]) -> Float[Tensor, "B P 3"]:
        theta = entries.new_zeros(len(entries), layout.size)
        theta[:, free] = entries
        return torch.einsum("pk,bpkx->bpx", barycentric, head(theta)[:, corners])

    nothing = torch.zeros(1, len(free), dtype=torch.float64)
    at_rest = points(nothing)
    slopes = (points(_SLOPE_STEP * torch.eye(len(free), dtype=torch.float64)) - at_rest).flatten(1)
    slopes = slopes.T / _SLOPE_STEP
    prior = torch.from_numpy(prior_m**2)
    normal = slopes.T @ slopes + torch.diag(prior)
    target = at_rest + torch.from_numpy(wanted)
    entries = nothing.repeat(len(wanted), 1)
    for _ in range(_STEPS):
        left = (target - points(entries)).flatten(1)
        entries = entries + torch.linalg.solve(normal, (left @ slopes - prior * entries).T).T
    table = np.zeros((len(wanted), layout.size))
    table[:, free] = entries.numpy()
    size = np.linalg.norm(wanted.reshape(len(wanted), -1), axis=1)
    left_over = (target - points(entries)).flatten(1).norm(dim=1).numpy()
    return table, np.divide(left_over, size, out=np.ones_like(size), where=size > _STILL_M)


def _motions(
    embedded: HeadArrays, table: Float[np.ndarray, "52 G"], face: Int[np.ndarray, "P"]
) -> Float[np.ndarray, "52 P 3"]:
    """How each expression at 1 moves the embedded head's face, metres."""
    head, theta = HeadModel(embedded, dtype=torch.float64), torch.from_numpy(table)
    return (head(theta) - head(torch.zeros_like(theta[:1])))[:, face].numpy()


def _free_columns(layout: ThetaLayout) -> Int[np.ndarray, "C"]:
    """Expression, eyelids and jaw."""
    names = [name for name in ("expression", "eyelids", "jaw") if name in layout]
    return np.concatenate([np.arange(layout.size)[layout.slice(name)] for name in names])
