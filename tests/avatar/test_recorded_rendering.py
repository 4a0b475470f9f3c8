"""Recorded pictures, on the emulated CUDA backend."""

import pytest
import torch

from rgbavatar_ns.avatar.recorded_rendering import RecordedRendering
from tests.avatar.fused_scene import far_batch, stir
from tests.avatar.training.test_recorded_step import Recorder


def _rendering(avatar, cameras=1):
    batch, background = far_batch(avatar, 2, 30, 20, cameras=cameras)
    recorder = Recorder()
    rendering = RecordedRendering(avatar, batch.theta, batch.cameras, recorder=recorder)
    return rendering, recorder, batch, background


@pytest.mark.parametrize("cameras", [1, 2])
def test_pictures_are_the_ordinary_ones(emulated, make_avatar, cameras):
    avatar = stir(make_avatar())
    rendering, recorder, batch, background = _rendering(avatar, cameras)
    for number in range(5):
        theta = batch.theta.roll(number, 0) * (1 - 0.1 * number)
        if number == 4:  # training goes on in place
            with torch.no_grad():
                avatar.blendshapes.position.mul_(0.5)
        found = rendering(theta, batch.cameras, background).image
        expected = avatar.render(theta, batch.cameras, background, backend="reference").image
        assert (found - expected).abs().max() < 1e-4
    assert (recorder.records, recorder.replays) == (1, 3)
    assert rendering(batch.theta).alpha.max() > 0.5


def test_a_picture_without_room_is_drawn_again(emulated, make_avatar):
    avatar = stir(make_avatar())
    rendering, recorder, batch, _ = _rendering(avatar)
    for _ in range(3):
        expected = rendering(batch.theta).image.clone()
    capacities = emulated.capacities(torch.device("cpu"))
    capacities.per_image[(avatar.num_gaussians, 30, 20)] = 5
    assert torch.equal(rendering(batch.theta).image, expected)
    for _ in range(3):
        assert torch.equal(rendering(batch.theta).image, expected)
    assert recorder.records == 2


def test_other_sizes_and_backends_are_refused(emulated, make_avatar):
    avatar = stir(make_avatar())
    rendering, _, batch, _ = _rendering(avatar)
    with pytest.raises(ValueError, match="Another batch"):
        rendering(batch.theta[:1])
    with pytest.raises(ValueError, match="need the host"):
        RecordedRendering(avatar, batch.theta, batch.cameras, backend="cpu")
