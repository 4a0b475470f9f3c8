"""Theta to image as one CUDA graph, for pictures one after another."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.training.cuda_graph import Recorder, record_cuda_graph, supports
from rgbavatar_ns.kernels import DeviceRenderer, PinholeCameras, RenderedBatch

_EAGER_PICTURES = 2
"""Pictures before the recording: libraries make their handles, and the lists' room is measured."""


class RecordedRendering:
    """Draws an avatar on its device for batches and images of one size.

    Head model, weight network, blending and rasterizer are in the graph; the avatar may be trained
    meanwhile. A picture that finds no room is drawn again in the ordinary way: nothing is missing.

    Raises:
        ValueError: the backend has no renderer that works without the host (`recording.supports`).
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
        self._avatar, self._backend, self._recorder = avatar, backend, recorder
        self._theta = theta.detach().clone()
        self._cameras = PinholeCameras(
            cameras.world_to_camera.clone(),
            cameras.focal_px.clone(),
            cameras.principal_point_px.clone(),
            cameras.width,
            cameras.height,
        )
        self._background = torch.zeros(len(theta), 3, device=theta.device)
        self._replay: Callable[[], None] | None = None
        self._pictures = 0

    @torch.no_grad()
    def __call__(
        self,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras | None = None,
        background: Float[Tensor, "3"] | Float[Tensor, "B 3"] | None = None,
    ) -> RenderedBatch:
        """Draw theta [B, H]; without cameras, the last ones'. Waits until it is drawn.

        The tensors are used again by the next call. Raises ValueError for other sizes than at the
        start.
        """
        self._take(theta, cameras, background)
        if self._pictures < _EAGER_PICTURES:
            self._pictures += 1
            return self._drawn_by_the_host()
        if self._replay is None:
            self._replay = self._recorder(self._draw)
        self._replay()
        if not int(self._overflowed):
            return self._picture
        self._replay, self._pictures = None, 0
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
            own.world_to_camera.copy_(cameras.world_to_camera, non_blocking=True)
            own.focal_px.copy_(cameras.focal_px, non_blocking=True)
            own.principal_point_px.copy_(cameras.principal_point_px, non_blocking=True)
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
