"""Theta to image as one CUDA graph, for pictures one after another."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.training.cuda_graph import (
    Recorder,
    Recording,
    lane,
    record_cuda_graph,
    supports,
)
from rgbavatar_ns.kernels import CAMERA_TENSORS, DeviceRenderer, PinholeCameras, RenderedBatch

_EAGER_PICTURES = 2
"""Pictures before the recording: libraries make their handles, and the lists' room is measured."""


class RecordedRendering:
    """Draws an avatar on its device for batches and images of one size.

    The avatar may be trained meanwhile. A picture that finds no room is drawn again in the
    ordinary way. Raises ValueError where the backend needs the host (`cuda_graph.supports`).
    """

    def __init__(
        self,
        avatar: Avatar,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
        *,
        backend: str = "auto",
        recorder: Recorder = record_cuda_graph,
    ) -> None:
        if not supports(avatar, theta[:1], cameras.select([0]), backend):
            raise ValueError("This backend's pictures need the host. Use Avatar.render.")
        if len(cameras.focal_px) not in (1, len(theta)):
            raise ValueError(
                f"{len(cameras.focal_px)} cameras for {len(theta)} theta. Pass one, or one each."
            )
        self._avatar, self._backend = avatar, backend
        self._recording = Recording(avatar, self._draw, recorder)
        self._lane = lane(theta.device)
        self._theta = theta.detach().clone()
        own = {name: getattr(cameras, name).clone() for name in CAMERA_TENSORS}
        self._cameras = replace(cameras, **own)
        self._background = torch.zeros(len(theta), 3, device=theta.device)
        self._pictures = 0

    @torch.no_grad()
    def __call__(
        self,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras | None = None,
        background: Float[Tensor, "3"] | Float[Tensor, "B 3"] | None = None,
    ) -> RenderedBatch:
        """Draw theta, without cameras by the last ones'; the next call uses the tensors again."""
        with self._lane():
            self._take(theta, cameras, background)
            if self._pictures < _EAGER_PICTURES:
                self._pictures += 1
                return self._drawn_by_the_host()
            self._recording()
            if not int(self._overflowed):
                return self._picture
            self._recording.forget()
            self._pictures = 0
            return self._drawn_by_the_host()

    def _take(
        self, theta: Tensor, cameras: PinholeCameras | None, background: Tensor | None
    ) -> None:
        own = self._cameras
        if theta.shape != self._theta.shape or (
            cameras is not None
            and (cameras.width, cameras.height, len(cameras.focal_px))
            != (own.width, own.height, len(own.focal_px))
        ):
            raise ValueError("Another batch or image size than at the start. Make a new one.")
        self._theta.copy_(theta, non_blocking=True)
        if cameras is not None:
            for name in CAMERA_TENSORS:
                getattr(own, name).copy_(getattr(cameras, name), non_blocking=True)
        if background is None:
            self._background.zero_()
        else:
            self._background.copy_(background.expand(len(theta), 3), non_blocking=True)

    def _drawn_by_the_host(self) -> RenderedBatch:
        return self._avatar.render(
            self._theta, self._cameras, self._background, backend=self._backend
        )

    def _draw(self) -> None:
        renderer = self._avatar.renderer(self._theta, self._cameras, backend=self._backend)
        assert isinstance(renderer, DeviceRenderer)
        self._picture = renderer.draw_at_once(self._background)
        self._overflowed = renderer.overflowed
