"""What the panel draws beside and over the head, without a browser."""

import pytest
import torch
from nerfstudio.cameras.cameras import CameraType

from rgbavatar_ns.plugin.cameras import from_nerfstudio
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline
from tests.plugin.desk import Desk
from tests.plugin.tiny import SIZE


def test_film_avatar_and_error_stand_in_a_row(desk: Desk, pipeline: RGBAvatarPipeline):
    desk.panel.change(frame=4, picture="beside the film", background=(0.0, 0.0, 0.0))
    wide = desk.camera()
    wide.width, wide.height = (torch.full_like(wide.width, s * SIZE) for s in (3, 1))
    row = desk.picture(wide)
    rgba = torch.from_numpy(pipeline.datamanager.dataparser.tracked.read_image(4)).float() / 255
    truth = rgba[..., :3] * rgba[..., 3:]
    assert torch.allclose(row[:, :SIZE], truth, atol=1e-6)
    camera = pipeline.datamanager.dataparser.tracked.cameras.select([4])
    theta = desk.model.frame_theta[4:5]
    avatar = desk.model.avatar.render(theta, camera, to_be_seen=True).image[0]
    assert torch.allclose(row[:, SIZE : 2 * SIZE], avatar.clamp(0, 1), atol=1e-5)
    # The error is bright where the two differ most.
    error, difference = row[:, 2 * SIZE :].sum(-1), (avatar - truth).abs().mean(-1)
    assert error[difference > 0.2].min() > error[difference < 0.01].max()
    psnr = -10 * (avatar.clamp(0, 1) - truth).square().mean().log10()
    assert f"PSNR of this frame {psnr:.2f} dB" in desk.told()


@pytest.mark.parametrize(
    ("width", "height", "places"),
    [
        (3, 1, [(0, 0), (0, 1), (0, 2)]),
        (1, 3, [(0, 0), (1, 0), (2, 0)]),
        (2, 2, [(0, 0), (0, 1), (1, 0.5)]),
    ],
)
def test_film_avatar_and_error_use_the_window(
    desk: Desk, width: int, height: int, places: list[tuple[float, float]]
):
    desk.panel.change(frame=4, picture="beside the film", background=(0.0, 0.0, 1.0))
    window = desk.camera()
    window.width, window.height = (torch.full_like(window.width, s * SIZE) for s in (width, height))
    image = desk.picture(window)
    desk.panel.change(picture="error")
    tile = desk.picture()
    row, column = (round(SIZE * part) for part in places[2])
    assert torch.equal(image[row : row + SIZE, column : column + SIZE], tile)


@pytest.mark.parametrize("picture", ["alpha", "depth", "error"])
def test_other_pictures_are_drawn(desk: Desk, picture: str):
    plain = desk.picture()
    desk.set("Picture", picture)
    image = desk.picture()
    assert image.shape == plain.shape
    assert (image - plain).abs().max() > 0.1
    assert image.std() > 0.01


@pytest.mark.parametrize("label", ["Mesh", "Gaussian centres"])
def test_overlays_lie_on_the_head(desk: Desk, label: str):
    plain = desk.picture()
    desk.set(label, True)
    alpha = desk.panel.draw(from_nerfstudio(desk.camera()), None)["accumulation"]
    changed = (desk.picture() - plain).abs().amax(-1) > 0.05
    assert 0.02 < changed.float().mean() < 0.95
    assert alpha[..., 0][changed].mean() > alpha[..., 0][~changed].mean() + 0.2


def test_another_lens_of_the_render_panel_does_not_end_the_pictures(
    desk: Desk, pipeline: RGBAvatarPipeline, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(pipeline, "viewer_panel", desk.panel)
    camera = desk.camera()
    camera.camera_type = torch.full_like(camera.camera_type, CameraType.FISHEYE.value)
    shown = pipeline.model.get_outputs_for_camera(camera)["rgb"]
    assert torch.equal(shown, pipeline.model.get_outputs_for_camera(desk.camera())["rgb"])
    assert "perspective" in "\n".join(desk.viewer.gui.texts())
