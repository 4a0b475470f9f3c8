"""Imports on the way: what they depend on, and that damage to them heals."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import TrackedDataset, load_dataset
from rgbavatar_ns.data.importers import ImportOptions, convert, import_dataset
from rgbavatar_ns.data.importers.convert import (
    CACHE_FOLDER,
    flame_fingerprint,
    source_fingerprint,
)
from rgbavatar_ns.data.importers.frame_images import make_png
from rgbavatar_ns.data.native.writer import DatasetWriter
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import DiskError
from tests.data.importers.test_round_trips import write


@pytest.fixture(scope="module")
def options(flame_folder) -> ImportOptions:
    return ImportOptions(flame=flame_folder, teeth=False)


@pytest.fixture(scope="module")
def data(tmp_path_factory, takes) -> Path:
    """To be read only; its import on the way, beside it, is whole before and after each test."""
    folder = tmp_path_factory.mktemp("cached") / "data"
    write(folder, "imavatar", takes)
    return folder


@pytest.fixture(scope="module")
def whole(data, options, tmp_path_factory) -> TrackedDataset:
    return import_dataset(data, tmp_path_factory.mktemp("whole") / "set", options)


def same(one: TrackedDataset, other: TrackedDataset) -> bool:
    images = all(np.array_equal(one.read_image(k), other.read_image(k)) for k in range(len(other)))
    return images and torch.equal(one.theta, other.theta)


def damage(root: Path, what: str) -> None:
    path = root / what
    path.write_bytes(path.read_bytes()[:-20])


@pytest.mark.parametrize("what", ["dataset.json", "theta.npy", "head.npz", "images/00004.png"])
def test_a_damaged_import_is_made_anew(what, data, options, whole, capsys):
    opened = load_dataset(data, options)
    capsys.readouterr()
    damage(opened.root, what)
    again = load_dataset(data, options)
    assert again.root == opened.root
    assert same(again, whole)
    assert "damaged, made anew" in capsys.readouterr().err
    load_dataset(data, options)
    assert not capsys.readouterr().err.strip()


def _imports(data: Path) -> list[str]:
    return [path.name for path in (data / CACHE_FOLDER).iterdir() if path.is_dir()]


def test_an_import_is_told_once_it_is_there_and_a_refused_one_leaves_nothing(
    data, options, tmp_path, capsys, monkeypatch
):
    copy = shutil.copytree(data, tmp_path / "data", ignore=shutil.ignore_patterns(CACHE_FOLDER))
    monkeypatch.delenv("RGBAVATAR_FLAME", raising=False)
    with pytest.raises(UserError, match="FLAME"):
        load_dataset(copy, ImportOptions())
    assert "imported" not in capsys.readouterr().err
    assert _imports(copy) == []
    for image in (copy / "image").iterdir():
        image.write_bytes(b"no picture")
    with pytest.raises(UserError, match="image"):
        load_dataset(copy, options)
    assert "imported" not in capsys.readouterr().err
    assert _imports(copy) == []


def test_an_import_that_met_a_full_disk_keeps_what_it_has(data, options, tmp_path, monkeypatch):
    copy = shutil.copytree(data, tmp_path / "data", ignore=shutil.ignore_patterns(CACHE_FOLDER))

    def full(self, *arguments):
        raise DiskError("full", "Free some space.")

    monkeypatch.setattr(DatasetWriter, "finish", full)
    with pytest.raises(DiskError):
        load_dataset(copy, options)
    (name,) = _imports(copy)
    assert list((copy / CACHE_FOLDER / name / "images").iterdir())


@pytest.mark.parametrize("what", ["dataset.json", "theta.npy", "images/00004.png"])
def test_overwriting_makes_a_damaged_import_anew_and_else_this_is_told(
    what, data, options, whole, tmp_path
):
    shutil.copytree(whole.root, tmp_path / "set")
    damage(tmp_path / "set", what)
    with pytest.raises(UserError) as caught:
        import_dataset(data, tmp_path / "set", options)
    assert "--overwrite" in caught.value.remedy
    assert same(import_dataset(data, tmp_path / "set", options, overwrite=True), whole)


def test_pixels_that_were_damaged_later_name_the_folder_to_delete(data, options):
    opened = load_dataset(data, options)
    path = opened.image_paths[2]
    content = path.read_bytes()
    path.write_bytes(content[:60] + bytes([content[60] ^ 1]) + content[61:])
    with pytest.raises(UserError, match="checksum") as caught:
        load_dataset(data, options).read_image(2)
    path.write_bytes(content)
    assert str(opened.root) in caught.value.remedy
    assert str(data) in caught.value.remedy


@pytest.mark.parametrize("name", ["r_eyelid.npy", "FLAME_texture.npz", "head_template.obj"])
@pytest.mark.parametrize("above", [False, True])
def test_what_is_put_beside_flame_later_counts(name, above, tmp_path):
    folder = tmp_path / "models/FLAME2020"
    folder.mkdir(parents=True)
    pickle = folder / "generic_model.pkl"
    pickle.write_bytes(b"FLAME")
    (tmp_path / "models/notes.txt").write_text("a")
    options = [ImportOptions(flame=path) for path in (pickle, folder)]
    before = [flame_fingerprint(one) for one in options]
    (tmp_path / "models/notes.txt").write_text("another file")
    assert [flame_fingerprint(one) for one in options] == before
    (tmp_path / "models" / ("" if above else "FLAME2020") / name).write_bytes(b"new")
    assert not set(before) & {flame_fingerprint(one) for one in options}


@pytest.mark.parametrize("place", ["set", "mine/deep/set"])
def test_an_import_into_the_data_itself_goes_on(place, data, options, tmp_path, monkeypatch):
    copy = shutil.copytree(data, tmp_path / "data")
    calls: list[object] = []

    def interrupted(picture, size):
        calls.append(picture)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return make_png(picture, size)

    monkeypatch.setattr(convert, "make_png", interrupted)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    with pytest.raises(KeyboardInterrupt):
        import_dataset(copy, copy / place, options)
    done = {path: path.stat().st_mtime_ns for path in (copy / place / "images").iterdir()}
    assert len(done) >= 2
    dataset = import_dataset(copy, copy / place, options)
    assert {path: path.stat().st_mtime_ns for path in done} == done
    calls.clear()
    assert same(import_dataset(copy, copy / place, options), dataset)
    assert not calls, "a finished one is opened"
    (copy / "image/more.png").write_bytes(b"new")
    with pytest.raises(UserError):
        import_dataset(copy, copy / place, options)


def test_what_links_lead_to_outside_counts_only_where_it_may_be_read(data, options, tmp_path):
    copy, beside = shutil.copytree(data, tmp_path / "data"), tmp_path / "beside"
    (beside / "deep").mkdir(parents=True)
    (copy / "own").symlink_to("image")
    (copy / "loop").symlink_to(copy)
    without = source_fingerprint(copy, options)
    (copy / "x").symlink_to(beside)
    consenting = replace(options, allow_outside=True)
    before = [source_fingerprint(copy, one) for one in (options, consenting)]
    assert before[0] != without, "the link itself counts"
    (beside / "deep/more.png").write_bytes(b"new")
    after = [source_fingerprint(copy, one) for one in (options, consenting)]
    assert before[0] == after[0]
    assert before[1] != after[1]
    (copy / "image/more.png").write_bytes(b"new")
    assert source_fingerprint(copy, options) != after[0]
