import av
import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.data.png import read_png_rgba
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import (
    basis_grid,
    draw,
    front_camera,
    pictures,
    write_gif,
    write_png,
    write_pngs,
)
from rgbavatar_ns.export.bases import single_bases
from rgbavatar_ns.kernels import PinholeCameras

from .subject import avatar_of, lively_theta, psnr


@pytest.fixture(scope="module")
def avatar():
    return avatar_of()


@pytest.fixture(scope="module")
def camera(avatar):
    return front_camera(avatar, 48, 40)


def test_straight_alpha_laid_over_a_colour_is_the_picture_on_that_colour(avatar, camera):
    theta = lively_theta(avatar, 2)
    for color in ((1.0, 1.0, 1.0), (0.1, 0.7, 0.3)):
        over = list(pictures(avatar, theta, camera, color))
        for rgba, expected in zip(pictures(avatar, theta, camera, None), over):
            alpha = rgba[..., 3:] / 255
            laid = rgba[..., :3] * alpha + 255 * np.array(color) * (1 - alpha)
            # Colour and alpha are each rounded to bytes, and colours beyond [0, 1] are cut.
            assert np.abs(laid - expected).mean() < 1
            assert psnr(laid / 255, expected / 255.0) > 40
            assert rgba[0, 0, 3] == 0
            assert rgba[..., 3].max() == 255


def test_a_film_in_pieces_equals_single_pictures(avatar, camera):
    theta = lively_theta(avatar, 11)
    world_to_camera = camera.world_to_camera.repeat(11, 1, 1)
    world_to_camera[:, 0, 3] += torch.linspace(-0.02, 0.02, 11)
    moving = PinholeCameras(
        world_to_camera, camera.focal_px.expand(11, 2), camera.principal_point_px.expand(11, 2),
        camera.width, camera.height,
    )  # fmt: skip
    film = list(pictures(avatar, theta, moving, (0.0, 0.0, 0.0)))
    assert len(film) == 11
    for frame in (0, 7, 8, 10):
        one = next(
            pictures(avatar, theta[frame : frame + 1], moving.select([frame]), (0.0, 0.0, 0.0))
        )
        assert np.abs(film[frame].astype(int) - one).max() <= 1


def test_the_networks_own_weights_change_nothing_and_others_do(avatar, camera):
    theta = lively_theta(avatar, 2)
    with torch.no_grad():
        psi = avatar.weights(theta)
    plain = draw(avatar, theta, camera).image
    assert torch.equal(draw(avatar, theta, camera, psi=psi).image, plain)
    assert (draw(avatar, theta, camera, psi=psi + 0.5).image - plain).abs().max() > 0.05


def test_each_basis_is_shown_alone_at_its_largest_weight():
    low, high = torch.tensor([-0.5, -0.1]), torch.tensor([0.2, 0.4])
    zero = torch.zeros(2)
    seen = TrainingStatistics(
        1, zero, zero, zero, zero, zero, zero, zero, low, high,
        torch.ones(2, dtype=torch.bool), torch.zeros(0, 2), torch.zeros(0), torch.zeros(0),
    )  # fmt: skip
    expected = torch.tensor([[0.0, 0.0], [-1.0, 0.0], [0.0, 0.8]])
    assert torch.allclose(single_bases(seen, 2.0), expected)


def test_the_grid_holds_the_base_and_every_basis(avatar, camera):
    theta = lively_theta(avatar, 20)
    with torch.no_grad():
        seen = TrainingStatistics.of(theta, avatar.weights(theta), avatar.layout)
    grid = basis_grid(avatar, seen, camera, gain=20.0, columns=3).astype(int)
    assert grid.shape == (2 * 40, 3 * 96, 3)
    base = grid[15:40, :48]
    for k in range(1, 5):
        row, column = divmod(k, 3)
        tile = grid[40 * row + 15 : 40 * row + 40, 96 * column : 96 * column + 96]
        other, change = tile[:, :48], tile[:, 48:]
        assert np.abs(other - base).max() > 20, f"basis {k - 1} shows nothing"
        assert np.array_equal(change, np.clip(128 + 2 * (other - base), 0, 255))
    assert (grid[40:, 192:] == 255).all(), "the last row is filled up"
    with pytest.raises(UserError, match="no learned bases"):
        basis_grid(avatar_of(num_bases=0), seen, camera)


def test_a_weak_basis_is_made_strong_enough_to_be_seen(avatar, camera):
    theta = lively_theta(avatar, 20)
    with torch.no_grad():
        seen = TrainingStatistics.of(theta, avatar.weights(theta), avatar.layout)
    plain, strong = (
        basis_grid(avatar, seen, camera, gain=gain, columns=5).astype(int) for gain in (1.0, None)
    )
    for k in range(1, 5):
        change = [np.abs(g[:, 96 * k + 48 : 96 * k + 96] - 128).max(-1) for g in (plain, strong)]
        assert change[0].max() < 60, "hardly seen as it is"
        assert 0.005 < (change[1] >= 120).mean() < 0.3, "clearly seen, but not torn to pieces"


def test_a_gif_has_the_frames_and_nearly_their_colours(tmp_path, avatar, camera):
    frames = list(pictures(avatar, lively_theta(avatar, 5), camera, (1.0, 1.0, 1.0)))
    assert write_gif(tmp_path / "film.gif", iter(frames), 10.0) == 5
    with av.open(str(tmp_path / "film.gif")) as container:
        assert float(container.streams.video[0].average_rate or 0) == pytest.approx(10, rel=0.05)
        read = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
    assert len(read) == 5
    for ours, theirs in zip(frames, read):
        assert psnr(ours / 255.0, theirs / 255.0) > 25
    assert [p.name for p in tmp_path.iterdir()] == ["film.gif"]


def test_pngs_keep_every_byte(tmp_path):
    rng = np.random.default_rng(0)
    rgba = [rng.integers(0, 256, (5, 4, 4), dtype=np.uint8) for _ in range(2)]
    assert write_pngs(tmp_path / "film", iter(rgba)) == 2
    for place, picture in enumerate(rgba):
        assert np.array_equal(read_png_rgba(tmp_path / "film" / f"{place:05d}.png"), picture)
    write_png(tmp_path / "rgb.png", rgba[0][..., :3])
    assert np.array_equal(cv2.imread(str(tmp_path / "rgb.png"))[..., ::-1], rgba[0][..., :3])


def test_a_place_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="Cannot write"):
        write_png(tmp_path / "file" / "a.png", np.zeros((2, 2, 3), np.uint8))
