"""A viewer panel and its controls, to be set and looked at without a browser."""

from types import SimpleNamespace
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras

from rgbavatar_ns import Avatar
from rgbavatar_ns.plugin.avatar_model import AvatarModel
from rgbavatar_ns.plugin.cameras import from_nerfstudio
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline
from rgbavatar_ns.plugin.viewer.panel import ViewerPanel
from tests.plugin.fake_viewer import FakeViewer


class Desk:
    """A panel with its controls, in a viewer whose time passes when it is told to."""

    def __init__(self, pipeline: RGBAvatarPipeline) -> None:
        self.model: AvatarModel = pipeline.model
        self.cameras = pipeline.datamanager.train_dataset.cameras
        self.now_s = 0.0
        self.panel = ViewerPanel(self.model, pipeline.film, clock=lambda: self.now_s)
        self.viewer, self.asked = FakeViewer(), []
        self.panel.attach(self.viewer)
        browser = SimpleNamespace(client=None, action=self.asked.append)
        self.viewer.render_statemachines[0] = browser
        self.white(self.model.frame_theta[:1])  # packs the Gaussians: all pictures are of one kind

    def set(self, label: str, value: Any) -> None:
        self.viewer.gui[label].user_sets(value)

    def picture(self, camera: Cameras | None = None, time: float | None = None) -> torch.Tensor:
        camera = self.camera() if camera is None else camera
        return self.panel.draw(from_nerfstudio(camera), time)["rgb"]

    def told(self) -> str:
        """What stands in the panel after a while."""
        self.pass_time(1.0)
        return "\n".join(self.viewer.gui.texts())

    def white(self, theta: torch.Tensor, psi: torch.Tensor | None = None) -> torch.Tensor:
        """The avatar drawn without the panel, over the panel's background."""
        return rendered(self.model.avatar, theta, self.camera(), white=True, psi=psi)

    def pass_time(self, seconds: float) -> None:
        self.now_s += seconds
        self.panel.tick()

    def camera(self) -> Cameras:
        camera = self.cameras[0:1].to(self.model.device)
        camera.metadata = {}
        return camera


@torch.no_grad()
def rendered(
    avatar: Avatar, theta: torch.Tensor, camera: Cameras, white=False, psi=None, *, to_be_seen=True
) -> torch.Tensor:
    """As the avatar is seen from its second picture on, or as it is measured."""
    ground, pinhole = theta.new_full((3,), float(white)), from_nerfstudio(camera)
    for _ in range(2):
        drawn = avatar.render(theta, pinhole, ground, psi=psi, to_be_seen=to_be_seen)
    return drawn.image[0].clamp(0, 1)


@torch.no_grad()
def rendered_depth(avatar: Avatar, theta: torch.Tensor, camera: Cameras) -> torch.Tensor:
    """As it is seen, in metres, of an avatar that was drawn before."""
    drawn = avatar.render(theta, from_nerfstudio(camera), with_depth=True, to_be_seen=True)
    assert drawn.depth is not None
    return drawn.depth[0]
