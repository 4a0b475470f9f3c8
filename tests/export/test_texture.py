"""Colours out to a UV picture and in again: bits that stay, paint that lands where it was put."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import (
    color_texture,
    draw,
    front_camera,
    read_texture,
    with_texture,
    write_texture,
)
from rgbavatar_ns.export.texture import LARGEST_SIDE_PX
from rgbavatar_ns.export.unfolding import unfolded, unfolded_view
from rgbavatar_ns.kernels import weighted_color_average

from .subject import avatar_of, lively_theta

_WHITE = (1.0, 1.0, 1.0)
_BLUE, _ORANGE = (10, 60, 240), (250, 160, 20)


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return avatar_of(uv_resolution=64)


def _colors(avatar: Avatar) -> torch.Tensor:
    return avatar.blendshapes.color_feature.detach()


def _seen_flat(avatar: Avatar) -> torch.Tensor:
    """Which Gaussians show when the head is looked at straight from above everywhere."""
    flat, view = unfolded(avatar), unfolded_view(256, avatar.identity)
    found = weighted_color_average(flat, view, torch.ones(1, 256, 256, 1))
    return found.weight_sum.flatten() > 1


def test_an_unpainted_picture_changes_no_bit_whatever_its_size(avatar):
    for side_px in (None, 64, 200, 512):
        picture = color_texture(avatar, side_px)
        assert picture[..., :3].std() > 20
        same = with_texture(avatar, picture)
        assert torch.equal(_colors(same), _colors(avatar))
        # Nor does a level of rounding, nor alpha thrown away.
        nearly = picture.copy()
        nearly[..., :3] += (nearly[..., :3] < 255).astype(np.uint8)
        nearly[..., 3] = 255
        assert torch.equal(_colors(with_texture(avatar, nearly)), _colors(avatar))


def test_the_picture_is_upright_with_u_to_the_right():
    avatar = avatar_of(uv_resolution=64, num_bases=0)
    rows, columns = avatar.anchors.texel_row_col.unbind(1)
    u, v = (columns + 0.5) / 64, 1 - (rows + 0.5) / 64
    with torch.no_grad():
        avatar.blendshapes.position.zero_()
        color = torch.stack([u, v, torch.full_like(u, 0.25)], 1)
        avatar.blendshapes.color_feature.copy_((color - 0.5) / 0.28209479177387814)
    picture = color_texture(avatar, 128).astype(float) / 255
    place = (np.arange(128) + 0.5) / 128
    inside = cv2.erode(picture[..., 3], np.ones((9, 9))) == 1
    assert inside.mean() > 0.3
    wanted = np.stack([*np.meshgrid(place, 1 - place), np.full((128, 128), 0.25)], -1)
    # Gaussians are a texel or two wide, and mix what lies under them.
    assert np.abs(picture[..., :3] - wanted)[inside].mean() < 0.5 / 64
    assert np.quantile(np.abs(picture[..., :3] - wanted)[inside], 0.99) < 2 / 64


def test_a_gaussian_unfolds_to_the_uv_of_the_point_of_its_triangle_that_it_lies_on(avatar):
    """Moved from its anchor to the triangle's centroid: the corners' mean in UV, worked by hand."""
    moved = avatar_of(uv_resolution=64, num_bases=0)
    rest = torch.zeros(1, moved.layout.size)
    triangle = moved.anchors.triangle_index
    with torch.no_grad():
        vertices = moved.carrier_vertices(rest)
        frames = moved.anchors.frames(vertices)
        centroid = vertices[0, moved.head.faces[triangle]].mean(1)
        offset = (centroid - frames.origin[0])[..., None]
        moved.blendshapes.position.copy_(torch.linalg.solve(frames.matrix[0], offset)[..., 0])
    uv = moved.head.uv[moved.head.uv_faces[triangle]].mean(1)
    wanted = torch.stack([uv[:, 0] - 0.5, 0.5 - uv[:, 1]], 1)
    assert torch.allclose(unfolded(moved).means[0, :, :2], wanted, atol=2e-5)


def _checks(side_px: int, squares: int) -> np.ndarray:
    """A chequerboard's second colour."""
    index = np.arange(side_px) * squares // side_px
    return (index[:, None] + index) % 2 == 1


