"""VHAP's sequences united in a folder beside theirs, as `combine_nerf_datasets` leaves them."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbavatar_ns.data.importers import ImportOptions, read_source
from rgbavatar_ns.data.importers.convert import source_fingerprint
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.synthetic.exporters.folders import VhapWriter
from tests.data.importers.takes import FIRST, NUM_FRAMES

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


def test_sequences_of_shapes_of_their_own_get_the_first_ones(united, options, takes):
    take, _ = takes("2023", False)
    with pytest.raises(UserError, match="leads out"):
        read_source(united, replace(options, allow_outside=False))
    source = read_source(united, options)
    assert source.index == tuple(range(FIRST, FIRST + 2 * NUM_FRAMES))
    assert source.test == frozenset(range(FIRST + NUM_FRAMES, FIRST + 2 * NUM_FRAMES))
    assert torch.allclose(source.identity, torch.from_numpy(take.identity).float())
    assert torch.equal(source.theta[:NUM_FRAMES], source.theta[NUM_FRAMES:])
    assert any("head shapes of their own" in note for note in source.notes)
    # Within a sequence another shape is a mistake.
    path = united.parent / f"two/flame_param/{FIRST + 2:05d}.npz"
    with np.load(path) as values:
        np.savez(path, **{**values, "shape": values["shape"] + 0.1})
    with pytest.raises(UserError, match=r"another head shape than the first: 1"):
        read_source(united, options)


@pytest.mark.parametrize("what", ["images", "fg_masks", "flame_param"])
def test_the_sequences_files_are_part_of_the_imports_key(what, united, options):
    before = source_fingerprint(united, options)
    assert source_fingerprint(united, options) == before
    path = next((united.parent / "two" / what).iterdir())
    path.write_bytes(path.read_bytes() + b"\0")
    assert source_fingerprint(united, options) != before
