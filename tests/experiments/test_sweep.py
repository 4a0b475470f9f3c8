"""A sweep does what is missing, survives failures, and its report traces every figure."""

import csv
import json
import os
import sys
import time
from dataclasses import replace

import pytest

from rgbavatar_ns.cli import main as cli
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments import read_experiment
from rgbavatar_ns.experiments.dataset_state import old_dataset_state
from rgbavatar_ns.experiments.engines import LocalEngine, RayEngine
from rgbavatar_ns.experiments.report import write_report
from rgbavatar_ns.experiments.sweep import cells_of, read_statuses, sweep


def _calls(statuses):
    return [(status.folder / "calls.txt").read_text() for status in statuses]


def test_a_second_call_does_only_what_is_missing(experiment_of, tmp_path):
    experiment = experiment_of("a", "b")
    folder = tmp_path / "out"
    first = sweep(experiment, folder, LocalEngine(2))
    assert [status.state for status in first] == ["done"] * 4
    (first[1].folder / "result.json").unlink()
    again = sweep(experiment, folder, LocalEngine(1))
    assert [status.state for status in again] == ["done"] * 4
    assert _calls(again) == ["x", "xx", "x", "x"]
    wider = sweep(experiment_of("a", "b", "c"), folder, LocalEngine(2))
    assert _calls(wider) == ["x", "xx", "x", "x", "x", "x"]


def test_single_rows_can_be_swept_and_the_rest_later(experiment_of, tmp_path):
    experiment, folder = experiment_of("a", "b", "c"), tmp_path / "out"
    some = sweep(experiment, folder, LocalEngine(2), variants=["c", "a"])
    assert [status.cell.variant for status in some] == ["a", "a", "c", "c"]
    assert [status.state for status in some] == ["done"] * 4
    table = write_report(experiment, folder, plots=False).table.to_markdown()
    assert "4 of 6 cells done" in table
    everything = sweep(experiment, folder, LocalEngine(2))
    assert _calls(everything) == ["x"] * 6
    with pytest.raises(UserError, match="has no variant 'd'") as refused:
        sweep(experiment, folder, LocalEngine(2), variants=["a", "d"])
    assert "Known are a, b, c." in refused.value.remedy


@pytest.mark.parametrize("name", ["imgs/1.jpg", "alpha/1.jpg", "checkpoint/00001.frame"])
def test_pictures_mattes_and_frames_remade_in_place_are_noticed(experiment_of, tmp_path, name):
    path, out = tmp_path / "data" / name, tmp_path / "out"
    path.parent.mkdir()
    path.write_bytes(b"x" * 200_000)
    sweep(experiment_of("a"), out, LocalEngine(2))
    os.utime(path, (0, 0))
    (tmp_path / "data" / "outputs").mkdir()
    (tmp_path / "data" / "outputs" / "run.json").touch()
    (tmp_path / "data" / ".rgbavatar").mkdir()
    (tmp_path / "data" / ".rgbavatar" / "import.json").touch()
    sweep(experiment_of("a"), out, LocalEngine(2))
    for content in (b"x" * 200_001, b"x" * 199_999 + b"y", b"small"):
        path.write_bytes(content)
        with pytest.raises(UserError, match="data has changed since cells were trained"):
            sweep(experiment_of("a"), out, LocalEngine(2))


def test_a_cell_of_before_is_asked_for_what_was_kept_then(experiment_of, tmp_path):
    """Its state is of the tables at the top alone."""
    theta, out = tmp_path / "data" / "theta.npy", tmp_path / "out"
    theta.write_bytes(b"first")
    statuses = sweep(experiment_of("a"), out, LocalEngine(2))
    (state,) = {old_dataset_state(tmp_path / "data")}
    for status in statuses:
        cell = json.loads((status.folder / "cell.json").read_text())
        del cell["datasets"]
        (status.folder / "cell.json").write_text(json.dumps(cell | {"dataset_states": [state]}))
    (tmp_path / "data" / "images").mkdir()
    (tmp_path / "data" / "images" / "0.png").write_bytes(b"other")
    assert _calls(sweep(experiment_of("a"), out, LocalEngine(2))) == ["x", "x"]
    theta.write_bytes(b"again")
    with pytest.raises(UserError, match="data has changed since cells were trained"):
        sweep(experiment_of("a"), out, LocalEngine(2))


def test_figures_of_a_dataset_as_it_was_are_not_given_for_what_it_is_now(experiment_of, tmp_path):
    """A film that is tracked anew has the same path."""
    theta, out = tmp_path / "data" / "theta.npy", tmp_path / "out"
    theta.write_bytes(b"first")
    statuses = sweep(experiment_of("a"), out, LocalEngine(2))
    (tmp_path / "data" / "look.png").touch()
    (statuses[1].folder / "result.json").unlink()
    sweep(experiment_of("a"), out, LocalEngine(2))
    theta.write_bytes(b"again")
    with pytest.raises(UserError, match="data has changed since cells were trained") as refused:
        sweep(experiment_of("a", "b"), out, LocalEngine(2))
    assert "--output" in refused.value.remedy
    for status in statuses:
        assert str(status.folder) in refused.value.remedy
    assert _calls(statuses) == ["x", "xx"]
    assert {s.state for s in sweep(experiment_of("a"), tmp_path / "other", LocalEngine(2))} == {
        "done"
    }


