"""VHAP's sequences united in a folder beside theirs, as `combine_nerf_datasets` leaves them."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from rgbavatar_ns.data.importers import ImportOptions
from rgbavatar_ns.data.importers.convert import source_fingerprint
from rgbavatar_ns.synthetic.exporters.folders import VhapWriter
from tests.data.importers.takes import NUM_FRAMES

PATHS = ("file_path", "fg_mask_path", "flame_param_path")


@pytest.fixture
def options(flame_folder) -> ImportOptions:
    return ImportOptions(flame=flame_folder, teeth=False, allow_outside=True)


@pytest.fixture
def united(tmp_path, takes) -> Path:
    """Two sequences, the second of which is tracked with a shape of its own and held out."""
    take, frames = takes("2023", False)
    for name, identity in (("one", take.identity), ("two", -take.identity)):
        writer = VhapWriter(tmp_path / name, replace(take, identity=identity))
        for frame in frames:
            writer.add(frame)
        writer.finish()
    for place, (name, split) in enumerate({"one": "train", "two": "test"}.items()):
        content = json.loads((tmp_path / name / "transforms.json").read_text())
        for frame in content["frames"]:
            frame["timestep_index"] += place * NUM_FRAMES
            frame |= {path: os.path.join("..", name, frame[path]) for path in PATHS}
        (tmp_path / "all").mkdir(exist_ok=True)
        (tmp_path / f"all/transforms_{split}.json").write_text(json.dumps(content))
    return tmp_path / "all"


@pytest.mark.parametrize("what", ["images", "fg_masks", "flame_param"])
def test_the_sequences_files_are_part_of_the_imports_key(what, united, options):
    before = source_fingerprint(united, options)
    assert source_fingerprint(united, options) == before
    path = next((united.parent / "two" / what).iterdir())
    path.write_bytes(path.read_bytes() + b"\0")
    assert source_fingerprint(united, options) != before
