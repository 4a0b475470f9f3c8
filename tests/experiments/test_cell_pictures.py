"""What a cell keeps of its avatar: some held-out frames, and how much it is."""

import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.experiments.avatar_size import avatar_size
from rgbavatar_ns.experiments.cell_pictures import comparison, read_pictures, write_pictures
from rgbavatar_ns.head import HeadModel
from tests.plugin.run import SMALL
from tests.plugin.tiny import tiny_dataset


@pytest.fixture
def dataset(tmp_path):
    return tiny_dataset(tmp_path / "data", frames=14, test=6)


@pytest.fixture
def avatar(dataset):
    return Avatar(HeadModel(dataset.arrays), dataset.identity, SMALL)


def test_the_middles_of_three_parts_are_kept_film_and_avatar(dataset, avatar, tmp_path):
    write_pictures(avatar, dataset, tmp_path)
    found = read_pictures(tmp_path)
    held_out = [dataset.frame_index[frame] for frame in dataset.test]
    assert list(found) == [held_out[1], held_out[3], held_out[5]]
    frame = dataset.test[3]
    rgba = dataset.read_image(frame)
    film, drawn = (cv2.imread(str(path))[..., ::-1] for path in found[held_out[3]])
    expected = np.where(rgba[..., 3:] > 0, rgba[..., :3], 255)
    np.testing.assert_array_equal(film, expected)
    with torch.no_grad():
        camera = dataset.cameras.select([frame])
        image = avatar.render(dataset.theta[[frame]], camera, torch.ones(3)).image[0]
    assert np.abs(drawn - 255.0 * image.clamp(0, 1).numpy()).max() <= 0.51
    assert (drawn != 255).any()


def test_a_sheet_has_a_row_a_frame_that_all_have(dataset, avatar, tmp_path):
    for name in ("a", "b"):
        write_pictures(avatar, dataset, tmp_path / name)
    cells = {name: read_pictures(tmp_path / name) for name in ("a", "b")}
    next(iter(cells["b"].values()))[1].unlink()
    cells["b"] = read_pictures(tmp_path / "b")
    jpeg = comparison(cells, 10**6)
    assert jpeg is not None
    sheet = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    # 32 px grow to 320: three columns, two rows.
    assert sheet.shape == (640, 960, 3)
    small = comparison(cells, 9000)
    assert small is not None
    assert len(small) < 9000 < len(jpeg)
    assert comparison({}, 10**6) is None
    assert comparison({"a": cells["a"], "c": {}}, 10**6) is None


def test_size_counts_what_was_learnt(avatar):
    n, k = avatar.num_gaussians, SMALL.num_bases
    inputs = avatar.layout.feature_size(SMALL.pose_input, SMALL.translation_input)
    width = SMALL.hidden_width
    # Base: 3 + 4 + 3 + 1 + 3; a basis: 3 + 4 + 3; three layers with biases. Float32.
    network = (inputs + 1) * width + (width + 1) * width + (width + 1) * k
    expected = 4 * (n * 14 + n * k * 10 + network) / 1e6
    assert avatar_size(avatar) == {"gaussians": n, "megabytes": pytest.approx(expected)}
