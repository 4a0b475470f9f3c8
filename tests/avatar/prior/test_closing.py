"""Closed pictures: holes take the colour around them, noise goes, a plain picture stays."""

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar.prior.closing import closed, closed_on_device, with_light_of

WIDTH, HEIGHT = 256, 40


def test_a_plain_picture_stays_and_holes_take_its_colour():
    color = np.array([0.8, 0.4, 0.2])
    alpha = np.ones((HEIGHT, WIDTH, 1))
    alpha[10:14, 100:104] = 0
    alpha[20:30, 50:60] = 0.3
    found = closed(np.dstack([color * alpha, alpha]), WIDTH)
    assert found.shape == (HEIGHT, WIDTH, 4)
    assert (found[..., 3] == 255).all()
    assert np.abs(found[..., :3] / 255 - color).max() < 0.5 / 255 + 1e-3


def test_noise_of_hue_goes_and_edges_of_light_stay():
    hue = 0.1 * np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3))
    hue -= hue.mean(-1, keepdims=True)
    light = np.full((HEIGHT, WIDTH, 1), 0.3)
    light[:, WIDTH // 2 :] = 0.7
    found = closed(np.dstack([light + hue, np.ones_like(light)]), WIDTH)[..., :3] / 255
    inner = slice(12, HEIGHT - 12), slice(12, WIDTH - 12)
    left = found - found.mean(-1, keepdims=True)
    # A Gaussian's blur of 3 pixels leaves 1 / (2 sqrt(pi) 3) of the deviation of white noise.
    assert 0.5 / 10.6 < left[inner].std() / hue[inner].std() < 1.5 / 10.6
    # From dark to bright in a few pixels: 80 % of the step within +-2.
    row, middle = found[HEIGHT // 2].mean(-1), WIDTH // 2
    assert row[middle + 2] - row[middle - 3] > 0.8 * 0.4


def test_the_blur_follows_the_pictures_width():
    def reach(width: int) -> int:
        image = np.zeros((16, width, 4))
        image[:, width // 2 :, 0] = 1
        image[..., 3] = 1
        found = closed(image, width)[8] / 255
        hue = found[:, 0] - found[:, 1]
        return int(((hue > 0.05) & (hue < 0.95)).sum())

    assert 1.7 < reach(512) / reach(256) < 2.3


@pytest.mark.parametrize(
    ("rows", "columns", "width"), [(40, 256, 256), (123, 77, 512), (9, 31, 800)]
)
def test_a_device_closes_as_opencv_does(rows, columns, width):
    random = np.random.default_rng(0)
    alpha = (random.random((rows, columns, 1)) > 0.3) * random.random((rows, columns, 1))
    image = np.dstack([random.random((rows, columns, 3)) * alpha, alpha]).astype(np.float32)
    expected = closed(image, width).astype(int)
    found = closed_on_device(torch.from_numpy(image), width).numpy().astype(int)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= 1
    assert (found != expected).mean() < 0.1


def test_light_comes_back_by_its_share_and_hue_stays_plain():
    own = torch.tensor([[0.2, 0.5, 0.5, 1.0], [0.1, 0.25, 0.25, 0.5], [0.0, 0.0, 0.0, 0.0]])[None]
    plain = torch.tensor([30, 60, 90, 255], dtype=torch.uint8).expand(1, 3, 4)
    # By hand: own light .4 is 102 levels, plain light 60.
    whole = with_light_of(own, plain, torch.ones(1, 3))
    assert whole[0].tolist() == [[72, 102, 132, 255], [51, 81, 111, 255], [30, 60, 90, 255]]
    assert torch.equal(with_light_of(own, plain, torch.zeros(1, 3)), plain)
