import numpy as np
import pytest
import torch

from rgbavatar_ns.drawing.compositing import (
    all_filmed,
    composite,
    error_strip,
    film_over,
    is_unfilmed,
    rgba_to_float,
    straight_alpha,
    to_uint8,
    unfilmed_pixels,
)
from rgbavatar_ns.drawing.contact_sheet import contact_sheet, labelled, over_gray_bgr, scaled
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA


def test_composite_by_hand():
    rgba = torch.tensor([[[[1.0, 0.5, 0.0, 0.25]]], [[[0.0, 1.0, 0.5, 1.0]]]])
    background = torch.tensor([[0.0, 0.5, 1.0], [1.0, 1.0, 1.0]])
    expected = torch.tensor([[[[0.25, 0.5, 0.75]]], [[[0.0, 1.0, 0.5]]]])
    torch.testing.assert_close(composite(rgba, background), expected)


def test_composite_over_one_color_for_all_or_of_one_image():
    rgba = torch.rand(2, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    black = composite(rgba, torch.zeros(3))
    torch.testing.assert_close(black, rgba[..., :3] * rgba[..., 3:])
    assert torch.equal(composite(rgba[0], torch.zeros(3)), black[0])


def test_straight_alpha_is_the_inverse_of_black_behind():
    rgba = torch.rand(3, 4, 4, generator=torch.Generator().manual_seed(1))
    rgba[0] = 0
    image = composite(rgba, torch.zeros(3))
    torch.testing.assert_close(straight_alpha(image, rgba[..., 3:]), rgba)


def test_bytes_and_values_are_each_others_inverse():
    every = torch.arange(256, dtype=torch.uint8).reshape(8, 8, 4)
    assert torch.equal(torch.from_numpy(to_uint8(rgba_to_float(every))), every)
    assert to_uint8(torch.tensor([[[-1.0, 2.0, 0.5]]])).tolist() == [[[0, 255, 128]]]


def test_an_error_strip_shows_four_times_the_error():
    film = torch.ones(1, 2, 3, 4)
    film[..., :3] = 0.5
    truth, black = film[..., :3], torch.zeros(3)
    for part, value in zip(error_strip(film, truth - 0.1, black), (0.5, 0.4, 0.4)):
        torch.testing.assert_close(part, torch.full_like(truth, value))
    assert error_strip(film, truth + 0.6, black).max() == 1


def marked(*shape: int) -> torch.Tensor:
    return torch.tensor(UNFILMED_RGBA, dtype=torch.uint8).expand(*shape, 4)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.float64])
def test_only_the_exact_mark_is_unfilmed(dtype):
    """Each neighbour by one level, and the same colour with any alpha, was filmed."""
    near = marked(2, 4).int() + torch.stack([torch.eye(4), -torch.eye(4)]).int()
    rgba = torch.cat([near.clamp(0, 255).to(torch.uint8), marked(2, 1)], 1)
    given = rgba if dtype == torch.uint8 else rgba_to_float(rgba, dtype)
    found = is_unfilmed(given)
    # One below an alpha of 0 is 0 again.
    assert found.tolist() == [[False] * 4 + [True], [False] * 3 + [True] * 2]
    if dtype == torch.uint8:
        picture = rgba.numpy()
        assert np.array_equal(unfilmed_pixels(picture), found.numpy())
        cleared = all_filmed(picture)
        assert not unfilmed_pixels(cleared).any()
        assert np.array_equal(cleared[~found.numpy()], picture[~found.numpy()])
        assert not cleared[found.numpy()].any()


def test_what_nobody_filmed_is_background_and_no_error():
    rgba = torch.cat([marked(2, 1), torch.full((2, 2, 4), 255, dtype=torch.uint8)], 1)
    image, sky = torch.full((2, 3, 3), 0.3), torch.tensor([0.2, 0.4, 0.6])
    film, _, error = error_strip(rgba, image, sky)
    torch.testing.assert_close(film[:, 0], sky.expand(2, 3))
    assert not error[:, 0].any()
    assert (error[:, 1:] == 1).all()
    over = film_over(rgba, sky, image)
    assert torch.equal(over[:, 0], image[:, 0])
    assert torch.equal(over[:, 1:], torch.ones(2, 2, 3))


def test_a_contact_sheet_hatches_what_nobody_filmed():
    image = np.zeros((96, 96, 4), np.uint8)
    image[48:] = UNFILMED_RGBA
    drawn = over_gray_bgr(image, 1.0)
    assert (drawn[:48] == 128).all()
    assert set(np.unique(drawn[48:])) == {80, 128}
    assert 0.4 < (drawn[48:] == 80).mean() < 0.6


@pytest.mark.parametrize("channels", [3, 4])
def test_a_contact_sheet_fills_its_last_row(channels):
    tiles = [np.full((4, 6, channels), value, np.uint8) for value in (1, 2, 3)]
    sheet = contact_sheet(tiles, 2, blank=9)
    assert sheet.shape == (8, 12, channels)
    assert sheet[::4, ::6, 0].tolist() == [[1, 2], [3, 9]]
    assert contact_sheet(tiles, 7).shape == (4, 18, channels)


def test_a_label_is_legible_on_black_and_on_white():
    for value in (0, 255):
        picture = np.full((320, 320, 4), (value, value, value, 0), np.uint8)
        written = labelled(picture, "17  IoU 0.93")
        assert not picture[..., 3].any()
        text = written[written[..., 3] > 128][:, 0]
        assert text.min() < 10
        assert text.max() > 200
        assert not written[40:, :, 3].any()


def test_a_matted_picture_lies_over_gray_blue_first():
    image = np.zeros((4, 6, 4), np.uint8)
    image[:, 3:] = (200, 100, 50, 255)
    drawn = over_gray_bgr(image, 2.0)
    assert drawn.shape == (8, 12, 3)
    assert drawn[0, 0].tolist() == [128] * 3
    assert drawn[0, -1].tolist() == [50, 100, 200]
    assert scaled(drawn, 0.01).shape == (1, 1, 3)
