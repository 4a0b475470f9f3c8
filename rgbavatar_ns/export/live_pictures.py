"""The driven avatar as pictures: a film, raw frames for another program, a virtual camera."""

import os
import sys
import time
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import UInt8

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.drawing.compositing import to_uint8
from rgbavatar_ns.driving.live_drive import DrivenFrame, Latencies
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.drawing import Color, draw
from rgbavatar_ns.export.video import FilmWriter
from rgbavatar_ns.kernels import PinholeCameras

_Picture = UInt8[np.ndarray, "height width 3"]
_LONGEST_STILL_S = 10.0
"""A pause of the performer stands still in the film for at most so long."""
_LONGEST_PAUSE_S = 3600.0
"""After a longer one the source counts by another clock: nobody waited."""


@runtime_checkable
class PictureSink(Protocol):
    """Where drawn pictures go."""

    def add(self, picture: _Picture, time_s: float) -> None:
        """Take one picture, shown at this time of the source's clock."""
        ...

    def close(self) -> None:
        """Complete what was begun."""
        ...


class PictureOutput:
    """Draws each driven frame from one camera (C = 1), beside the performer where asked for."""

    def __init__(
        self,
        avatar: AvatarMethod,
        camera: PinholeCameras,
        background: Color,
        sink: PictureSink,
        beside: bool = False,
    ) -> None:
        self.latencies = Latencies()
        self._avatar, self._camera, self._background = avatar, camera, background
        self._sink, self._beside = sink, beside
        self._beside_px = 0

    @torch.no_grad()
    def show(self, frame: DrivenFrame) -> None:
        """Draw and hand on."""
        theta = frame.theta[None]
        drawn = draw(self._avatar, theta, self._camera, self._background, to_be_seen=True)
        picture = to_uint8(drawn.image[0])
        if self._beside and frame.image_rgb is not None:
            picture = np.concatenate([self._performer(frame.image_rgb), picture], axis=1)
        self._sink.add(picture, frame.time_s)
        self.latencies.add(frame.captured_s, time.monotonic())

    def tell(self, line: str) -> None:
        """Pictures are of the avatar alone."""

    def _performer(
        self, image_rgb: UInt8[np.ndarray, "height W 3"]
    ) -> UInt8[np.ndarray, "height beside 3"]:
        """The performer's picture as wide as the first one was."""
        height, width = image_rgb.shape[:2]
        self._beside_px = self._beside_px or width
        tile = np.full((height, self._beside_px, 3), 255, np.uint8)
        tile[:, :width] = image_rgb[:, : self._beside_px]
        return tile

    def close(self) -> None:
        """Complete the sink."""
        self._sink.close()


class FilmSink:
    """A film with the performance's own timing at a constant rate."""

    def __init__(self, path: Path, frames_per_second: float) -> None:
        self._path, self._rate = path, frames_per_second
        self._film = FilmWriter(path, frames_per_second).__enter__()
        self._began_s: float | None = None
        self._last: _Picture | None = None

    def add(self, picture: _Picture, time_s: float) -> None:
        """As often as its place in time asks for: the one before it fills what lies between."""
        if self._began_s is None:
            self._began_s = time_s - self._film.count / self._rate
        due = round((time_s - self._began_s) * self._rate)
        ahead, most = due - self._film.count, round(_LONGEST_STILL_S * self._rate)
        if not -1 <= ahead <= most:
            paused = 0 < ahead <= _LONGEST_PAUSE_S * self._rate
            due = self._film.count + (most if paused else 0)
            self._began_s = time_s - due / self._rate
        while self._last is not None and self._film.count < due:
            self._film.add(self._last)
        if self._film.count == due:
            self._film.add(picture)
        self._last = picture

    def close(self) -> None:
        """Complete the film; without a single picture there is none."""
        if self._film.count == 0:
            nothing = UserError(
                f"{self._path} has no picture.",
                "What drives it has to be seen: a dozen pictures with a face, or what another "
                "program sends.",
            )
            self._film.__exit__(UserError, nothing, None)
            raise nothing
        self._film.__exit__(None, None, None)


class RawSink:
    """Frames of RGB bytes, rows from the top, one after another, for a program at the other end."""

    def __init__(self, descriptor: int | None = None) -> None:
        self._descriptor = sys.stdout.fileno() if descriptor is None else descriptor

    def add(self, picture: _Picture, time_s: float) -> None:
        """Write a frame; raises BrokenPipeError when the reader has gone."""
        left = memoryview(picture.tobytes())
        while left:
            left = left[os.write(self._descriptor, left) :]

    def close(self) -> None:
        """Nothing is left to do."""


class VirtualCameraSink:
    """A v4l2 loopback device, as OBS and video calls read it; needs pyvirtualcam.

    Raises UserError where the package or the device is missing.
    """

    def __init__(self, device: str, frames_per_second: float) -> None:
        try:
            import pyvirtualcam  # type: ignore[import-not-found]
        except ImportError:
            raise UserError(
                "A virtual camera needs pyvirtualcam.", "pip install pyvirtualcam"
            ) from None
        self._library, self._device, self._rate = pyvirtualcam, device, frames_per_second
        self._camera: Any = None
        if not os.path.exists(device):
            raise UserError(
                f"There is no device {device}.",
                "Load the loopback driver first: sudo modprobe v4l2loopback video_nr=10",
            )

    def add(self, picture: _Picture, time_s: float) -> None:
        """Send a frame; the first one gives the size."""
        if self._camera is None:
            height, width = picture.shape[:2]
            try:
                self._camera = self._library.Camera(width, height, self._rate, device=self._device)
            except RuntimeError as error:
                raise UserError(
                    f"{self._device} takes no pictures: {error}.",
                    "Use a device of v4l2loopback that no other program writes to.",
                ) from None
        self._camera.send(picture)

    def close(self) -> None:
        """Let go of the device."""
        if self._camera is not None:
            self._camera.close()