def _uv_of_pixels(
    avatar: Avatar, theta: torch.Tensor, side_px: int
) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels of the front view hit the mesh face on, and the UV there, by trimesh's rays."""
    camera = front_camera(avatar, side_px, side_px)
    view = camera.world_to_camera[0].double().numpy()
    pixel = np.stack(np.meshgrid(*[np.arange(side_px) + 0.5] * 2), -1).reshape(-1, 2)
    principal, focal = camera.principal_point_px[0].numpy(), camera.focal_px[0].numpy()
    direction = np.concatenate([(pixel - principal) / focal, np.ones((len(pixel), 1))], 1)
    with torch.no_grad():
        vertices = avatar.carrier_vertices(theta)[0].double().numpy()
    mesh = trimesh.Trimesh(vertices, avatar.head.faces.numpy(), process=False)
    origin = np.tile(-view[:3, :3].T @ view[:3, 3], (len(pixel), 1))
    direction = direction @ view[:3, :3]
    points, ray, face = mesh.ray.intersects_location(origin, direction, multiple_hits=False)
    # Up to 60 degrees aslant; beyond, Gaussians hide what lies behind them on the surface.
    facing = -(mesh.face_normals[face] * direction[ray]).sum(1)
    facing = facing > 0.5 * np.linalg.norm(direction[ray], axis=1)
    points, ray, face = points[facing], ray[facing], face[facing]
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], points)
    corners = avatar.head.uv.numpy()[avatar.head.uv_faces.numpy()[face]]
    return ray, (corners * weights[..., None]).sum(1)


def test_paint_shows_at_its_uv_place_at_rest_and_in_an_expression():
    """The Gaussians lie beside their anchors, but on the surface, so that none hides another."""
    avatar = avatar_of(uv_resolution=64)
    with torch.no_grad():
        avatar.blendshapes.position[:, 2] = 0
        avatar.blendshapes.basis_position.zero_()
        avatar.blendshapes.log_scale.sub_(0.3)
    squares, side_px = 8, 256
    picture = color_texture(avatar, side_px)
    blue = _checks(side_px, squares)
    picture[..., :3] = np.where(blue[..., None], _BLUE, _ORANGE)
    painted = with_texture(avatar, picture)
    for theta in (torch.zeros(1, avatar.layout.size), lively_theta(avatar, 1)):
        ray, uv = _uv_of_pixels(avatar, theta, 128)
        image = draw(painted, theta, front_camera(avatar, 128, 128), _WHITE).image
        shown = image[0].numpy().reshape(-1, 3)[ray]
        # A quarter of a square from its edge; closer, Gaussians of a texel show both colours.
        within = (np.abs((uv * squares) % 1 - 0.5) < 0.25).all(1)
        column, row = (uv * [1, -1] + [0, 1]).T * side_px
        wanted = blue[row.astype(int), column.astype(int)]
        agrees = (shown[:, 2] > shown[:, 0]) == wanted
        assert within.sum() > 500
        # The rest lies in the eyes and between the lips, which have few texels.
        assert agrees[within].mean() > 0.95
        unpainted = draw(avatar, theta, front_camera(avatar, 128, 128), _WHITE).image
        before = unpainted[0].numpy().reshape(-1, 3)[ray]
        assert ((before[:, 2] > before[:, 0]) == wanted)[within].mean() < 0.7


