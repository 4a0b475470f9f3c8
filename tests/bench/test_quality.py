"""How soon an avatar is good: curves, when they reach a quality, and what cannot be measured."""

import dataclasses
import json

import cv2
import pytest

from rgbavatar_ns.bench import quality
from rgbavatar_ns.bench.options import Batches, QualityOptions
from rgbavatar_ns.bench.quality import QualityReport, bench_quality, print_quality, seconds_to
from rgbavatar_ns.bench.timing import CPU
from rgbavatar_ns.cli import bench
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import write_json
from tests.plugin.tiny import tiny_dataset

CURVE = {4.0: 30.0, 1.0: 26.0, 2.0: 28.0}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("data") / "subject").root


def test_time_to_quality_lies_between_the_curve_s_points():
    assert seconds_to(29.0, CURVE) == pytest.approx(3.0)
    assert seconds_to(28.0, CURVE) == pytest.approx(2.0)
    assert seconds_to(25.0, CURVE) == 1.0
    assert seconds_to(31.0, CURVE) is None


def test_a_report_s_quality_is_that_of_the_subjects_mean():
    higher = {second: value + 2 for second, value in CURVE.items()}
    report = QualityReport({"threads": 1}, {"10": [CURVE, higher]}, {})
    assert report.means() == {"10": {4.0: 31.0, 1.0: 27.0, 2.0: 29.0}}
    # 30.5 dB lies three quarters of the way from 29 at 2 s to 31 at 4 s.
    assert report.seconds_to_quality() == {"10": pytest.approx(3.5)}


def test_batch_sizes_as_they_are_written():
    assert Batches.parsed("10") == Batches("10", 10, 0.0, 10)
    assert Batches.parsed("4-10:20") == Batches("4-10:20", 4, 20.0, 10)
    for wrong in ("ten", "0", "4-0:2", "4-10:nan", "4-10:-1"):
        with pytest.raises(UserError, match=f"--batches '{wrong}' is no number of images a step"):
            QualityOptions(batches=(wrong,))


def test_what_would_be_ignored_or_measures_nothing_is_refused(tmp_path):
    with pytest.raises(UserError, match="--size belongs to the procedural people"):
        QualityOptions(data=tmp_path, size=64)
    with pytest.raises(UserError, match="Nothing is to be trained"):
        QualityOptions(batches=())
    with pytest.raises(UserError, match="--seconds is 0"):
        QualityOptions(seconds=0.0)


def test_frames_that_are_not_there_are_told(dataset):
    options = QualityOptions(data=dataset, batches=("4000",), uv=16, device="cpu")
    with pytest.raises(UserError, match="A step of 4000 different images cannot be made of"):
        bench_quality(options)


def test_the_command_writes_curves_of_ones_own_dataset(dataset, tmp_path, capsys):
    path = tmp_path / "quality.json"
    options = QualityOptions(
        json=path, data=dataset, seeds=(0,), batches=("2", "1-2:.2"), seconds=1.1, uv=16
    )
    bench.run(options)
    told, printed = json.loads(path.read_text()), capsys.readouterr().out
    assert told["workload"]["data"] == str(dataset)
    assert {name: len(of) for name, of in told["curves"].items()} == {"2": 1, "1-2:.2": 1}
    for of in told["curves"].values():
        assert all(set(one) == {"1.0", "1.1"} for one in of)
        # A second of training teaches more than nothing, and no score is of an empty picture.
        assert all(10 < value < 60 for one in of for value in one.values())
    assert set(told["seconds_to_quality"]) == {"2", "1-2:.2"}
    assert "rgbavatar bench quality" in printed


def test_of_many_held_out_frames_some_from_all_over_are_scored(dataset, monkeypatch):
    film = load_dataset(dataset)
    assert quality._Subject(film, 0, CPU).scored == film.test
    monkeypatch.setattr(quality, "_MOST_SCORED", 2)
    assert quality._Subject(film, 0, CPU).scored == (film.test[0], film.test[2])


def test_a_report_is_told_after_every_curve(dataset):
    counts = []
    options = QualityOptions(data=dataset, seeds=(0,), batches=("1", "2"), seconds=0.1, uv=16)
    bench_quality(
        options, found=lambda report: counts.append(sum(map(len, report.curves.values())))
    )
    assert counts == [1, 2]


def test_an_interrupted_measurement_goes_on_and_a_finished_one_begins_anew(dataset, tmp_path):
    path = tmp_path / "quality.json"
    options = QualityOptions(
        json=path, data=dataset, seeds=(0, 1), batches=("1", "2"), seconds=0.1, uv=16
    )

    def stop(report: QualityReport) -> None:
        write_json(path, report.to_json())
        if sum(map(len, report.curves.values())) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bench_quality(options, found=stop)
    begun = QualityReport.read(path)
    assert begun is not None
    first = {name: list(of) for name, of in begun.curves.items()}
    whole = bench_quality(options, begun=begun)
    assert {name: len(of) for name, of in whole.curves.items()} == {"1": 2, "2": 2}
    assert whole.curves["1"] == first["1"]
    assert whole.curves["2"][:1] == first["2"]
    # Nothing is kept of other options, nor of what is there whole.
    told = []
    bench_quality(options, found=told.append, begun=whole)
    assert len(told) == 4
    other = dataclasses.replace(options, seconds=0.2, seeds=(0,), batches=("1",))
    told.clear()
    bench_quality(other, found=told.append, begun=begun)
    assert len(told) == 1


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"curves": {"10": 3}}'])
def test_other_files_are_no_reports(content, tmp_path):
    path = tmp_path / "quality.json"
    path.write_text(content)
    assert QualityReport.read(path) is None
    assert QualityReport.read(tmp_path / "missing.json") is None


def test_a_dataset_without_held_out_frames_is_told(tmp_path):
    root = tiny_dataset(tmp_path / "subject", frames=2, test=0).root
    with pytest.raises(UserError, match=r"No frame of .*subject is held out"):
        bench_quality(QualityOptions(data=root, seeds=(0,), seconds=0.1, uv=16))


def test_curves_are_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    from benchmarks.quality.quality_curves import draw, read

    facts = {"processor": "a processor", "instruction_set": "avx2", "commit": None}
    machine = facts | {"date": "2020-01-01 00:00"}
    report = QualityReport({"threads": 1, "data": "one"}, {"10": [CURVE], "4": [CURVE]}, machine)
    path = tmp_path / "report.json"
    path.write_text(json.dumps(report.to_json()))
    assert read(path) == report
    draw([read(path), report], tmp_path / "docs" / "curves.png")
    assert cv2.imread(str(tmp_path / "docs" / "curves.png")).shape[1] > 1000


def test_the_table_names_what_is_not_reached(capsys):
    worse = {second: value - 5 for second, value in CURVE.items()}
    print_quality(QualityReport({}, {"10": [CURVE], "4": [worse]}, {}))
    assert "not reached" in capsys.readouterr().out
