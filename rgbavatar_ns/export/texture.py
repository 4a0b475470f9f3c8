"""The avatar's colours at rest as a picture in the head's UV layout, and painted ones put back."""

import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.model.blendshapes import COLOR_SCALE
from rgbavatar_ns.data.png import encode_png_rgba, png_size, read_png_rgba
from rgbavatar_ns.drawing.wireframe import fixed_point
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.unfolding import unfolded, unfolded_view
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize
from rgbavatar_ns.kernels.functional import weighted_color_average

PIXELS_PER_TEXEL = 4
"""Of a texture's side unless told otherwise: Gaussians get as narrow as a fifth of a texel."""
LARGEST_SIDE_PX = 4096
"""A picture of it and what is made of it on the way take a gigabyte."""
_SMALLEST_SIDE_PX = 16
_LEAST_ALPHA = 0.05
"""Where the Gaussians cover less, a pixel shows none of them."""
_SAME_LEVELS = 1.5
"""Of 255: a level up or down comes from other programs' rounding and counts as not painted."""
_NEAR_PX = 2 * PIXELS_PER_TEXEL + 1
"""Two texels: with five pixels painted checks lose .2 dB, with seventeen they gain .1 dB."""
_STEPS = 10
"""Of fitting: painted checks of four texels gain 1.3 dB from ten, and nothing from ten more."""


@dataclass(frozen=True)
class _Unfolded:
    """The head at rest, drawn flat: a picture linear in the Gaussians' colours."""

    gaussians: GaussianSet
    camera: PinholeCameras

    @classmethod
    def of(cls, avatar: Avatar, side_px: int) -> "_Unfolded":
        return cls(unfolded(avatar), unfolded_view(side_px, avatar.identity))

    @cached_property
    def alpha(self) -> Float[Tensor, "R R 1"]:
        return rasterize(self.gaussians, self.camera).alpha[0].reshape(*self._size, 1)

    @property
    def _size(self) -> tuple[int, int]:
        return self.camera.height, self.camera.width

    @property
    def covered(self) -> Bool[Tensor, "R R 1"]:
        return self.alpha >= _LEAST_ALPHA

    def mean(self, colors: Float[Tensor, "N 3"]) -> Float[Tensor, "R R 3"]:
        """What each pixel shows of these colours, as if nothing lay behind them."""
        drawn = rasterize(replace(self.gaussians, colors=colors[None]), self.camera).image[0]
        return drawn / self.alpha.clamp(min=_LEAST_ALPHA)

    def pulled(self, picture: Float[Tensor, "R R 3"]) -> tuple[Tensor, Tensor]:
        """The mean of a picture over what is seen of each Gaussian, and how much that is [N 1]."""
        found = weighted_color_average(self.gaussians, self.camera, picture[None].contiguous())
        weight = found.weight_sum.reshape(-1, 1)
        return found.weighted_sum.reshape(-1, 3) / weight.clamp(min=_LEAST_ALPHA), weight


