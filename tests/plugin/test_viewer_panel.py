"""Which frame drives the avatar: metadata, then the panel, then the camera's time."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from rgbavatar_ns import Avatar
from rgbavatar_ns.plugin.cameras import from_nerfstudio
from rgbavatar_ns.plugin.viewer_panel import BY_TIME, ViewerPanel, Viewpoint
from tests.plugin.run import make_trainer, small_config
from tests.plugin.tiny import NUM_FRAMES


@pytest.fixture
def panel() -> ViewerPanel:
    return ViewerPanel(11, Viewpoint(eye=(0.0, -1.0, 0.0), look_at=(0.0, 0.0, 0.0)))


def _show(panel: ViewerPanel, **values: Any) -> None:
    """Stand in for the viewer's installed controls."""
    for name in ("driven_by", "frame", "play", "shade"):
        element = getattr(panel, name)
        element.gui_handle = SimpleNamespace(value=values.get(name, element.default_value))


def test_without_a_viewer_the_cameras_time_chooses(panel: ViewerPanel):
    times = [0.0, 0.49, 0.51, 1.0, 1.5, -1.0]
    chosen = [panel.position(torch.tensor([[t]])) for t in times]
    assert chosen == [0, 5, 5, 10, 10, 0]
    assert panel.position(None) == 0


def test_in_the_viewer_the_slider_chooses(panel: ViewerPanel):
    _show(panel, frame=7)
    assert panel.position(torch.tensor([[0.2]])) == 7
    panel.driven_by.gui_handle.value = BY_TIME
    assert panel.position(torch.tensor([[0.2]])) == 2


def test_previewing_a_camera_path_follows_its_time(panel: ViewerPanel):
    _show(panel, frame=7)
    panel.start._viewer = SimpleNamespace(render_tab_state=SimpleNamespace(preview_render=True))
    assert panel.position(torch.tensor([[0.9]])) == 9


def test_playing_goes_round(panel: ViewerPanel):
    seen = []
    for _ in range(4):
        panel.advance()
        seen.append(panel.frame.value)
    assert seen == [0, 0, 0, 0]
    panel.play.value = True
    panel.frame.value = 9
    for _ in range(3):
        panel.advance()
        seen.append(panel.frame.value)
    assert seen[4:] == [10, 0, 1]


def test_backdrop_is_black_without_a_viewer(panel: ViewerPanel):
    assert panel.background_color() == (0.0, 0.0, 0.0)
    _show(panel, shade=(255, 51, 0))
    assert panel.background_color() == pytest.approx((1.0, 0.2, 0.0))


@torch.no_grad()
def _rendered(avatar: Avatar, theta: torch.Tensor, camera: Cameras) -> torch.Tensor:
    return avatar.render(theta, from_nerfstudio(camera)).image[0]


def test_model_draws_metadata_before_the_panel(tiny_data: Path, tmp_path: Path):
    pipeline = make_trainer(small_config(tiny_data, tmp_path)).pipeline
    model = pipeline.model.eval()
    camera, _ = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    model.viewer_panel.frame.value = 3
    with_theta = model.get_outputs_for_camera(camera)["rgb"]
    expected = _rendered(model.avatar, camera.metadata["theta"], camera)
    assert torch.equal(with_theta, expected)
    camera.metadata = {"cam_idx": 0}
    for place, time in ((3, 3 / (NUM_FRAMES - 1)), (0, 0.0)):
        camera.times = torch.tensor([[time]])
        drawn = model.get_outputs_for_camera(camera)
        theta = model.frame_theta[place : place + 1]
        expected = _rendered(model.avatar, theta, camera)
        assert torch.equal(drawn["rgb"], expected)
        assert drawn["depth"].shape == drawn["accumulation"].shape == (*expected.shape[:2], 1)
        assert not torch.equal(drawn["rgb"], with_theta)


def test_viewer_starts_before_the_face_and_nearer_than_the_camera(tiny_data: Path, tmp_path: Path):
    model = make_trainer(small_config(tiny_data, tmp_path)).pipeline.model
    start = model.viewer_panel.start._viewpoint
    eye, look_at = torch.tensor(start.eye), torch.tensor(start.look_at)
    # The tiny dataset's camera stands one metre before the head, on the face's side: -y.
    offset = eye - look_at
    assert -1.0 < offset[1] < -0.7
    assert offset[[0, 2]].norm() < 0.1
