"""The two worlds and camera conventions agree on where a point is seen."""

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.plugin.cameras import from_nerfstudio, head_to_nerfstudio, to_nerfstudio


def _cameras(count: int) -> PinholeCameras:
    generator = torch.Generator().manual_seed(3)
    world_to_camera = torch.eye(4).repeat(count, 1, 1)
    random = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator))[0]
    world_to_camera[:, :3, :3] = random * torch.linalg.det(random)[:, None, None].sign()
    world_to_camera[:, :3, 3] = torch.randn(count, 3, generator=generator)
    return PinholeCameras(
        world_to_camera=world_to_camera,
        focal_px=torch.rand(count, 2, generator=generator) * 100 + 50,
        principal_point_px=torch.rand(count, 2, generator=generator) * 20 + 10,
        width=40,
        height=30,
    )


def _to_nerfstudio(cameras: PinholeCameras, count: int) -> Cameras:
    return to_nerfstudio(
        cameras,
        theta=torch.arange(count * 2.0).reshape(count, 2),
        position=torch.arange(float(count))[:, None],
        times=torch.linspace(0, 1, count),
    )


def test_the_way_there_and_back_changes_nothing():
    cameras = _cameras(5)
    back = from_nerfstudio(_to_nerfstudio(cameras, 5))
    torch.testing.assert_close(back.world_to_camera, cameras.world_to_camera, atol=1e-5, rtol=0)
    assert torch.equal(back.focal_px, cameras.focal_px)
    assert torch.equal(back.principal_point_px, cameras.principal_point_px)
    assert (back.width, back.height) == (40, 30)


def test_nerfstudios_own_rays_hit_the_point_that_our_camera_projects():
    cameras, count = _cameras(4), 4
    points = torch.randn(100, 3, generator=torch.Generator().manual_seed(1))
    theirs = _to_nerfstudio(cameras, count)
    for i in range(count):
        seen = points @ cameras.world_to_camera[i, :3, :3].T + cameras.world_to_camera[i, :3, 3]
        front = seen[:, 2] > 0.2
        pixel = seen[:, :2] / seen[:, 2:] * cameras.focal_px[i] + cameras.principal_point_px[i]
        rows_columns = pixel[front].flip(-1)
        indices = torch.full((len(rows_columns), 1), i)
        rays = theirs.generate_rays(camera_indices=indices, coords=rows_columns)
        expected = head_to_nerfstudio(points[front]) - rays.origins
        expected = expected / expected.norm(dim=-1, keepdim=True)
        torch.testing.assert_close(rays.directions, expected, atol=1e-4, rtol=0)


def test_up_is_z_and_the_face_looks_along_minus_y():
    axes = head_to_nerfstudio(torch.eye(3))
    assert torch.equal(axes, torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))


def test_one_camera_stands_for_all_frames():
    shared = to_nerfstudio(
        _cameras(1), theta=torch.zeros(7, 2), position=torch.zeros(7, 1), times=torch.zeros(7)
    )
    assert len(shared) == 7
    assert torch.equal(shared.camera_to_worlds[0], shared.camera_to_worlds[6])


def test_theta_and_position_follow_a_choice_of_cameras():
    chosen = _to_nerfstudio(_cameras(6), 6)[torch.tensor([4, 1])]
    assert chosen.metadata is not None
    assert chosen.metadata["position"].tolist() == [[4.0], [1.0]]
    assert chosen.metadata["theta"].tolist() == [[8.0, 9.0], [2.0, 3.0]]


def test_other_lenses_are_refused():
    theirs = _to_nerfstudio(_cameras(2), 2)
    theirs.camera_type = torch.full((2, 1), CameraType.FISHEYE.value)
    with pytest.raises(UserError, match="perspective"):
        from_nerfstudio(theirs)
