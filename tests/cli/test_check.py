"""`rgbavatar check`: words, JSON and exit codes."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from rgbavatar_ns.cli.main import main
from rgbavatar_ns.data import TrackedDataset
from tests.data.talking_head import talking_head


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> TrackedDataset:
    return talking_head(tmp_path_factory.mktemp("good") / "data")


@pytest.fixture
def data(good, tmp_path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(good.root, tmp_path / "data"))


def checked(arguments: list[str], capsys) -> tuple[int, str]:
    """Exit code and output."""
    code = 0
    try:
        main(["check", *arguments])
    except SystemExit as ended:
        code = int(ended.code or 0)
    return code, capsys.readouterr().out


def test_good_data_is_told_in_words_with_exit_code_0(data, capsys):
    code, told = checked([str(data), "--max-frames", "4"], capsys)
    assert code == 0
    assert "36 frames (32 to train on, 4 held out) of 96 x 96 pixels, one camera" in told
    assert "head model makehuman" in told
    assert re.search(r"jaw \(3\): 0 to [\d.]+ degrees", told)
    assert re.search(r"the head turns \d+ degrees to its left, \d+ to its right", told)
    assert told.strip().endswith("It can be trained.")
    assert (data / "check.png").stat().st_size > 10_000


def test_unusable_data_has_exit_code_1_and_its_mistake_in_json(data, capsys):
    index = json.loads((data / "dataset.json").read_text())
    matrix = np.array(index["camera"]["world_to_camera"])
    index["camera"]["world_to_camera"] = (np.diag([1, -1, -1, 1]) @ matrix).tolist()
    (data / "dataset.json").write_text(json.dumps(index))
    sheet = data.parent / "elsewhere" / "sheet.png"
    code, told = checked([str(data), "--json", "--sheet", str(sheet)], capsys)
    report = json.loads(told)
    assert code == 1
    assert (report["format"], report["frames"], report["usable"]) == ("rgbavatar native", 36, False)
    assert [problem["kind"] for problem in report["problems"]] == ["axes"]
    assert sheet.exists()
    assert not (data / "check.png").exists()


@pytest.mark.parametrize("spoilt", ["NaN", "missing image", "mirrored camera", "no dataset"])
def test_what_the_reader_refuses_is_reported_too(data, capsys, spoilt):
    if spoilt == "NaN":
        theta = np.load(data / "theta.npy")
        theta[5, 3] = np.nan
        np.save(data / "theta.npy", theta)
        wanted = "NaN or infinite values in 1 of 36 frames (5)"
    elif spoilt == "missing image":
        (data / "images" / "00007.png").unlink()
        wanted = "00007.png"
    elif spoilt == "mirrored camera":
        index = json.loads((data / "dataset.json").read_text())
        index["camera"]["world_to_camera"][0] = [
            -value for value in index["camera"]["world_to_camera"][0]
        ]
        (data / "dataset.json").write_text(json.dumps(index))
        wanted = "mirroring"
    else:
        shutil.rmtree(data)
        wanted = "does not exist"
    code, told = checked([str(data), "--json"], capsys)
    report = json.loads(told)
    assert code == 1
    assert not report["usable"]
    (problem,) = report["problems"]
    assert problem["kind"] == "unreadable"
    assert wanted in problem["cause"] + problem["remedy"]
    code, told = checked([str(data)], capsys)
    assert code == 1
    assert "It cannot be trained like this." in told


def test_without_room_for_its_sheet_the_report_is_told_all_the_same(data, capsys):
    (data / "file").write_text("")
    code, told = checked([str(data), "--json", "--sheet", str(data / "file" / "s.png")], capsys)
    report = json.loads(told)
    assert (code, report["frames"], report["sheet"]) == (0, 36, None)
    assert report["iou"]
    assert "sheet" in [problem["kind"] for problem in report["problems"]]


@pytest.mark.parametrize(
    ("arguments", "told"), [(["--sheet", "x.jpg"], "no PNG"), (["--max-frames", "0"], "is 0")]
)
def test_wrong_options_are_told(good, refused, arguments, told):
    assert told in refused("check", good.root, *arguments)