@torch.no_grad()
def color_texture(avatar: Avatar, side_px: int | None = None) -> UInt8[np.ndarray, "R R 4"]:
    """Draw what the head at rest looks like, spread out over its UV layout; RGBA, upright.

    Alpha is 255 where Gaussians are seen, else 0; there the nearest seen colour stands, so that
    brushes and filters find no edge. By default with four pixels a texel. Raises UserError
    for a side out of range. Ours: trained Gaussians lie several texels beside the ones that carry
    them, so that a picture by texels would be a scramble.
    """
    side_px = _own_side_px(avatar) if side_px is None else side_px
    if not _SMALLEST_SIDE_PX <= side_px <= LARGEST_SIDE_PX:
        raise UserError(
            f"A texture of {side_px} x {side_px} pixels is out of range.",
            f"Take {_SMALLEST_SIDE_PX} to {LARGEST_SIDE_PX} pixels a side.",
        )
    flat = _Unfolded.of(avatar, side_px)
    shown = flat.mean(flat.gaussians.colors[0]).clamp(0, 1)
    rgb = (shown * 255).round().byte().cpu().numpy()
    covered = flat.covered[..., 0].cpu().numpy()
    # Pinholes between Gaussians are closed, lest a brush that keeps alpha leaves them out.
    hole = max(3, side_px // avatar.anchors.resolution | 1)
    closed = cv2.morphologyEx(
        covered.astype(np.uint8) * 255, cv2.MORPH_CLOSE, np.ones((hole, hole), np.uint8)
    )
    return np.concatenate([_spread(rgb, covered), closed[..., None]], 2)


@torch.no_grad()
def with_texture(avatar: Avatar, painted: UInt8[np.ndarray, "H W 4"]) -> Avatar:
    """Return the avatar in the colours of a painted `color_texture` of its own.

    What differs from the texture of the painted picture's own size is added to the base colours,
    whatever the expression, as far as alpha says. Gaussians more than a texel and a half away from
    paint keep their colours to the bit. Raises UserError for a picture that is not square, or out
    of range.

    Ours: SIRT (as in tomography) fits what was painted as sharply as the Gaussians allow. No colour
    changes more than something painted near it, or the other way: that would fit a little better,
    but paint would have a rim of the opposite colour.
    """
    height, width = painted.shape[:2]
    if height != width:
        raise UserError(
            f"The texture is {width} x {height} pixels.",
            "Paint over a square picture of `rgbavatar export --format texture`.",
        )
    change = _painted_change(painted, color_texture(avatar, width))
    result = copy.deepcopy(avatar)
    if not change.any():
        return result
    side_px = _own_side_px(avatar)
    if side_px != width:
        method = cv2.INTER_AREA if side_px < width else cv2.INTER_LINEAR
        change = cv2.resize(change, (side_px, side_px), interpolation=method)
    flat = _Unfolded.of(avatar, side_px)
    wanted = torch.from_numpy(change).to(avatar.identity) * flat.covered
    added = _fitted(flat, wanted)
    result.blendshapes.color_feature.add_(added / COLOR_SCALE)
    return result


def _own_side_px(avatar: Avatar) -> int:
    """The side of the texture that has room for all that the avatar's Gaussians can show."""
    return min(avatar.anchors.resolution * PIXELS_PER_TEXEL, LARGEST_SIDE_PX)


def _painted_change(
    painted: UInt8[np.ndarray, "R R 4"], own: UInt8[np.ndarray, "R R 4"]
) -> Float[np.ndarray, "R R 3"]:
    """What was painted, as a difference of colours, weighted by the painted alpha."""
    change = painted[..., :3].astype(np.float32) - own[..., :3]
    change[np.abs(change).max(2) <= _SAME_LEVELS] = 0
    return change * (painted[..., 3:].astype(np.float32) / 255**2)


def _fitted(flat: _Unfolded, wanted: Float[Tensor, "R R 3"]) -> Float[Tensor, "N 3"]:
    """Changes of the Gaussians' colours that show as this change of the picture."""
    # In the layout, as grid_sample counts it: -1 to 1.
    places = 2 * flat.gaussians.means[:, None, :, :2]

    def above(picture: Float[Tensor, "R R 3"]) -> Float[Tensor, "N 3"]:
        planes = picture.movedim(-1, 0)[None]
        found = F.grid_sample(planes, places, padding_mode="border", align_corners=False)
        return found[0, :, 0].T

    darkest, lightest = (above(end) for end in _ends_nearby(wanted))
    pulled, seen = flat.pulled(wanted)
    # Gaussians that nothing is seen of at rest take the colour above their place.
    added = torch.where(seen < _LEAST_ALPHA, above(wanted), pulled)
    for _ in range(_STEPS):
        added = added.maximum(darkest).minimum(lightest)
        lacking = (wanted - flat.mean(added)) * flat.covered
        added = added + flat.pulled(lacking)[0]
    return added.maximum(darkest).minimum(lightest)


def _ends_nearby(
    change: Float[Tensor, "R R 3"],
) -> tuple[Float[Tensor, "R R 3"], Float[Tensor, "R R 3"]]:
    """The least and the greatest change about each pixel, and none."""
    values, near = change.cpu().numpy(), np.ones((_NEAR_PX, _NEAR_PX), np.uint8)
    least = torch.from_numpy(cv2.erode(values, near)).to(change)
    greatest = torch.from_numpy(cv2.dilate(values, near)).to(change)
    return least.clamp(max=0), greatest.clamp(min=0)


def _spread(
    rgb: UInt8[np.ndarray, "R R 3"], known: Bool[np.ndarray, "R R"]
) -> UInt8[np.ndarray, "R R 3"]:
    """The picture with the nearest known pixel's colour wherever none is known."""
    if not known.any():
        return rgb
    _, label = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    color_of = np.zeros((label.max() + 1, 3), np.uint8)
    color_of[label[known]] = rgb[known]
    return color_of[label]


def uv_wires(avatar: Avatar, side_px: int) -> UInt8[np.ndarray, "R R 4"]:
    """Draw the edges of the head's triangles in its UV layout, white on nothing: a guide layer."""
    corners = avatar.head.uv.cpu().double().numpy()[avatar.head.uv_faces.cpu().numpy()]
    outline_px = np.stack([corners[..., 0], 1 - corners[..., 1]], -1) * side_px
    wires = np.zeros((side_px, side_px), np.uint8)
    cv2.polylines(wires, list(fixed_point(outline_px)), True, (255,), 1, cv2.LINE_AA, 4)
    drawn = np.full((side_px, side_px, 4), 255, np.uint8)
    drawn[..., 3] = wires
    return drawn


def write_texture(path: Path, avatar: Avatar) -> Path:
    """Write `color_texture` as a PNG and, beside it, its wires; return where those are.

    Raises UserError where they cannot be written, or would replace a picture that was painted on.
    """
    if path.exists():
        raise UserError(
            f"{path} is there already, and may have been painted on.",
            "Name another file, or move it away.",
        )
    texture = color_texture(avatar)
    wires = path.with_name(f"{path.stem}_wires.png")
    for place, picture in ((path, texture), (wires, uv_wires(avatar, len(texture)))):
        with atomic_write(place) as partial:
            partial.write_bytes(encode_png_rgba(picture))
    return wires


def read_texture(path: Path) -> UInt8[np.ndarray, "H W 4"]:
    """Read a painted texture: a PNG, grey, RGB or RGBA, of 8 or 16 bits.

    Raises UserError where it is none, or larger than 4096 pixels a side.
    """
    try:
        if max(png_size(path)) <= LARGEST_SIDE_PX:
            return read_png_rgba(path)
        cause = f"The texture {path} is too large."
    except UserError as error:
        cause = error.cause
    raise UserError(
        cause, f"Save the painted picture as PNG, of at most {LARGEST_SIDE_PX} pixels a side."
    )
