"""Other methods of nerfstudio read our datasets, under the name `rgbavatar-data`."""

import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion, all_methods
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.datasets.base_dataset import InputDataset

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.plugin.dataparser import RGBAvatarDataParserConfig
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainerConfig
from tests.plugin.run import run_command
from tests.plugin.tiny import NUM_TEST, SIZE

NAME = "rgbavatar-data"


def test_nerfstudio_lists_it_from_the_entry_point():
    (found,) = entry_points(group="nerfstudio.dataparser_configs", name=NAME)
    assert isinstance(found.load().config, RGBAvatarDataParserConfig)
    assert isinstance(all_dataparsers[NAME], RGBAvatarDataParserConfig)


# A process each: the day has one of theirs and one of ours.
_BY_NIGHT = (
    "nerfstudio.data.datamanagers.base_datamanager",
    "nerfstudio.data.dataparsers.base_dataparser",
    "rgbavatar_ns.plugin.datamanager",
    "rgbavatar_ns.plugin.methods",
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "first",
    [
        "nerfstudio.configs.dataparser_configs",
        "rgbavatar_ns.plugin.dataparser",
        *(pytest.param(name, marks=pytest.mark.nightly) for name in _BY_NIGHT),
    ],
)
def test_whatever_is_imported_first_nothing_goes_in_a_circle(first: str):
    program = (
        f"import {first}\n"
        "from nerfstudio.configs.dataparser_configs import all_dataparsers\n"
        "from nerfstudio.configs.method_configs import all_methods\n"
        f"assert '{NAME}' in all_dataparsers and 'rgbavatar' in all_methods"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr


def _typed(*arguments: str):
    return tyro.cli(AnnotatedBaseConfigUnion, args=list(arguments))


def test_another_method_takes_it_with_its_options():
    config = _typed("splatfacto", "--data", "d", NAME, "--importing.format", "insta")
    parser = config.pipeline.datamanager.dataparser
    assert isinstance(parser, RGBAvatarDataParserConfig)
    assert parser.importing.format == "insta"


@pytest.mark.parametrize(
    "arguments",
    [
        ("--data", "d"),
        ("--data", "d", NAME),
        ("--data", "d", NAME, "--pipeline.datamanager.dataparser.importing.format", "insta"),
        (NAME, "--data", "d"),
    ],
)
def test_our_methods_take_the_name_where_it_is_usual(arguments: tuple[str, ...]):
    config = _typed("rgbavatar", *arguments)
    assert isinstance(config, RGBAvatarTrainerConfig)
    assert config.data == Path("d")
    importing = config.pipeline.datamanager.dataparser.importing
    assert importing.format == ("insta" if "insta" in arguments else None)


def test_our_methods_refuse_another_reader_by_its_name(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        _typed("rgbavatar", "--data", "d", "blender-data")
    told = capsys.readouterr()
    assert "blender-data" in told.out + told.err
    assert NAME in told.out + told.err


def test_its_images_are_rgb_over_black(tiny_data: Path):
    config = RGBAvatarDataParserConfig(data=tiny_data)
    tracked = load_dataset(tiny_data)
    dataset = InputDataset(config.setup().get_dataparser_outputs("test"))
    assert len(dataset) == NUM_TEST
    for row, position in enumerate(tracked.test):
        rgba = torch.from_numpy(np.asarray(tracked.read_image(position))) / 255
        shown = dataset.get_image_float32(row)
        torch.testing.assert_close(shown, rgba[..., :3] * rgba[..., 3:])


def test_a_ray_based_datamanager_takes_pixels_of_it(tiny_data: Path):
    config = VanillaDataManagerConfig(
        data=tiny_data, dataparser=RGBAvatarDataParserConfig(), train_num_rays_per_batch=64
    )
    rays, batch = config.setup(device="cpu", test_mode="val").next_train(0)
    assert rays.origins.shape == batch["image"].shape == (64, 3)
    # The camera stands a metre before the head, on nerfstudio's side of the face: -y.
    assert bool((rays.origins[:, 1] < -0.7).all())
    frame, row, column = batch["indices"].T
    dataset = InputDataset(
        RGBAvatarDataParserConfig(data=tiny_data).setup().get_dataparser_outputs()
    )
    pictures = torch.stack([dataset.get_image_float32(i) for i in range(len(dataset))])
    torch.testing.assert_close(batch["image"], pictures[frame, row, column])


def test_splatfactos_datamanager_finds_cameras_and_images(tiny_data: Path):
    config = FullImageDatamanagerConfig(
        data=tiny_data, dataparser=RGBAvatarDataParserConfig(), cache_images="cpu"
    )
    # It pins memory as it loads, which needs a GPU: everything up to there.
    data = config.setup(device="cpu", test_mode="inference")
    assert len(data.train_dataset.cameras) == len(load_dataset(tiny_data).train)
    assert data.train_dataset.get_image_float32(0).shape == (SIZE, SIZE, 3)
    assert all_methods["splatfacto"].pipeline.datamanager.__class__ is FullImageDatamanagerConfig


@pytest.mark.slow
def test_a_dataset_that_is_missing_is_told_under_another_method_too(tmp_path: Path):
    told = run_command(
        *(
            "ns-train",
            "splatfacto",
            "--output-dir",
            tmp_path / "runs",
            "--machine.device-type",
            "cpu",
        ),
        *("--vis", "tensorboard", "--data", tmp_path / "absent", NAME),
    )
    assert told.returncode == 1
    assert "absent does not exist" in told.stderr
    assert "Traceback" not in told.stdout + told.stderr