def test_a_failed_cell_is_tried_once_more_and_stops_nobody(experiment_of, tmp_path):
    statuses = sweep(experiment_of("broken", "shaky", "fine"), tmp_path / "out", LocalEngine(2))
    assert [status.state for status in statuses] == ["failed"] * 2 + ["done"] * 4
    assert _calls(statuses) == ["xx", "xx", "xx", "xx", "x", "x"]
    assert statuses[0].why[-1] == "CUDA out of memory, so to speak"


def test_an_interruption_ends_the_cells_and_is_gone_on_from(experiment_of, tmp_path):
    experiment = experiment_of("fine", "broken", break_="time.sleep(300)")

    def stop(statuses):
        if statuses[0].state == "done":  # and so the first seed's other cell has begun
            _wait_for(statuses[2].folder / "calls.txt")
            raise KeyboardInterrupt

    began_s = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        sweep(experiment, tmp_path / "out", LocalEngine(1), stop)
    assert time.monotonic() - began_s < 60, "the cell was interrupted, not waited for"
    experiment = experiment_of("fine", "broken", break_="pass")
    statuses = sweep(experiment, tmp_path / "out", LocalEngine(2))
    assert [status.state for status in statuses] == ["done"] * 4
    assert _calls(statuses) == ["x", "x", "xx", "x"]


def _wait_for(path):
    while not path.exists():
        time.sleep(0.01)


def test_the_report_has_means_spreads_and_the_papers_figures(experiment_of, tmp_path):
    paper = "    paper: {psnr: 31.5}\n"
    experiment = experiment_of("a", "b", "broken", paper=paper)
    statuses = sweep(experiment, tmp_path / "out", LocalEngine(2))
    report = write_report(experiment, tmp_path / "out")
    # K = 10 and 20 give 31 and 32; seeds 0 and 2 add 0 and 2: mean + 1, deviation sqrt(2).
    markdown = report.table.to_markdown()
    assert "| a | 32.00 ± 1.41 | 0.9000 ± 0.0000 | - | 31.50 |" in markdown
    assert "PSNR, paper (INSTA)" in markdown
    assert "LPIPS (VGG) is not available: no weights" in markdown
    assert "4 of 6 cells done" in markdown
    rows = list(csv.DictReader((tmp_path / "out/report/bases.csv").open()))
    assert float(rows[1]["psnr_mean"]) == 33.0
    assert rows[1]["cells"].split() == [status.cell.key for status in statuses[2:4]]
    assert rows[2]["psnr_mean"] == ""
    latex = (tmp_path / "out/report/bases.tex").read_text()
    assert r"32.00 $\pm$ 1.41" in latex
    page = (tmp_path / "out/report/index.html").read_text()
    assert f'href="../cells/{statuses[0].cell.key}/"' in page
    assert "Bases &amp; more" in page
    assert (tmp_path / "out/report/bases.png").stat().st_size > 1000
    assert (tmp_path / "out/report/bases.svg").exists()


def test_each_subject_has_its_rows_and_the_papers_figures_for_it(experiment_of, tmp_path):
    paper = """    paper: {psnr: 1, train_seconds: 81}
    paper_by_subject: {data: {psnr: 30}, more: {psnr: 40}, gone: {psnr: 50}}
"""
    (tmp_path / "more").mkdir()
    experiment = experiment_of("a", "b", subjects="data, more", paper=paper)
    experiment = replace(experiment, metrics=("psnr", "train_seconds"))
    sweep(experiment, tmp_path / "out", LocalEngine(2))
    table = write_report(experiment, tmp_path / "out").table
    markdown = table.to_markdown()
    # The paper's mean is over the two subjects that are there.
    assert "| a | 32.00 ± 1.41 | - | 35.00 | 81 |" in markdown
    assert "| Subject | Method | PSNR | training, s | PSNR, paper (INSTA) |" in markdown
    assert "| data | a | 32.00 ± 1.41 | - | 30.00 | - |" in markdown
    assert "| more | b | 33.00 ± 1.41 | - | 40.00 | - |" in markdown
    rows = list(csv.DictReader((tmp_path / "out/report/bases.csv").open()))
    assert [(row["variant"], row["subject"]) for row in rows] == [
        *[("a", ""), ("b", "")],
        *[("a", "data"), ("b", "data"), ("a", "more"), ("b", "more")],
    ]
    assert float(rows[4]["paper_psnr"]) == 40
    assert (tmp_path / "out/report/bases.tex").read_text().count(r"\begin{tabular}") == 2
    page = (tmp_path / "out/report/index.html").read_text()
    assert "<h2>By subject</h2>" in page
    assert "<td>40.00</td>" in page


