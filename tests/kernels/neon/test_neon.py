"""The C++ loops compiled for ARM, whose registers hold four numbers, on an emulated processor."""

import pytest
import torch

from tests.kernels.agreement import assert_agrees, expect
from tests.kernels.neon import emulator
from tests.kernels.scenes import in_float32, moved, random_scene
from tests.kernels.test_extremes import SCENES, TOLERANCES

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(
        emulator.missing() is not None, reason=f"{emulator.missing()} is not installed"
    ),
]


@pytest.fixture(autouse=True)
def on_arm(monkeypatch) -> None:
    emulator.install(monkeypatch)


@pytest.mark.parametrize("seed", [0, 1])
def test_values_and_gradients_match_reference(seed):
    assert_agrees(expect(random_scene(seed)), "cpu")
    assert_agrees(expect(moved(random_scene(seed))), "cpu")


@pytest.mark.parametrize("name", SCENES)
def test_hard_scenes_match_reference(name):
    assert_agrees(expect(SCENES[name]()), "cpu", **TOLERANCES.get(name, {}))


def test_weighted_colors_match_reference():
    from rgbavatar_ns.kernels import weighted_color_average

    scene = random_scene(3)
    gaussians, cameras = in_float32(scene)
    images = torch.rand(3, cameras.height, cameras.width, 4)
    found, wanted = (
        weighted_color_average(gaussians, cameras, images, backend=backend)
        for backend in ("cpu", "reference")
    )
    for name in ("weighted_sum", "weight_sum"):
        difference = getattr(found, name) - getattr(wanted, name)
        assert difference.abs().max() < 2e-2, name
        assert difference.norm() < 1e-3 * getattr(wanted, name).norm(), name
