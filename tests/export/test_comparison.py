import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.data import DatasetWriter, TrackedFrame
from rgbavatar_ns.export import comparison_frames, front_camera, write_comparison

from .subject import avatar_of

SIZE = 32


@pytest.fixture(scope="module")
def avatar():
    return avatar_of(num_bases=0, uv_resolution=24)


@pytest.fixture(scope="module")
def dataset(avatar, tmp_path_factory):
    """Three frames whose matte is half transparent red on the left, nothing on the right."""
    camera = front_camera(avatar, SIZE, SIZE)
    image = np.zeros((SIZE, SIZE, 4), dtype=np.uint8)
    image[:, : SIZE // 2] = (255, 0, 0, 128)
    folder = tmp_path_factory.mktemp("comparison") / "data"
    writer = DatasetWriter(folder, "makehuman", avatar.identity, avatar.layout, SIZE, SIZE)
    for index in range(3):
        writer.add(TrackedFrame(index, torch.zeros(avatar.layout.size), camera, image))
    return writer.finish(2)


def test_truth_is_laid_over_the_background_and_error_is_four_times_the_difference(avatar, dataset):
    ((truth, image, error),) = comparison_frames(avatar, dataset, [0], background=(1.0, 1.0, 1.0))
    half = 255 - 128
    assert np.abs(truth[:, : SIZE // 2].astype(int) - (255, half, half)).max() <= 1
    assert (truth[:, SIZE // 2 :] == 255).all()
    expected = np.minimum(np.abs(image.astype(int) - truth.astype(int)) * 4, 255)
    assert np.abs(expected - error.astype(int)).max() <= 8
    assert (image[SIZE // 2, SIZE // 2] != 255).any(), "the head is in the middle of the picture"


def test_the_picture_has_a_column_for_each_shown_frame(avatar, dataset, tmp_path):
    picture = tmp_path / "picture.png"
    count = write_comparison(avatar, dataset, tmp_path / "film.mp4", picture, columns=2)
    assert count == 2
    assert cv2.imread(str(picture)).shape == (3 * SIZE, 2 * SIZE, 3)
