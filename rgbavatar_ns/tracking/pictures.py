"""The second reading of a clip: crops, mattes and the contact sheet of the tracked frames."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, UInt8

from rgbavatar_ns.data import TrackedFrame
from rgbavatar_ns.kernels.types import PinholeCameras
from rgbavatar_ns.tracking.camera import StillCamera
from rgbavatar_ns.tracking.clip import ClipLandmarks
from rgbavatar_ns.tracking.crop import SquareCrop
from rgbavatar_ns.tracking.fit import ClipFit
from rgbavatar_ns.tracking.landmarks import CHIN, FOREHEAD
from rgbavatar_ns.tracking.matting import PersonMatte, foreground_color
from rgbavatar_ns.tracking.overlay import OverlayTile
from rgbavatar_ns.tracking.region import HeadRegion
from rgbavatar_ns.tracking.subject import SubjectTracker
from rgbavatar_ns.tracking.video import FrameSource

_SHEET_TILES = 12


@dataclass
class TrackedPictures:
    """Iterates over tracked frames with their matted pictures; gathers `tiles` on the way."""

    tracker: SubjectTracker
    fit: ClipFit
    found: ClipLandmarks
    crop: SquareCrop
    keep_torso: bool
    tiles: list[OverlayTile] = field(default_factory=list)

    def __post_init__(self) -> None:
        arrays = self.tracker.head.arrays
        self._region = HeadRegion(arrays.faces, arrays.skinning_weights)
        self._inside = self.crop.inside(self.found.width, self.found.height)
        self._thetas = self.tracker.thetas(self.fit)
        self._camera = pinhole(
            self.fit.subject.camera.cropped(self.crop.left, self.crop.top, self.crop.scale),
            self.crop.size,
        )

    def frames(self, source: FrameSource, advance: Callable[[], None]) -> Iterator[TrackedFrame]:
        """Every tracked frame, cropped and matted, in order; one picture in memory at a time."""
        place = {index: position for position, index in enumerate(self.found.frame_index)}
        shown = set(np.linspace(0, len(place) - 1, min(_SHEET_TILES, len(place))).astype(int))
        self.tiles.clear()
        with PersonMatte() as matte:
            for frame in source:
                position = place.get(frame.index)
                if position is None:
                    continue
                rgba, vertices = self._picture(frame.image_rgb, position, matte)
                if position in shown:
                    self.tiles.append(self._tile(rgba, vertices, position))
                theta = torch.from_numpy(self._thetas[position]).float()
                yield TrackedFrame(frame.index, theta, self._camera, rgba)
                advance()

    def _picture(
        self, image_rgb: UInt8[np.ndarray, "H W 3"], position: int, matte: PersonMatte
    ) -> tuple[UInt8[np.ndarray, "S S 4"], Float[np.ndarray, "V 2"]]:
        picture = self.crop.apply(image_rgb)
        alpha = matte(picture) * self._inside
        color = foreground_color(picture, alpha)
        vertices = self.crop.points(self.tracker.vertices_px(self.fit, position))
        if not self.keep_torso:
            points = self.crop.points(self.found.points_px[position])
            alpha = alpha * self._region(vertices, points[FOREHEAD], points[CHIN], self.crop.size)
        levels = np.round(alpha * 255).astype(np.uint8)
        # Colour under zero alpha means nothing; black compresses well.
        color = color * (levels > 0)[..., None].astype(np.uint8)
        return np.dstack([color, levels]), vertices

    def _tile(
        self,
        rgba: UInt8[np.ndarray, "S S 4"],
        vertices_px: Float[np.ndarray, "V 2"],
        position: int,
    ) -> OverlayTile:
        found = self.found.points_px[position][self.tracker.facemesh_index]
        return OverlayTile(
            str(self.found.frame_index[position]),
            rgba,
            vertices_px,
            self.crop.points(found),
            self.crop.points(self.tracker.frame_px(self.fit, position)),
        )


def pinhole(camera: StillCamera, size: int) -> PinholeCameras:
    """The rasterizer's form of the still camera, for a square image."""
    return PinholeCameras(
        torch.from_numpy(camera.world_to_camera).float()[None],
        torch.tensor([[camera.focal_px, camera.focal_px]], dtype=torch.float32),
        torch.tensor([camera.center_px], dtype=torch.float32),
        size,
        size,
    )
