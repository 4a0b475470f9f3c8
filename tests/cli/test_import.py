"""`rgbavatar import` and `demo-data --format` as commands."""

import json
import os
import shutil
from pathlib import Path

import pytest

from rgbavatar_ns.cli import main as cli
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.synthetic.exporters.folders import VhapWriter
from rgbavatar_ns.synthetic.flame import write_synthetic_flame
from tests.data.importers.takes import NUM_FRAMES, NUM_TEST, make_take


@pytest.fixture(scope="module")
def vhap(tmp_path_factory) -> tuple[Path, Path]:
    """A folder as VHAP exports it, and its FLAME."""
    folder = tmp_path_factory.mktemp("vhap")
    write_synthetic_flame(folder / "flame", "2023")
    take, frames = make_take(folder / "flame", "2023", False)
    writer = VhapWriter(folder / "data", take)
    for frame in frames:
        writer.add(frame)
    writer.finish()
    return folder / "data", folder / "flame"


def test_import_tells_what_it_found_and_goes_on_after_an_interruption(
    vhap, tmp_path, capsys, monkeypatch
):
    data, flame = vhap
    arguments = ["import", str(data), str(tmp_path / "set"), "--flame", str(flame)]
    from rgbavatar_ns.data.importers import convert

    make_png, calls = convert.make_png, []

    def interrupted(picture, size):
        calls.append(picture)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return make_png(picture, size)

    monkeypatch.setattr(convert, "make_png", interrupted)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == 130
    assert not (tmp_path / "set/dataset.json").exists()
    done = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "set/images").iterdir()}
    assert 2 <= len(done) < NUM_FRAMES  # the next one may have begun already
    calls.clear()
    monkeypatch.setattr(
        convert, "make_png", lambda picture, size: calls.append(picture) or make_png(picture, size)
    )
    capsys.readouterr()
    cli.main(arguments)
    told = capsys.readouterr().out
    assert len(calls) == NUM_FRAMES - len(done)
    assert "recognised: VHAP, head FLAME 2023" in told
    assert f"{NUM_FRAMES - NUM_TEST} frames to train on, {NUM_TEST} held out" in told
    for name, time in done.items():
        assert (tmp_path / "set/images" / name).stat().st_mtime_ns == time
    assert json.loads((tmp_path / "set/dataset.json").read_text())["version"] == 2
    assert len(load_dataset(tmp_path / "set").arrays.v_template) == 5023 + 120


def test_a_check_from_within_leaves_the_data_as_it_is(vhap, tmp_path, capsys, monkeypatch):
    data, flame = shutil.copytree(vhap[0], tmp_path / "data"), vhap[1]
    before = {path.name for path in data.iterdir()}
    monkeypatch.chdir(data / "images")
    for place, told in (("..", "imported once"), (str(data), "")):
        with pytest.raises(SystemExit):  # noise is no head
            cli.main(["check", place, "--flame", str(flame), "--max-frames", "2", "--json"])
        printed = capsys.readouterr()
        assert told in printed.err
        assert bool(told) == bool(printed.err.strip())
        assert json.loads(printed.out)["sheet"].endswith("check.png")
        assert {path.name for path in data.iterdir()} == before | {".rgbavatar"}


def test_another_source_does_not_go_into_a_full_folder(vhap, tmp_path, refused):
    data, flame = vhap
    (tmp_path / "something").write_text("else")
    assert "not empty" in refused("import", data, tmp_path, "--flame", flame)
    assert "in none of the formats" in refused("import", tmp_path, tmp_path / "set")


def test_a_dataset_needs_no_import(tmp_path, refused):
    small = ["--num-frames", "4", "--num-test-frames", "1", "--image-size", "32"]
    cli.main(["demo-data", str(tmp_path / "own"), *small])
    told = " ".join(refused("import", tmp_path / "own", tmp_path / "set").split())
    assert "own is a dataset already. Train on it: ns-train rgbavatar --data" in told


def test_without_flame_it_says_where_to_get_it(vhap, tmp_path, refused, monkeypatch):
    monkeypatch.delenv("RGBAVATAR_FLAME", raising=False)
    told = refused("import", vhap[0], tmp_path / "set")
    assert "--flame" in told
    assert "RGBAVATAR_FLAME" in told


@pytest.mark.slow
def test_demo_data_of_another_format_says_how_to_train(tmp_path, capsys):
    options = ["--image-size", "24", "--num-frames", "2", "--num-test-frames", "1"]
    folder = tmp_path / "data"
    cli.main(["demo-data", str(folder), "--format", "vhap", "--supersampling", "1", *options])
    told = capsys.readouterr().out
    assert f"ns-train rgbavatar-tiny --data {folder}" in told
    flame = next((folder / "flame_model").rglob("*.pkl"))
    assert f"RGBAVATAR_FLAME={flame}" in told
    assert len(list((folder / "images").iterdir())) == 2
