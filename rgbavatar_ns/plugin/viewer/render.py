"""Images for the viewer: the avatar, what helps to judge it, and the film beside it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.metrics import psnr
from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.drawing.compositing import (
    composite,
    film_over,
    is_unfilmed,
    rgba_to_float,
    shown_error,
    to_uint8,
)
from rgbavatar_ns.drawing.wireframe import with_wireframe
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, RenderedBatch
from rgbavatar_ns.plugin.cameras import filled_depth
from rgbavatar_ns.plugin.viewer.driving import DrivingSignal
from rgbavatar_ns.plugin.viewer.viewer_state import ViewerState
from rgbavatar_ns.threads import using_threads

_SEEN = 0.02
_CENTRE_RGB = (60, 255, 120)

_Bytes = UInt8[np.ndarray, "H W 3"]
_Image = Float[Tensor, "H W 3"]


@dataclass(frozen=True)
class ViewerRender:
    """One image, and what nerfstudio wants beside it."""

    image: _Image
    alpha: Float[Tensor, "H W 1"]
    depth: Float[Tensor, "H W 1"] | None
    """In metres along the camera's z; None where nobody asked for it."""
    psnr: float | None = None
    """Against the film in dB, where it is beside."""

    def outputs(self) -> dict[str, Tensor]:
        """By the names that nerfstudio's viewer and `ns-render` use.

        The names are always the same, since the viewer offers them; a depth that is not there is
        NaN everywhere.
        """
        unknown = self.alpha.new_full((), math.nan).expand_as(self.alpha)
        depth = unknown if self.depth is None else self.depth
        return {"rgb": self.image, "accumulation": self.alpha, "depth": depth}


@torch.no_grad()
def viewer_render(
    avatar: AvatarMethod,
    signal: DrivingSignal,
    state: ViewerState,
    camera: PinholeCameras,
    *,
    film: TrackedDataset | None = None,
    backend: str = "auto",
    with_depth: bool = False,
    to_be_seen: bool = True,
) -> ViewerRender:
    """Draw what the state asks for from one camera (C = 1); images beside the film from its own.

    Depth, which takes time, is found where it is asked for or shown; `to_be_seen` as in
    `AvatarMethod.render`. Raises UserError where there is no film to compare with.
    """
    options = {"backend": backend, "to_be_seen": to_be_seen}
    if state.picture in ("beside the film", "error"):
        return _beside_film(avatar, signal, state, camera, film, options)
    with_depth = with_depth or state.picture == "depth"
    drawn = _draw(avatar, signal, state, camera, options, with_depth)
    alpha, depth = drawn.alpha[0], None
    with using_threads(1):
        if drawn.depth is not None:
            depth = filled_depth(drawn.depth, drawn.alpha)[0]
        # nerfstudio's viewer makes bytes of it, where 1.01 would be black.
        image = drawn.image[0].clamp_(0, 1)
    if state.picture == "alpha":
        image = alpha.expand(-1, -1, 3)
    elif state.picture == "depth" and depth is not None:
        image = _depth_colors(depth, alpha)
    image = _with_overlays(image, avatar, signal, state, camera, drawn.visibility)
    return ViewerRender(image, alpha, depth)


def _draw(
    avatar: AvatarMethod,
    signal: DrivingSignal,
    state: ViewerState,
    camera: PinholeCameras,
    options: Mapping[str, Any],
    with_depth: bool,
) -> RenderedBatch:
    return avatar.render(
        signal.theta,
        camera,
        signal.theta.new_tensor(state.background),
        psi=signal.psi,
        with_depth=with_depth,
        with_visibility=state.centres,
        **options,
    )


def _beside_film(
    avatar: AvatarMethod,
    signal: DrivingSignal,
    state: ViewerState,
    camera: PinholeCameras,
    film: TrackedDataset | None,
    options: Mapping[str, Any],
) -> ViewerRender:
    """Film, avatar and error, or the error alone, as large as the viewer's window allows."""
    if film is None or signal.frame is None:
        raise UserError(
            "There is no film to compare this with.",
            "Choose another picture, or drive the avatar by a dataset frame.",
        )
    own = film.cameras.select([signal.frame]).to(signal.theta.device)
    drawn = _draw(avatar, signal, state, own, options, with_depth=False)
    rgba = torch.from_numpy(film.read_image(signal.frame)).to(signal.theta.device)
    background = signal.theta.new_tensor(state.background)
    image = drawn.image[0].clamp(0, 1)
    truth = film_over(rgba, background, image)
    filmed = ~is_unfilmed(rgba)
    quality_db = float(psnr(image[None], truth[None], filmed[None]))
    tiles = [_colored(shown_error(image, truth).mean(-1, keepdim=True), cv2.COLORMAP_INFERNO)]
    if state.picture == "beside the film":
        overlaid = _with_overlays(image, avatar, signal, state, own, drawn.visibility)
        tiles = [composite(rgba_to_float(rgba), background), overlaid, *tiles]
    image = _arranged(tiles, camera, state.background)
    covered = image.new_ones(camera.height, camera.width, 1)
    return ViewerRender(image, covered, covered, quality_db)


