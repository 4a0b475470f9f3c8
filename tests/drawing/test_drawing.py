import numpy as np
import pytest
import torch

from rgbavatar_ns.drawing.compositing import (
    composite,
    error_strip,
    rgba_to_float,
    straight_alpha,
    to_uint8,
)
from rgbavatar_ns.drawing.contact_sheet import contact_sheet, labelled, over_gray_bgr, scaled


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
    truth = torch.full((1, 2, 3, 3), 0.5)
    parts = error_strip(truth, truth - 0.1)
    for part, value in zip(parts, (0.5, 0.4, 0.4)):
        torch.testing.assert_close(part, torch.full_like(truth, value))
    assert error_strip(truth, truth + 0.6).max() == 1


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
