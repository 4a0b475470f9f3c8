"""Sharpness against the film: what it is to say, and what must not move it."""

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion, gaussian_filter
from torch import Tensor

from rgbavatar_ns.avatar.metrics import detail_energy, evaluate_images, with_sharpness

SIDE = 64


@pytest.fixture
def film() -> Tensor:
    """Two matted frames of structure of many sizes, RGBA in [0, 1]; a round person."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(2, SIDE, SIDE, 3))
    sizes = [gaussian_filter(noise, (0, s, s, 0)) * s for s in (0.7, 1.5, 4)]
    color = 0.5 + 0.1 * sum(sizes)
    row, column = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    alpha = np.broadcast_to(row**2 + column**2 < 26**2, (2, SIDE, SIDE))
    return torch.from_numpy(np.concatenate([color.clip(0.05, 0.95), alpha[..., None]], -1))


def _sharpness(image: Tensor, film: Tensor) -> float:
    return with_sharpness(evaluate_images(image, film))["sharpness"]


def _over_black(film: Tensor) -> Tensor:
    return film[..., :3] * film[..., 3:]


def _blurred(film: Tensor, sigma_px: float) -> Tensor:
    sigma = (0, sigma_px, sigma_px, 0)
    return torch.from_numpy(gaussian_filter(film[..., :3].numpy(), sigma)) * film[..., 3:]


def test_the_film_is_as_sharp_as_itself(film: Tensor):
    assert _sharpness(_over_black(film), film) == 1


def test_blur_lowers_it_the_more_the_wider(film: Tensor):
    seen = [_sharpness(_blurred(film, sigma), film) for sigma in (0.3, 0.6, 1.0, 2.0, 4.0)]
    assert [1.0, *seen] == sorted([1.0, *seen], reverse=True)
    assert seen[0] < 1
    assert seen[-1] < 0.05


def test_noise_raises_it_by_its_own_energy(film: Tensor):
    """Of white noise the blur keeps sum(taps^2): the difference has 1 - 2 tap_0 + that."""
    sigma = 0.05
    noise = torch.from_numpy(np.random.default_rng(4).normal(0, sigma, (2, SIDE, SIDE, 3)))
    inside = film[..., 3] > 0
    base = _over_black(film)
    assert _sharpness((base + noise).clamp(0, 1), film) > 1
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    taps = np.outer(taps, taps) / taps.sum() ** 2
    counted = np.stack([binary_erosion(m, np.ones((11, 11))) for m in inside.numpy()])
    expected = sigma**2 * (1 - 2 * taps[5, 5] + (taps**2).sum()) * counted.mean()
    assert float(detail_energy(noise, inside).mean()) == pytest.approx(expected, rel=0.05)


def test_brightness_changes_nothing(film: Tensor):
    """Of the whole picture or of the person alone."""
    dim = film.clone()
    dim[..., :3] = 0.8 * film[..., :3]
    whole = _over_black(dim) + 0.1
    person = (dim[..., :3] + 0.1) * film[..., 3:]
    expected = _sharpness(_over_black(dim), dim)
    assert expected == 1
    assert _sharpness(whole, dim) == pytest.approx(1, rel=1e-9)
    assert _sharpness(person, dim) == pytest.approx(1, rel=1e-9)


def test_what_lies_beyond_the_person_changes_nothing(film: Tensor):
    beside = _over_black(film)
    beside[film[..., 3] == 0] = torch.rand(int((film[..., 3] == 0).sum()), 3).double()
    assert _sharpness(beside, film) == 1


def test_the_energy_is_scipys(film: Tensor):
    """float64, by an independent blur with the same window."""
    image = _over_black(film)
    blurred = gaussian_filter(image.numpy(), (0, 1.5, 1.5, 0), radius=(0, 5, 5, 0))
    inside = film[..., 3].numpy() > 0.5
    counted = np.stack([binary_erosion(m, np.ones((11, 11))) for m in inside])
    squared = ((image.numpy() - blurred) ** 2).mean(-1) * counted
    seen = detail_energy(image, torch.from_numpy(inside))
    np.testing.assert_allclose(seen.numpy(), squared.mean((1, 2)), rtol=1e-6)


def test_frames_count_by_their_energy(film: Tensor):
    """A frame without structure, blurred by motion say, has no say; all without: no figure."""
    flat = film.clone()
    flat[1, ..., :3] = 0.5
    image = _over_black(flat)
    image[0] = _blurred(film, 1.0)[0]
    alone = _sharpness(image[:1], flat[:1])
    assert 0 < alone < 1
    assert _sharpness(image, flat) == pytest.approx(alone, rel=1e-9)
    assert "sharpness" not in with_sharpness({"detail": 0.0, "detail_film": 0.0})
    named = with_sharpness(
        {"psnr": 30.0, "detail_refined": 1.0, "detail_film_refined": 4.0}, "_refined"
    )
    assert named == {"psnr": 30.0, "sharpness_refined": 0.25}
