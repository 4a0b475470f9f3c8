from pathlib import Path

import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import dataset_folder

# As nerfstudio writes it: Python objects as tags, which must not be built.
_CONFIG = """\
!!python/object:rgbavatar_ns.plugin.training.trainer.RGBAvatarTrainerConfig
_target: !!python/name:rgbavatar_ns.plugin.training.trainer.RGBAvatarTrainer ''
data: &id002 !!python/object/apply:pathlib.PosixPath
- /
- some
- data
pipeline: !!python/object:rgbavatar_ns.plugin.pipeline.RGBAvatarPipelineConfig
  datamanager: !!python/object:rgbavatar_ns.plugin.datamanager.RGBAvatarDataManagerConfig
    data: *id002
    dataparser: !!python/object:rgbavatar_ns.plugin.dataparser.RGBAvatarDataParserConfig
      data: !!python/object/apply:pathlib.PosixPath []
    tuple: !!python/tuple [1, 2]
"""


def test_a_run_names_its_dataset_wherever_one_points_into_it(tmp_path):
    (tmp_path / "config.yml").write_text(_CONFIG)
    checkpoint = tmp_path / "nerfstudio_models" / "step-000000010.ckpt"
    checkpoint.parent.mkdir()
    checkpoint.touch()
    for place in (tmp_path, checkpoint.parent, checkpoint):
        assert dataset_folder(place) == Path("/some/data")


def test_the_dataparsers_own_folder_goes_first(tmp_path):
    config = _CONFIG.replace("PosixPath []", "PosixPath [relative, folder]")
    (tmp_path / "config.yml").write_text(config)
    assert dataset_folder(tmp_path) == Path("relative/folder")


def test_the_folder_that_a_run_was_started_in_is_one(tmp_path):
    here = _CONFIG.replace("PosixPath\n- /\n- some\n- data", "PosixPath []")
    assert "some" not in here
    (tmp_path / "config.yml").write_text(here)
    assert dataset_folder(tmp_path) == Path()


def test_a_run_that_a_camera_fed_names_what_it_recorded(tmp_path):
    """Its config holds the place of then; the run's folder may have been moved since."""
    own = _CONFIG.replace(
        "data: &id002 !!python/object/apply:pathlib.PosixPath\n- /\n- some\n- data", "data: null"
    )
    own = own.replace("*id002", "null").replace(
        "!!python/object/apply:pathlib.PosixPath []", "null"
    )
    place = "    recorded: !!python/object/apply:pathlib.PosixPath [outputs, me, run, stream]\n"
    (tmp_path / "config.yml").write_text(own + place)
    assert dataset_folder(tmp_path) == tmp_path / "stream"
    (tmp_path / "config.yml").write_text(own + "    recorded: null\n")  # before it was set
    with pytest.raises(UserError, match="does not say which dataset"):
        dataset_folder(tmp_path)


def test_what_is_no_run_is_taken_for_a_dataset(tmp_path):
    assert dataset_folder(tmp_path) == tmp_path


def test_nothing_in_a_config_is_run(tmp_path):
    sign = tmp_path / "sign"
    config = _CONFIG + f"evil: !!python/object/apply:os.mkdir ['{sign}']\n"
    (tmp_path / "config.yml").write_text(config)
    assert dataset_folder(tmp_path) == Path("/some/data")
    assert not sign.exists()


_BOMB = "a0: &a0 {x: y}\n" + "".join(
    f"a{k}: &a{k} {{<<: [*a{k - 1}, *a{k - 1}]}}\n" for k in range(1, 40)
)


@pytest.mark.parametrize(
    "text",
    ["data: [", "pipeline: 3", "!!python/none ''", "[]", "[" * 5000, "\0", "x" * 300_000, _BOMB],
)
def test_a_config_that_names_none_is_told(tmp_path, text):
    (tmp_path / "config.yml").write_text(text)
    with pytest.raises(UserError, match="does not say which dataset"):
        dataset_folder(tmp_path)
