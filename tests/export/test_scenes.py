"""Cameras of views, orbit and turntable: about the head, and no farther than it holds."""

from dataclasses import replace

import pytest
import torch

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.driving.transfer import DrivingOptions
from rgbavatar_ns.export import front_camera
from rgbavatar_ns.export.scenes import (
    TURNTABLE_FRAMES,
    Scene,
    driven_by,
    orbiting,
    told_beyond_film,
    turned,
    turntable,
)
from rgbavatar_ns.head import turn_seen
from rgbavatar_ns.kernels import PinholeCameras
from tests.plugin.tiny import tiny_dataset

from .subject import avatar_of, lively_theta

_SIZE = 256


@pytest.fixture(scope="module")
def avatar():
    return avatar_of(num_bases=0)


@pytest.fixture(scope="module")
def seen(avatar):
    """Of a film that turns from 20 degrees right to 10 left, and hardly nods."""
    theta = lively_theta(avatar, 60)
    theta[:, avatar.layout.slice("neck")] = theta[:, avatar.layout.slice("rotation")] = 0
    theta[:, avatar.layout.slice("neck").start + 1] = torch.linspace(-10, 20, 60).deg2rad()
    camera = front_camera(avatar, _SIZE, _SIZE).world_to_camera
    return TrainingStatistics.of(theta, torch.zeros(60, 1), avatar.layout, camera)


def _moved(avatar, count: int) -> Scene:
    """A head that has walked away from the origin, with the camera that follows it."""
    theta, camera = torch.zeros(count, avatar.layout.size), front_camera(avatar, _SIZE, _SIZE)
    away = torch.tensor([0.3, -0.2, 0.4])
    theta[:, avatar.layout.slice("translation")] = away
    view = camera.world_to_camera.clone()
    view[:, :3, 3] -= view[:, :3, :3] @ away
    return Scene(theta, replace(camera, world_to_camera=view), 25.0)


