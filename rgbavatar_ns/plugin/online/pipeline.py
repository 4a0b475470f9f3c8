"""nerfstudio's pipeline of an online run: it also looks at what has just arrived."""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor

from rgbavatar_ns.avatar.metrics import l1_over_black, psnr
from rgbavatar_ns.data.streams import ReplayBatch
from rgbavatar_ns.drawing.compositing import (
    composite,
    film_over,
    is_unfilmed,
    rgba_to_float,
)
from rgbavatar_ns.kernels import RenderedBatch
from rgbavatar_ns.plugin.online.datamanager import OnlineDataManager, OnlineDataManagerConfig
from rgbavatar_ns.plugin.option_order import led_by
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline, RGBAvatarPipelineConfig
from rgbavatar_ns.plugin.viewer.status_panel import StatusPanel


@led_by("datamanager", "model")
@dataclass
class OnlinePipelineConfig(RGBAvatarPipelineConfig):
    """The stream and what is trained on it."""

    _target: type = field(default_factory=lambda: OnlinePipeline)
    datamanager: OnlineDataManagerConfig = field(default_factory=OnlineDataManagerConfig)
    """The stream, and what a batch is drawn from."""


class OnlinePipeline(RGBAvatarPipeline):
    """Adds the newest frame beside the avatar, for the viewer and for the log."""

    config: OnlinePipelineConfig
    datamanager: OnlineDataManager

    def __init__(
        self, config: OnlinePipelineConfig, device: str | torch.device, **more: Any
    ) -> None:
        super().__init__(config, device, **more)
        self.status_panel = StatusPanel("Stream")
        if self.test_mode == "val":
            # The subject itself knows the newest frame alone, and so does the viewer's "Frame".
            self.model.filmed = lambda: self.datamanager.filmed(self.model.subject)

    @property
    def film(self) -> None:
        """None: of a stream only the newest frame is shown."""
        return None

    @torch.no_grad()
    def losses_of(self, frames: ReplayBatch) -> list[float]:
        """The mean absolute difference over black of frames that the pools hold."""
        drawn = self._drawn(frames).image
        return l1_over_black(drawn, frames.images_rgba.to(self.device)).tolist()

    @torch.no_grad()
    def look_at(self, newest_first: ReplayBatch) -> tuple[float, UInt8[Tensor, "H W 3"]]:
        """Draw frames as they were filmed: mean PSNR over black in dB, and the newest of them.

        The picture is the frame with the avatar, driven by it, on its right.
        """
        drawn = self._drawn(newest_first).image.clamp(0, 1)
        black = drawn.new_zeros(len(drawn), 3)
        rgba = newest_first.images_rgba.to(self.device)
        filmed = ~is_unfilmed(rgba)
        truth = film_over(rgba, black, drawn)
        score = float(psnr(drawn, truth, filmed).mean())
        pair = torch.cat([composite(rgba_to_float(rgba[0]), black[0]), drawn[0]], dim=1)
        return score, (pair * 255).round().to(torch.uint8).cpu()

    def _drawn(self, frames: ReplayBatch) -> RenderedBatch:
        theta, cameras = frames.theta.to(self.device), frames.cameras.to(self.device)
        return self.model.avatar.render(theta, cameras, backend=self.config.model.rasterizer)