def _arranged(
    tiles: list[_Image], camera: PinholeCameras, background: tuple[float, float, float]
) -> Float[Tensor, "window_H window_W 3"]:
    """Tiles of one size in the rows that show them largest in a picture of the camera's size."""
    height, width = tiles[0].shape[:2]

    def zoom_of(columns: int) -> float:
        rows = math.ceil(len(tiles) / columns)
        return min(camera.height / (rows * height), camera.width / (columns * width))

    columns = max(range(1, len(tiles) + 1), key=zoom_of)
    zoom, rows = zoom_of(columns), math.ceil(len(tiles) / columns)
    size = max(1, int(width * zoom)), max(1, int(height * zoom))
    smooth = cv2.INTER_AREA if zoom < 1 else cv2.INTER_LINEAR
    image = tiles[0].new_tensor(background).expand(camera.height, camera.width, 3).clone()
    for row in range(rows):
        inside = tiles[row * columns : (row + 1) * columns]
        top = (camera.height - rows * size[1]) // 2 + row * size[1]
        left = (camera.width - len(inside) * size[0]) // 2
        shown = cv2.resize(
            torch.cat(inside, 1).cpu().numpy(),
            (len(inside) * size[0], size[1]),
            interpolation=smooth,
        )
        image[top : top + size[1], left : left + shown.shape[1]] = torch.from_numpy(shown).to(image)
    return image


def _depth_colors(depth: Float[Tensor, "H W 1"], alpha: Float[Tensor, "H W 1"]) -> _Image:
    """Near is bright, over the range of what is covered; black where nothing is."""
    covered = alpha > 0.5
    if not bool(covered.any()):
        return torch.zeros_like(depth).expand(-1, -1, 3)
    near, far = depth[covered].aminmax()
    closeness = (far - depth) / (far - near).clamp(min=1e-6)
    return _colored(closeness, cv2.COLORMAP_VIRIDIS) * covered


def _colored(values: Float[Tensor, "H W 1"], color_map: int) -> _Image:
    """Values in [0, 1] by one of OpenCV's colour maps."""
    return _as_image(cv2.applyColorMap(to_uint8(values), color_map)[..., ::-1], values)


def _with_overlays(
    image: _Image,
    avatar: AvatarMethod,
    signal: DrivingSignal,
    state: ViewerState,
    camera: PinholeCameras,
    visibility: Tensor | None,
) -> _Image:
    if state.centres and visibility is not None:
        means = _gaussians(avatar, signal).means[0, visibility[0] > _SEEN]
        image = _over(image, lambda picture: _with_points(picture, _pixels(means, camera)))
    if state.mesh:
        vertices = avatar.carrier_vertices(signal.theta)[0]
        points, faces = _pixels(vertices, camera), avatar.head.arrays.faces
        # The drawing's colours are OpenCV's: blue first.
        image = _over(
            image, lambda rgb: with_wireframe(rgb[..., ::-1].copy(), points, faces)[..., ::-1]
        )
    return image


def _gaussians(avatar: AvatarMethod, signal: DrivingSignal) -> GaussianSet:
    if isinstance(avatar, Avatar):
        return avatar.gaussians(signal.theta, signal.psi)
    return avatar.gaussians(signal.theta)


def _pixels(points: Float[Tensor, "P 3"], camera: PinholeCameras) -> Float[np.ndarray, "P 2"]:
    # Far outside is outside; what draws has no room for more.
    return camera.project(points[None])[0].clamp(-1e5, 1e5).cpu().numpy()


def _with_points(picture: _Bytes, points_px: Float[np.ndarray, "P 2"]) -> _Bytes:
    column, row = np.floor(points_px).astype(int).T
    height, width = picture.shape[:2]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    marked = picture.copy()
    marked[row[inside], column[inside]] = _CENTRE_RGB
    return marked


def _over(image: _Image, drawing: Callable[[Any], Any]) -> _Image:
    """The image after something was drawn into its bytes."""
    return _as_image(drawing(to_uint8(image)), image)


def _as_image(coded: Any, like: Tensor) -> _Image:
    return torch.from_numpy(np.ascontiguousarray(coded)).to(like.device).float() / 255