def test_subjects_of_one_name_are_told_by_their_paths(experiment_of, tmp_path):
    for name in ("one", "two"):
        (tmp_path / name / "bala").mkdir(parents=True)
    experiment = experiment_of("a", subjects="one/bala, two/bala", seeds="0")
    sweep(experiment, tmp_path / "out", LocalEngine(2))
    rows = write_report(experiment, tmp_path / "out", plots=False).table.subject_rows
    assert [row.subject for row in rows] == [str(tmp_path / n / "bala") for n in ("one", "two")]


def test_other_subjects_do_not_mix_with_the_files(experiment_of, tmp_path, monkeypatch, capsys):
    (tmp_path / "own").mkdir()
    experiment_of("a")
    monkeypatch.chdir(tmp_path)
    file, out = ["--file", "bases.yaml"], ["--output", "out"]
    cli.main(["sweep", "bases.yaml", *out])
    cli.main(["sweep", "bases.yaml", *out, "--subjects", "own"])
    assert "--file bases.yaml --subjects own" in capsys.readouterr().out
    assert len(list((tmp_path / "out/cells").iterdir())) == 4
    cli.main(["report", "out", *file, "--subjects", "own", "--no-plots"])
    assert "subjects own;" in next((tmp_path / "out/report").glob("bases-own-*.md")).read_text()
    cli.main(["report", "out", *file, "--no-plots"])
    assert "subjects data;" in (tmp_path / "out/report/bases.md").read_text()
    with pytest.raises(SystemExit):
        cli.main(["report", "out", *file, "--subjects", "own", "data"])
    assert "was not begun" in capsys.readouterr().err


def test_the_command_says_what_failed_and_ends_with_1(experiment_of, tmp_path, capsys):
    experiment_of("fine", "broken")
    arguments = ["sweep", str(tmp_path / "bases.yaml"), "--output", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == 1
    told = capsys.readouterr().out
    # No terminal: a line for each cell as it ends, not only the table at the end.
    lines = told.split("variant")[0].splitlines()
    assert [line for line in lines if line.startswith("fine, data, seed 2: done 33.00")]
    assert [line for line in lines if line.startswith("broken, data, seed 0: failed")]
    assert "2 of 4 cells done" in told
    assert "CUDA out of memory, so to speak" in told
    assert "rgbavatar report" in told
    cli.main(["report", str(tmp_path / "out"), "--file", str(tmp_path / "bases.yaml")])
    assert "index.html" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("num_bases", "num_basis", "no field of the preset"),
        ("subjects: [", "subjects: [absent/", "does not exist"),
    ],
)
def test_an_experiment_that_is_refused_shows_no_table(
    experiment_of, tmp_path, capsys, old, new, told
):
    experiment_of("fine")
    file = tmp_path / "bases.yaml"
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(SystemExit) as ended:
        cli.main(["sweep", str(file), "--output", str(tmp_path / "out")])
    assert ended.value.code == 1
    shown = capsys.readouterr()
    assert told in shown.err
    assert not shown.out.strip()


def test_two_experiments_of_one_folder_keep_a_page_each(experiment_of, tmp_path, capsys):
    out = tmp_path / "out"
    sweep(experiment_of("a"), out, LocalEngine(2))
    cli.main(["report", str(out), "--no-plots"])
    assert [path.name for path in out.glob("report/*.html")] == ["index.html"]
    text = (tmp_path / "bases.yaml").read_text()
    (tmp_path / "other.yaml").write_text(text.replace("Bases & more", "Quite others"))
    sweep(read_experiment(tmp_path / "other.yaml"), out, LocalEngine(2))
    cli.main(["report", str(out), "--no-plots"])
    told = capsys.readouterr().out.replace("\n", "")
    pages = {path.name: path.read_text() for path in out.glob("report/*.html")}
    assert pages.keys() == {"bases.html", "other.html", "index.html"}
    assert "<h1>Bases &amp; more</h1>" in pages["bases.html"]
    assert "<h1>Quite others</h1>" in pages["other.html"]
    for name in ("bases.html", "other.html"):
        assert f'<a href="{name}">' in pages["index.html"]
        assert name in told


def test_a_report_before_the_sweep_is_refused(experiment_of, tmp_path):
    with pytest.raises(UserError, match="was not begun"):
        write_report(experiment_of("a"), tmp_path / "none")


@pytest.mark.parametrize(
    "content", ["[", "3", "[3]", '["cell"]', "[{}]", '[{"variant": 1, "unknown": 2}]', '{"a": 1}']
)
def test_a_list_of_cells_of_another_shape_is_refused(content, tmp_path):
    (tmp_path / "bases.json").write_text(content)
    with pytest.raises(UserError, match="was not begun"):
        read_statuses(tmp_path, "bases")


def test_cells_whose_fields_are_of_other_kinds_are_refused(experiment_of, tmp_path):
    (cell,) = cells_of(experiment_of("a", seeds="0"))
    (tmp_path / "bases.json").write_text(json.dumps([cell.to_json() | {"overrides": 3}]))
    with pytest.raises(UserError, match="was not begun"):
        read_statuses(tmp_path, "bases")


def test_without_ray_its_engine_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match="pip install 'ray"):
        RayEngine(None, 1.0, 0.0)