def _box_px(avatar, scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    """Corners [F, 2] of what the mesh above the neck's joint covers in each picture."""
    with torch.no_grad():
        vertices = avatar.head(scene.theta, avatar.identity)
        rest = avatar.head(torch.zeros(1, avatar.layout.size), avatar.identity)[0]
    vertices = vertices[:, rest[:, 1] > avatar.head.joints(avatar.identity)[1, 1]]
    cameras: PinholeCameras = scene.cameras
    turn, move = cameras.world_to_camera[:, :3, :3], cameras.world_to_camera[:, None, :3, 3]
    placed = vertices @ turn.mT + move
    pixels = placed[..., :2] / placed[..., 2:] * cameras.focal_px[:, None]
    pixels = pixels + cameras.principal_point_px[:, None]
    return pixels.amin(1), pixels.amax(1)


def test_the_head_stays_in_the_picture_all_around(avatar, seen):
    scene = turntable(avatar, _moved(avatar, TURNTABLE_FRAMES), seen, 360.0)
    yaw = turn_seen(scene.theta, scene.cameras.world_to_camera, avatar.layout)[:, 0]
    assert torch.allclose(yaw % 360, torch.arange(72) * 5.0, atol=0.1)
    low, high = _box_px(avatar, scene)
    assert (low > 0).all()
    assert (high < _SIZE).all()
    middle = (low + high) / 2
    assert (middle - middle[0]).abs().max() < 12


def test_unasked_it_turns_as_far_as_the_film_and_thirty_degrees(avatar, seen):
    scene = turntable(avatar, _moved(avatar, 72), seen, None)
    yaw = turn_seen(scene.theta, scene.cameras.world_to_camera, avatar.layout)[:, 0]
    low, high = seen.turn_reach()
    # A head that turns to its left shows its right side.
    assert seen.turn_low[0].item() == pytest.approx(-19.4, abs=0.2)
    assert yaw.min().item() == pytest.approx(low[0].item(), abs=0.1)
    assert yaw.max().item() == pytest.approx(high[0].item(), abs=0.1)
    assert high[0] - seen.turn_high[0] == pytest.approx(30)


def test_a_turned_head_leaves_the_camera_less_room(avatar, seen):
    scene = _moved(avatar, 40)
    scene.theta[:, avatar.layout.slice("neck").start + 1] = torch.linspace(-1.0, 1.0, 40)
    pictures = orbiting(avatar, scene, seen)
    turns = turn_seen(pictures.theta, pictures.cameras.world_to_camera, avatar.layout)
    before = turn_seen(scene.theta, scene.cameras.world_to_camera, avatar.layout)
    low, high = seen.turn_reach()
    # What the performance itself turns beyond is not taken back.
    assert (turns[:, 0] >= torch.minimum(before[:, 0], low[0]) - 0.1).all()
    assert (turns[:, 0] <= torch.maximum(before[:, 0], high[0]) + 0.1).all()
    assert (turns[:, 0] - before[:, 0]).abs().max() > 20


def test_without_a_turn_the_frames_are_seen_as_they_were(avatar):
    scene, none = _moved(avatar, 5), torch.zeros(5)
    moved = turned(avatar, scene, None, none, none).cameras.world_to_camera
    assert torch.equal(moved, scene.cameras.world_to_camera.expand(5, 4, 4))


def test_a_held_frame_keeps_its_own_camera(avatar):
    scene = _moved(avatar, 3)
    views = scene.cameras.world_to_camera.repeat(3, 1, 1)
    views[:, 0, 3] = torch.arange(3.0)
    scene = replace(scene, cameras=replace(scene.cameras.select([0] * 3), world_to_camera=views))
    held = scene.held(2, 10)
    assert torch.equal(held.cameras.world_to_camera, views[2:])
    assert len(held.theta) == 10


def test_a_driver_that_several_cameras_filmed_is_smoothed_as_one_of_one_camera(tmp_path, seen):
    driver = tiny_dataset(tmp_path / "driver", frames=12, test=1)
    avatar = avatar_of(num_bases=0, arrays=driver.arrays)
    theta = driver.theta + 0.03 * torch.randn(
        driver.theta.shape, generator=torch.Generator().manual_seed(2)
    )
    alone = replace(driver, theta=theta[:4], frame_index=(0, 1, 2, 3), image_paths=[tmp_path] * 4)
    order = torch.tensor([0, 0, 0, 2, 2, 2, 1, 1, 1, 3, 3, 3])
    several = replace(
        driver,
        theta=theta[order],
        timesteps=tuple(order.tolist()),
        camera_names=tuple("abcabcabcabc"),
    )
    options = DrivingOptions(relative="off", pose="absolute", smooth=True)
    chosen = several.of_one_camera(range(len(several)))
    one, many = (
        driven_by(avatar, film, places, seen, 25.0, options).theta
        for film, places in ((alone, range(4)), (several, chosen))
    )
    assert torch.equal(many, one[[0, 2, 1, 3]])
    assert not torch.allclose(one, theta[:4], atol=0.01), "else nothing was smoothed"


def test_a_driver_is_not_smoothed_across_frames_in_which_nobody_was_found(tmp_path, seen):
    driver = tiny_dataset(tmp_path / "driver", frames=6, test=1)
    avatar = avatar_of(num_bases=0, arrays=driver.arrays)
    theta = torch.zeros_like(driver.theta)
    jaw = driver.layout.slice("jaw").start
    theta[3:, jaw] = 0.3
    options = DrivingOptions(relative="off", pose="absolute", smooth=True)

    def driven(*frame_index: int) -> torch.Tensor:
        film = replace(driver, theta=theta, frame_index=frame_index)
        return driven_by(avatar, film, range(6), seen, 25.0, options).theta[:, jaw]

    apart = driven(0, 1, 2, 100, 101, 102)
    torch.testing.assert_close(apart, theta[:, jaw], rtol=0, atol=1e-6)
    assert driven(0, 1, 2, 3, 4, 5)[3] < 0.25, "else nothing was smoothed"


def test_what_goes_beyond_the_film_is_told_and_counted(avatar, seen):
    scene = _moved(avatar, 4)
    scene.theta[:, :] = seen.theta_neutral
    scene.theta[:, avatar.layout.slice("neck")] = 0
    assert told_beyond_film(avatar, scene, seen) == ""
    scene.theta[1:, avatar.layout.slice("jaw").start] = 0.9
    scene.theta[3, avatar.layout.slice("neck").start + 1] = 0.8
    told = told_beyond_film(avatar, scene, seen)
    assert told == "beyond the film in 3 of 4 pictures: jaw[0] (3), the head's turn (1)"
    single = replace(scene, theta=scene.theta[3:])
    assert told_beyond_film(avatar, single, seen) == "beyond the film: the head's turn, jaw[0]"
