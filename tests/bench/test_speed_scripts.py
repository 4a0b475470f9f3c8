"""The scripts of benchmarks/speed: what they refuse, and what they count."""

import importlib.util
import os
import runpy
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from rgbavatar_ns.bench.scenes import ellipsoid_scene, leaf_gaussians

SPEED = Path(__file__).parents[2] / "benchmarks" / "speed"


@pytest.fixture
def ended(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[object, str]]:
    """Runs a script that refuses; its exit code and what it tells."""

    def run(name: str, *words: object) -> tuple[object, str]:
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        monkeypatch.syspath_prepend(str(SPEED))
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(SPEED / name), run_name="__main__")
        return ended.value.code, capsys.readouterr().err

    return run


@pytest.mark.parametrize("name", ["live_tracker.py", "tracking.py"])
def test_a_film_that_is_not_there_is_told(ended, tmp_path, name):
    pytest.importorskip("mediapipe")
    code, told = ended(name, tmp_path / "none.mp4")
    assert code == 1
    assert told.startswith(f"{name}: ")
    assert "none.mp4" in told


def test_a_run_that_is_not_there_is_told(ended, tmp_path):
    code, told = ended("drive.py", tmp_path / "run", tmp_path / "none.mp4")
    assert code == 1
    assert told.startswith("drive.py: ")


def test_ranges_of_options_are_told(ended, tmp_path):
    code, told = ended("live_tracker.py", tmp_path / "none.mp4", "--height-px", 0)
    assert (code, "--height-px" in told) == (1, True)


def test_a_method_that_is_no_rival_is_told_with_those_that_are(ended):
    for name in ("foo", "rgbavatar"):
        code, told = ended("rivals.py", "--methods", name)
        assert code == 2
        assert "gaussianavatars" in told


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Imports a script, beside the modules of its folder."""

    def load(name: str) -> ModuleType:
        monkeypatch.syspath_prepend(str(SPEED))
        spec = importlib.util.spec_from_file_location(f"speed_{name}", SPEED / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
        return module

    return load


def test_what_a_long_film_costs_is_measured_again_where_options_change_it(
    script, tmp_path, monkeypatch
):
    long_film, made = script("long_film"), []

    def stand_in(*words: object) -> dict[str, object]:
        name = " ".join(str(word) for word in words if isinstance(word, str | int))
        made.append(name)
        return {name: long_film.Costs(1.0, None, len(made))}

    for name in ("tracking", "training", "evaluation"):
        monkeypatch.setattr(long_film, name, lambda *words, name=name: stand_in(name, *words))

    def measured(size_px: int, tiny: int, full: int) -> list[str]:
        made.clear()
        steps = {"tiny": tiny, "full": full}
        rows = long_film.measured(tmp_path / "film.mp4", tmp_path, 250, size_px, steps)
        assert list(rows) == [
            f"tracking 250 {size_px}",
            f"training tiny {tiny}",
            "evaluation tiny",
            f"training full {full}",
            "evaluation full",
        ]
        return list(made)

    assert len(measured(512, 300, 200)) == 5
    assert measured(512, 300, 200) == []
    assert measured(512, 300, 100) == ["training full 100", "evaluation full"]
    assert len(measured(256, 300, 100)) == 5


def test_lengths_whose_rows_differ_stand_in_one_table(script):
    long_film = script("long_film")
    one = long_film.Costs(1.0, 2.0, 3.0, 0.5)
    shown = long_film.table({250: {"track": one}, 1000: {"track": one, "train": one}})
    rows = list(zip(*(column.cells for column in shown.columns)))
    assert rows[1] == ("train", "", "", "", "", "1.0", "2.0", "3", "0.5")


def test_one_frame_is_a_film_to_and_fro(script, monkeypatch):
    drive = script("drive")
    images = [np.full((2, 2, 3), value, np.uint8) for value in range(3)]

    class Source:
        @staticmethod
        def open(video: Path) -> list[SimpleNamespace]:
            return [SimpleNamespace(image_rgb=image) for image in images[: int(video.name)]]

    monkeypatch.setattr(drive, "FrameSource", Source)
    shown = {count: drive._to_and_fro([Path(str(count))], 6) for count in (1, 2, 3)}
    assert {count: [int(image[0, 0, 0]) for image in film] for count, film in shown.items()} == {
        1: [0, 0, 0, 0, 0, 0],
        2: [0, 1, 0, 1, 0, 1],
        3: [0, 1, 2, 1, 0, 1],
    }


def test_a_browser_that_does_not_start_ends_the_training(script, tmp_path, monkeypatch):
    online = script("online_realtime")
    train = tmp_path / "ns-train"
    train.write_text(
        f"#!/bin/sh\necho $$ > {tmp_path}/pid; echo http://127.0.0.1:1; exec sleep 600\n"
    )
    train.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))

    def no_browser(address: str):
        raise RuntimeError("no browser")

    monkeypatch.setattr(online, "browser", no_browser)
    arguments = SimpleNamespace(method="rgbavatar-online-tiny", browser=True, more=[])
    with pytest.raises(RuntimeError, match="no browser"):
        online.run(tmp_path, arguments, tmp_path)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_a_stream_of_which_nothing_was_drawn_is_told(script, monkeypatch, capsys):
    online = script("online_realtime")
    told = {"stream": {"arrived": 0, "dropped": 0}, "images_per_second": 0.0}
    monkeypatch.setattr(online, "subject", lambda *words: None)
    monkeypatch.setattr(online, "run", lambda *words: told | {"steps": 0, "seconds": 1.0})
    monkeypatch.setattr(sys, "argv", ["online_realtime.py"])
    with pytest.raises(SystemExit) as ended:
        online.main()
    assert ended.value.code == 1
    assert "did not keep up" in capsys.readouterr().out


def test_a_backward_pass_is_timed_by_itself(script):
    sets = script("instruction_sets")
    gaussians, cameras = ellipsoid_scene(20, 16, 2)
    leaves, image_grad = leaf_gaussians(gaussians), torch.ones(2, 16, 16, 3)
    found = []
    for _ in range(2):
        sets.seconds(leaves, cameras, image_grad)
        found.append(leaves.means.grad.clone())
    assert found[0].abs().max() > 0
    torch.testing.assert_close(found[0], found[1])


def test_a_prior_s_cost_needs_a_turn_after_the_first(ended):
    code, told = ended("surface_prior.py", "--steps", 79)
    assert (code, "give 80 or more" in told) == (2, True)


def test_both_columns_of_a_tracking_begin_when_mediapipe_is_there(
    script, tmp_path, monkeypatch, capsys
):
    tracking, order = script("tracking"), []

    class Noted(tracking.StageTimes):
        def __post_init__(self) -> None:
            order.append("times")

    def track_video(video: Path, dataset: Path, config: object, told: Callable[..., None]) -> None:
        order.append("track")
        told("faces", 2, 2)
        dataset.mkdir()
        (dataset / "tracking.json").write_text('{"frames_read": 2}')

    monkeypatch.setattr(tracking, "load_mediapipe", lambda: order.append("load"))
    monkeypatch.setattr(tracking, "StageTimes", dataclass(Noted))
    monkeypatch.setattr(tracking, "track_video", track_video)
    monkeypatch.setattr(sys, "argv", ["tracking.py", str(tmp_path / "film.mp4")])
    tracking.main()
    assert order == ["load", "times", "track"]
    rows = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert rows == ["stage", "faces", "after", "all"]
