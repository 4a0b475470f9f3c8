import json

import pytest
import torch

from rgbavatar_ns.avatar.orbit import orbit
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import (
    front_camera,
    read_camera_path,
    resized,
    swing,
)
from rgbavatar_ns.kernels import PinholeCameras
from tests.avatar.small_head import front_camera as odd_camera

from .subject import avatar_of, camera_path


def _seen(cameras: PinholeCameras, point: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Image coordinates [C, 2] and depth [C] of a point in the world."""
    rotation, translation = cameras.world_to_camera[:, :3, :3], cameras.world_to_camera[:, :3, 3]
    place = rotation @ point + translation
    image = cameras.focal_px * place[:, :2] / place[:, 2:] + cameras.principal_point_px
    return image, place[:, 2]


def _eye(cameras: PinholeCameras) -> torch.Tensor:
    return torch.linalg.inv(cameras.world_to_camera)[:, :3, 3]


def test_an_orbit_keeps_the_centre_where_it_is_seen():
    camera, centre = odd_camera(32), torch.tensor([0.01, 0.02, 0.03])
    yaw, pitch = torch.tensor([0.0, 30.0, -75.0, 180.0]), torch.tensor([0.0, -10.0, 40.0, 0.0])
    cameras = orbit(camera, centre[None], yaw, pitch)
    image, depth = _seen(cameras, centre)
    expected, distance = _seen(camera, centre)
    assert torch.allclose(image, expected.expand(4, 2), atol=1e-4)
    assert torch.allclose(depth, distance.expand(4), atol=1e-6)
    assert torch.equal(cameras.world_to_camera[0], camera.world_to_camera[0])
    rotation = cameras.world_to_camera[:, :3, :3]
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).expand(4, 3, 3), atol=1e-6)


def test_views_stand_where_their_angles_say():
    yaw, pitch = torch.tensor([90.0, 0.0, 180.0]), torch.tensor([0.0, -90.0, 0.0])
    left, above, behind = _eye(orbit(odd_camera(32), torch.zeros(1, 3), yaw, pitch))
    # +x is the subject's left, y is up, the face looks along +z from where the camera stands.
    assert torch.allclose(left, torch.tensor([0.5, 0, 0]), atol=1e-6)
    assert torch.allclose(above, torch.tensor([0, 0.5, 0]), atol=1e-6)
    assert torch.allclose(behind, torch.tensor([0, 0, -0.5]), atol=1e-6)


def test_the_front_camera_sees_the_whole_head_upright():
    avatar = avatar_of(num_bases=0)
    camera = front_camera(avatar, 80, 60)
    with torch.no_grad():
        vertices = avatar.head(torch.zeros(1, avatar.layout.size), avatar.identity)[0]
    seen = torch.stack([_seen(camera, vertex)[0][0] for vertex in vertices[::40]])
    assert (seen > 0).all()
    assert (seen < torch.tensor([80.0, 60.0])).all()
    top, bottom = vertices[vertices[:, 1].argmax()], vertices[vertices[:, 1].argmin()]
    assert _seen(camera, top)[0][0, 1] < 20 < 40 < _seen(camera, bottom)[0][0, 1]
    image, _ = _seen(camera, vertices.mean(0))
    assert torch.allclose(image, torch.tensor([[40.0, 30.0]]), atol=1e-3)


def test_another_size_shows_the_old_picture_in_its_middle():
    camera, point = odd_camera(32), torch.tensor([0.03, -0.02, 0.01])
    wide = resized(camera, 128, 64)
    x, y = _seen(camera, point)[0][0].tolist()
    a, b = _seen(wide, point)[0][0].tolist()
    assert a == pytest.approx(2 * x + 32, abs=1e-4)
    assert b == pytest.approx(2 * y, abs=1e-4)
    assert (wide.width, wide.height) == (128, 64)


def test_a_swing_begins_and_ends_in_the_middle_and_reaches_its_angle():
    shares = swing(40).tolist()
    assert shares[0] == 0
    assert max(shares) == pytest.approx(1)
    assert min(shares) == pytest.approx(-1)
    step = abs(shares[1] - shares[0])
    assert abs(shares[-1] - shares[0]) == pytest.approx(step, abs=1e-6), "the loop closes"


def test_a_camera_path_gives_the_cameras_that_nerfstudio_would_render(tmp_path):
    from nerfstudio.cameras.camera_paths import get_path_from_json

    from rgbavatar_ns.plugin.cameras import from_nerfstudio

    turn = torch.linalg.qr(torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(1)))[0]
    turn = turn * torch.linalg.det(turn)[:, None, None]
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[:, :3, :3], poses[:, :3, 3] = turn, torch.tensor([[0.1, -1.0, 0.2], [0.3, 0.4, -0.5]])
    path = tmp_path / "path.json"
    path.write_text(json.dumps(camera_path(poses)))
    cameras, rate = read_camera_path(path)
    expected = from_nerfstudio(get_path_from_json(json.loads(path.read_text())))
    assert rate == 24
    for name in ("world_to_camera", "focal_px", "principal_point_px"):
        assert torch.allclose(getattr(cameras, name), getattr(expected, name), atol=1e-4), name
    assert (cameras.width, cameras.height) == (expected.width, expected.height)


def test_what_is_no_camera_path_is_refused(tmp_path):
    path = tmp_path / "path.json"
    with pytest.raises(UserError, match="no camera path"):
        read_camera_path(path)
    one = torch.eye(4)[None]
    for described, told in (
        ({}, "no camera path of nerfstudio's viewer: it has no 'camera_path'\\."),
        (camera_path(one, camera_type="fisheye"), "fisheye"),
        (camera_path(one, camera_path=[]), "0 cameras"),
        (camera_path(one, render_width=10**9), "1e\\+09"),
        (camera_path(one, render_width=True), "finite numbers"),
        (camera_path(one, fps=1e9), "frames per second"),
        (camera_path(one, camera_path=[{"camera_to_world": [1.0] * 16, "fov": 200}]), "angles"),
        (camera_path(one, camera_path=[{"camera_to_world": ["1"] * 16, "fov": 50}]), "finite"),
    ):
        path.write_text(json.dumps(described))
        with pytest.raises(UserError, match=told):
            read_camera_path(path)
