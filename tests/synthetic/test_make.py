from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import digest_of_file
from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset

SMALL = DemoConfig(image_size=48, num_frames=6, num_test_frames=2)


def digest(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): digest_of_file(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, list[tuple[int, int]]]:
    folder, calls = tmp_path_factory.mktemp("demo"), []
    make_demo_dataset(folder, SMALL, lambda done, total: calls.append((done, total)))
    return folder, calls


def test_more_held_out_frames_than_there_are_name_both_options():
    with pytest.raises(UserError, match="60 of 24 frames") as refused:
        DemoConfig(num_frames=24)
    assert all(
        f"({name})" in refused.value.remedy for name in ("--num-frames", "--num-test-frames")
    )


@pytest.mark.slow
def test_a_seed_gives_one_dataset_bit_for_bit(made, tmp_path):
    folder, calls = made
    make_demo_dataset(tmp_path, SMALL)
    assert digest(folder) == digest(tmp_path)
    assert calls == [(done, 6) for done in range(1, 7)]


def test_the_dataset_is_whole_and_valid(made):
    loaded = load_dataset(made[0])
    assert len(loaded) == 6
    assert loaded.test == (4, 5)
    assert (loaded.width, loaded.height) == (48, 48)
    assert loaded.arrays.name == "makehuman"
    with pytest.raises(UserError, match="not empty"):
        make_demo_dataset(made[0], SMALL)
    assert 0.2 < (loaded.read_image(0)[..., 3] > 0).mean() < 0.9


@pytest.mark.slow
def test_noise_is_on_theta_and_not_on_the_images(made, tmp_path):
    noisy = load_dataset(made[0])
    clean = make_demo_dataset(tmp_path, replace(SMALL, theta_noise=0.0))
    assert not torch.equal(noisy.theta, clean.theta)
    assert (noisy.theta - clean.theta).abs().max() < 0.06
    assert np.array_equal(noisy.read_image(3), clean.read_image(3))


def test_impossible_configs_are_refused():
    for changes in ({"num_test_frames": 240}, {"image_size": 0}, {"supersampling": 0}):
        with pytest.raises(UserError):
            DemoConfig(**changes)
