"""Where cameras have points of the world."""

import torch

from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.kernels.constants import NEAR_PLANE_M
from rgbavatar_ns.kernels.reference import project
from tests.kernels.scenes import random_scene


def test_points_are_where_the_rasterizer_projects_them():
    scene = random_scene(3, batch=2, count=300, num_cameras=2)
    projected = project(scene.gaussians, scene.cameras)
    found = scene.cameras.project(scene.gaussians.means)
    torch.testing.assert_close(found[projected.visible], projected.mean_px[projected.visible])
    depth = scene.cameras.placed(scene.gaussians.means)[..., 2]
    torch.testing.assert_close(depth[projected.visible], projected.depth_m[projected.visible])


def test_what_cameras_show_is_where_the_rasterizer_projects():
    scene = random_scene(3, batch=2, count=300, num_cameras=2)
    projected = project(scene.gaussians, scene.cameras)
    x, y = projected.mean_px.unbind(-1)
    inside = (x >= 0) & (x <= scene.cameras.width) & (y >= 0) & (y <= scene.cameras.height)
    # The rasterizer draws no transparent ones, of which the place says nothing.
    judged = scene.gaussians.opacities > 0.01
    found = scene.cameras.shows(scene.gaussians.means)
    assert torch.equal(found[judged], (inside & projected.visible)[judged])
    assert 0.1 < found.double().mean() < 0.95
    behind = (scene.gaussians.means @ scene.cameras.world_to_camera[:, :3, :3].mT)[..., 2] < -2.4
    assert behind.any()
    assert not found[behind].any()


def test_a_place_worked_by_hand_and_what_lies_behind_is_a_number_that_is_not_shown():
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # looks along x
    world_to_camera[:3, 3] = torch.tensor([0.0, 0.0, 1.0])
    cameras = PinholeCameras(
        world_to_camera[None],
        torch.tensor([[100.0, 200.0]]).double(),
        torch.tensor([[32.0, 24.0]]).double(),
        width=64,
        height=48,
    )
    points = torch.tensor([[[1.0, 0.125, -0.25], [-2.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]]).double()
    assert cameras.placed(points)[0].tolist() == [[0.25, 0.125, 2.0], [0, 0, -1], [0, 0, 0]]
    wanted = [[100 * 0.25 / 2 + 32, 200 * 0.125 / 2 + 24], [32, 24], [32, 24]]
    torch.testing.assert_close(cameras.project(points)[0], torch.tensor(wanted).double())
    assert cameras.shows(points)[0].tolist() == [True, False, False]
    before = torch.tensor([[[NEAR_PLANE_M * 1.01 - 1, 0, 0], [NEAR_PLANE_M * 0.99 - 1, 0, 0]]])
    assert cameras.shows(before.double())[0].tolist() == [True, False]