def test_what_lies_away_from_the_paint_keeps_its_bits(avatar):
    picture = color_texture(avatar)
    side_px = len(picture)
    first, end = side_px * 2 // 5, side_px * 3 // 5
    picture[first:end, first:end, :3] = _BLUE
    changed = (_colors(with_texture(avatar, picture)) != _colors(avatar)).any(1)
    # The painted square's middle is the layout's, and it is a fifth wide.
    aside = unfolded(avatar).means[0, :, :2].abs().amax(1) - 0.1
    far = aside * avatar.anchors.resolution > 1.5
    assert not changed[far].any()
    assert far.float().mean() > 0.5
    assert changed[aside < 0].float().mean() > 0.9


def test_a_shift_of_all_colours_keeps_every_difference_between_gaussians(avatar):
    picture = color_texture(avatar)
    picture[..., :3] += 20
    difference = (_colors(with_texture(avatar, picture)) - _colors(avatar)) * 0.28209479
    seen = _seen_flat(avatar)
    assert seen.float().mean() > 0.8
    assert torch.allclose(difference[seen], torch.full((3,), 20 / 255), atol=2e-3)


def test_alpha_says_how_much_of_the_paint_counts(avatar):
    picture = color_texture(avatar)
    picture[..., :3] += 20
    changes = {}
    for alpha in (0, 51, 255):
        picture[..., 3] = alpha
        changes[alpha] = _colors(with_texture(avatar, picture)) - _colors(avatar)
    assert not changes[0].any()
    assert changes[255].abs().max() > 0.2
    assert torch.allclose(changes[51], changes[255] / 5, atol=1e-4)


def test_fine_dark_paint_lightens_nothing_and_darkens_no_more_than_it_is_dark(avatar):
    picture = color_texture(avatar)
    dark = _checks(len(picture), 64)
    picture[..., :3] -= np.minimum(picture[..., :3], 60) * dark[..., None]
    added = 0.28209479 * (_colors(with_texture(avatar, picture)) - _colors(avatar))
    assert added.max() <= 0
    assert -60 / 255 - 1e-6 <= added.min() < -50 / 255


def test_files_of_8_and_16_bits_with_and_without_alpha_say_the_same(avatar, tmp_path):
    wires = write_texture(tmp_path / "me.png", avatar)
    picture = read_texture(tmp_path / "me.png")
    assert np.array_equal(picture, color_texture(avatar))
    assert read_texture(wires).shape == picture.shape
    assert np.isin(picture[..., 3], (0, 255)).all()
    opaque = np.full_like(picture[..., :1], 255)
    bgr = picture[..., 2::-1]
    for name, content in (
        ("rgb", bgr),
        ("rgb16", bgr.astype(np.uint16) * 257),
        ("rgba16", np.concatenate([bgr, opaque], 2).astype(np.uint16) * 257),
    ):
        path = tmp_path / f"{name}.png"
        cv2.imwrite(str(path), content)
        read = read_texture(path)
        assert np.array_equal(read, np.concatenate([picture[..., :3], opaque], 2))


def _written(folder: Path, picture: np.ndarray) -> Path:
    cv2.imwrite(str(folder / "a.png"), picture)
    return folder / "a.png"


def test_what_is_no_texture_is_refused(avatar, tmp_path):
    with pytest.raises(UserError, match="48 x 64 pixels"):
        with_texture(avatar, read_texture(_written(tmp_path, np.zeros((64, 48, 3), np.uint8))))
    with pytest.raises(UserError, match="too large"):
        read_texture(_written(tmp_path, np.zeros((1, LARGEST_SIDE_PX + 1), np.uint8)))
    with pytest.raises(UserError, match="out of range"):
        with_texture(avatar, read_texture(_written(tmp_path, np.zeros((4, 4, 3), np.uint8))))
    with pytest.raises(UserError, match="missing"):
        read_texture(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("no picture at all, but a text of more than 33 bytes")
    with pytest.raises(UserError, match="not a PNG"):
        read_texture(tmp_path / "text.png")
    cut = write_texture(tmp_path / "me.png", avatar).read_bytes()
    (tmp_path / "cut.png").write_bytes(cut[: len(cut) // 2])
    with pytest.raises(UserError, match="truncated"):
        read_texture(tmp_path / "cut.png")
