"""Results for the documentation: whole, the same when written again, nothing of this machine."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbavatar_ns.cli import main as cli
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments import read_experiment
from rgbavatar_ns.experiments import sweep as sweep_module
from rgbavatar_ns.experiments.cells import cells_of
from rgbavatar_ns.experiments.engines import LocalEngine
from rgbavatar_ns.experiments.kept import kept_results
from rgbavatar_ns.experiments.runner import run_folder_of
from rgbavatar_ns.experiments.source import keep_source
from rgbavatar_ns.experiments.sweep import read_statuses, sweep
from rgbavatar_ns.experiments.tables import result_table
from rgbavatar_ns.files import write_json
from rgbavatar_ns.synthetic import DemoConfig

TEXT = """
title: Two of them
preset: rgbavatar-tiny
paper_data: INSTA
metrics: [psnr, psnr_refined, sharpness, megabytes]
subjects: [SUBJECTS]
seeds: [0, 1]
variants:
  - name: one
    paper: {psnr: 31.19}
  - name: two
    set: {pipeline.model.avatar.num_bases: 5}
tiny: {seeds: [0]}
"""
MADE = {"processor": "A CPU", "gpu": None, "cores": 2, "instruction_set": "avx2", "torch": "2.4"}


def _sweep(folder: Path, file: Path, done=lambda cell: True, **options) -> Path:
    """A sweep of made-up figures, as far as `done`; its LPIPS names a place of this machine."""
    experiment = read_experiment(file, **options)
    cells = cells_of(experiment)
    write_json(folder / f"{experiment.name}.json", [cell.to_json() for cell in cells])
    keep_source(folder, experiment)
    for k, cell in enumerate(cells):
        if not done(cell):
            continue
        place = folder / "cells" / cell.key
        metrics = {"psnr": 30.0 + k, "psnr_refined": 31.0 + k, "sharpness": 0.5, "megabytes": 7.25}
        metrics |= {"steps": 11, "train_seconds": 9.0}
        made = {**MADE, "commit": f"abc{k // 4}", "date": f"2030-01-0{1 + k // 4} 12:00"}
        why = {"psnr_refined": f"no file {folder}/cache/vgg.pth; see https://a.org/b/vgg"}
        result = {"metrics": metrics, "made": made, "run": str(place), "unavailable": why}
        write_json(place / "result.json", result)
        points = [{"step": s, "train_seconds": s / 2.0, "psnr": 20.0 + s + k} for s in (2, 6)]
        write_json(run_folder_of(place, cell) / "curve.json", {"points": points})
        rng = np.random.default_rng(k)
        (place / "pictures").mkdir()
        for number in (4, 9):
            for kind in ("film", "avatar"):
                picture = rng.integers(0, 255, (512, 512, 3), np.uint8)
                cv2.imwrite(str(place / f"pictures/{kind}_{number:06d}.png"), picture)
    return folder


@pytest.fixture
def file(tmp_path: Path) -> Path:
    for name in ("hannah", "otto"):
        (tmp_path / "private" / name).mkdir(parents=True)
    path = tmp_path / "two.yaml"
    subjects = ", ".join(str(tmp_path / "private" / name) for name in ("hannah", "otto"))
    path.write_text(TEXT.replace("SUBJECTS", subjects))
    return path


def _contents(docs: Path) -> dict[str, bytes]:
    return {str(p.relative_to(docs)): p.read_bytes() for p in docs.rglob("*") if p.is_file()}


def test_the_page_tells_all_of_it_and_nothing_of_the_machines_paths(file, tmp_path):
    docs = tmp_path / "docs"
    cli.main(["report", str(_sweep(tmp_path / "out", file)), "--into", str(docs)])
    written = _contents(docs)
    sheets = {f"results/two_subject{k}.jpg" for k in (1, 2)}
    assert written.keys() == {
        "results.md",
        "results/two.json",
        "results/two_convergence.png",
        *sheets,
    }
    assert all(len(content) < 300_000 for content in written.values())
    page = written["results.md"].decode()
    for told in (
        "## Two of them\n\n`rgbavatar sweep two.yaml`",
        "A CPU, 2 cores; torch 2.4; commit abc0, abc1; 2030-01-01 to 2030-01-02",
        # Cells of one: 30, 31 on hannah, 32, 33 on otto; seeds part by 1, so by sqrt(1/2).
        "| one | 31.50 ± 0.71 | 32.50 ± 0.71 | 0.50 ± 0.00 | 7.2 ± 0.0 | 31.19 |",
        "| hannah | two | 34.50 ± 0.71 |",
        "PSNR, theta fitted: theta fitted to each held-out picture first",
        "no file vgg.pth; see https://a.org/b/vgg",
        "![Two of them](results/two_convergence.png)",
        "![Two of them](results/two_subject2.jpg)",
    ):
        assert told in page, told
    for content in written.values():
        assert str(tmp_path).encode() not in content
        assert str(Path.home()).encode() + b"/" not in content
    kept = json.loads(written["results/two.json"])["cells"].values()
    (cell,) = (cell for cell in kept if cell["metrics"]["psnr"] == 31.0)
    assert {name: cell[name] for name in ("variant", "subject", "seed", "curve")} == {
        "variant": "one",
        "subject": "hannah",
        "seed": 1,
        "curve": {"2": [1.0, 23.0], "6": [3.0, 27.0], "10": [9.0, 31.0]},
    }


def test_written_again_it_is_the_same_and_others_stay(file, tmp_path):
    docs = tmp_path / "docs"
    folder = _sweep(tmp_path / "out", file)
    cli.main(["report", str(folder), "--into", str(docs)])
    first = _contents(docs)
    cli.main(["report", str(folder), "--into", str(docs)])
    assert _contents(docs) == first
    tiny = _sweep(tmp_path / "tiny", file, tiny=True)
    cli.main(["report", str(tiny), "--into", str(docs)])
    second = _contents(docs)
    assert all(second[name] == content for name, content in first.items() if "/" in name)
    page = second["results.md"].decode()
    assert page.index("## Two of them (--tiny)") < page.index("## Two of them\n")
    assert "`rgbavatar sweep two.yaml --tiny`" in page
    # One seed: no spread.
    assert "| one | 30.50 | 31.50 | 0.50 | 7.2 | 31.19 |" in page
    # The page alone, of what lies there.
    (docs / "results.md").unlink()
    cli.main(["report", "--into", str(docs)])
    assert _contents(docs) == second


def test_drawings_that_are_no_more_are_removed(file, tmp_path):
    docs = tmp_path / "docs"
    folder = _sweep(tmp_path / "out", file)
    cli.main(["report", str(folder), "--into", str(docs)])
    (docs / "results" / "others.png").write_bytes(b"")
    for path in folder.glob("cells/*/pictures/*"):
        path.unlink()
    cli.main(["report", str(folder), "--into", str(docs)])
    names = {path.name for path in (docs / "results").iterdir()}
    assert names == {"two.json", "two_convergence.png", "others.png"}


@pytest.fixture
def in_parts(file, tmp_path, monkeypatch):
    """Docs of one sweep in two parts, a subject on each of two machines, and the whole's docs.

    The second machine has its datasets elsewhere; its folder is the third that is returned.
    """
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(tmp_path / "private", elsewhere / "private")
    subjects = ("private/hannah", "private/otto")
    parts, whole = tmp_path / "parts", tmp_path / "whole"
    for at, subject in ((tmp_path, "hannah"), (elsewhere, "otto")):
        monkeypatch.chdir(at)
        mine = lambda cell, name=subject: Path(cell.subject).name == name  # noqa: E731
        folder = _sweep(at / "out", file, mine, subjects=subjects)
        cli.main(["report", str(folder), "--into", str(parts)])
    cli.main(
        ["report", str(_sweep(elsewhere / "all", file, subjects=subjects)), "--into", str(whole)]
    )
    return parts, whole, folder


def test_a_sweep_in_parts_on_two_machines_is_told_as_one(in_parts):
    parts, whole, folder = in_parts
    told, expected = _contents(parts), _contents(whole)
    assert told.keys() == expected.keys()
    (name,) = (name for name in expected if name.endswith(".json"))
    got, wanted = json.loads(told.pop(name)), json.loads(expected.pop(name))
    for content in (got, wanted):
        # Links to a machine's cells: those of datasets are of their places there.
        for row in (*content["table"]["rows"], *content["table"]["subject_rows"]):
            row["cells"] = len(row["cells"])
    assert got == wanted
    assert told == expected
    # Once more from the second machine's folder, which still has its own half alone.
    cli.main(["report", str(folder), "--into", str(parts)])
    assert {n: c for n, c in _contents(parts).items() if n != name} == told


def test_what_another_machine_finished_is_not_run_again(in_parts, file, tmp_path):
    parts, _, folder = in_parts
    (known,) = (parts / "results").glob("*.json")
    experiment = read_experiment(file, subjects=("private/hannah", "private/otto"))

    class Idle(LocalEngine):
        def run(self, folders, finished):
            raise AssertionError(folders)

    statuses = sweep(experiment, folder, Idle(), known=[known])
    assert [status.state for status in statuses] == ["done"] * 8
    # Of a third machine, that has nothing yet: all figures are those that were kept.
    third = sweep(experiment, tmp_path / "third", Idle(), known=[known])
    assert [(s.result or {})["metrics"] for s in third] == [
        (s.result or {})["metrics"] for s in statuses
    ]
    with pytest.raises(UserError, match=r"two.yaml holds no results of cells"):
        sweep(experiment, folder, Idle(), known=[file])


def test_a_kept_figure_that_is_not_finite_stays_a_gap(in_parts, file, tmp_path):
    parts, _, folder = in_parts
    (path,) = (parts / "results").glob("*.json")
    content = json.loads(path.read_text())
    for cell in content["cells"].values():
        cell["metrics"]["psnr"] = None
        cell["curve"]["6"][1] = None
    path.write_text(json.dumps(content))
    cli.main(["report", str(folder), "--into", str(parts)])
    # Hannah's cells are kept ones, Otto's ran in the folder.
    page = (parts / "results.md").read_text()
    assert "| hannah | two | - |" in page
    assert "| otto | two | 36.50 ± 0.71 |" in page


def test_only_subjects_of_missing_cells_are_drawn(file, tmp_path, monkeypatch):
    """The others' cells are known from another machine."""
    chosen = ("demo:0:8:16", "demo:1:8:16")
    folder = _sweep(tmp_path / "out", file, lambda cell: cell.subject == chosen[0], subjects=chosen)
    cli.main(["report", str(folder), "--into", str(tmp_path / "docs")])
    (known,) = (tmp_path / "docs" / "results").glob("*.json")
    drawn: list[str] = []

    def draw(folder: Path, config: DemoConfig, **options: object) -> None:
        drawn.append(f"demo:{config.seed}")

    class Ready(LocalEngine):
        def run(self, folders, finished):
            assert len(folders) == 4

    monkeypatch.setattr(sweep_module, "make_demo_dataset", draw)
    sweep(read_experiment(file, subjects=chosen), tmp_path / "third", Ready(), known=[known])
    assert drawn == ["demo:1"]


def test_cells_that_shared_their_machine_are_told_where_seconds_count(file, tmp_path):
    folder = _sweep(tmp_path / "out", file)
    experiment = read_experiment(file)
    timed = replace(experiment, metrics=("psnr", "train_seconds"))
    shared = "2 of 8 cells may have shared their machine with others: training, s are not those"
    for path in sorted(folder.glob("cells/*/result.json"))[:2]:
        result = json.loads(path.read_text())
        result["made"]["side_by_side"] = True
        path.write_text(json.dumps(result))
    statuses = read_statuses(folder, experiment.name)
    assert shared in result_table(timed, statuses).to_markdown()
    assert "shared their machine" not in result_table(experiment, statuses).to_markdown()
    for status in statuses:
        status.cell = replace(status.cell, overrides={"max_train_seconds": 60.0})
    told = result_table(experiment, statuses).to_markdown()
    assert "with others: runs that end by the clock took fewer steps for it." in told
    for status in statuses:
        (status.result or {})["made"]["side_by_side"] = False
    assert "shared their machine" not in result_table(timed, statuses).to_markdown()


@pytest.mark.parametrize("at_once", [1, 2])
def test_an_engine_of_several_cells_at_once_says_so_to_each(file, tmp_path, at_once):
    class Ready(LocalEngine):
        def run(self, folders, finished):
            told = {json.loads((f / "cell.json").read_text())["side_by_side"] for f in folders}
            assert told == {at_once > 1}

    sweep(read_experiment(file), tmp_path / "out", Ready(at_once))


def test_a_cell_that_began_beside_others_and_goes_on_alone_has_shared_its_seconds(file, tmp_path):
    """One that had not begun has not."""

    class Ready(LocalEngine):
        def run(self, folders, finished):
            for folder in folders:
                described = json.loads((folder / "cell.json").read_text())
                told[folder] = described["side_by_side"]

    told: dict[Path, bool] = {}
    experiment = read_experiment(file)
    begun, *others = (s.folder for s in sweep(experiment, tmp_path / "out", Ready(4)))
    models = run_folder_of(begun, cells_of(experiment)[0]) / "nerfstudio_models"
    models.mkdir(parents=True)
    (models / "step-000000010.ckpt").touch()
    for _ in range(2):
        sweep(experiment, tmp_path / "out", Ready(1))
        assert told == {begun: True, **dict.fromkeys(others, False)}


@pytest.mark.parametrize("damage", [{}, {"metrics": {"psnr": "good"}, "curve": {}}])
def test_kept_cells_without_figures_are_told(damage, tmp_path):
    path = tmp_path / "x.json"
    path.write_text(json.dumps({"cells": {"abc": damage}}))
    with pytest.raises(UserError, match="holds no results of cells"):
        kept_results(path)


def test_all_variants_of_one_subject_run_before_the_next_subject(file, tmp_path):
    ordered: list[tuple[int, str, str]] = []

    class Listing(LocalEngine):
        def run(self, folders, finished):
            cells = [json.loads((folder / "cell.json").read_text()) for folder in folders]
            told = [(cell["seed"], Path(cell["subject"]).name, cell["variant"]) for cell in cells]
            ordered.extend(told)

    sweep(read_experiment(file), tmp_path / "out", Listing())
    # Tried twice, since none of them is done by it.
    assert len(ordered) == 16
    assert ordered[:8] == sorted(ordered[:8])


def test_subjects_of_the_command_line_are_told_by_name(file, tmp_path):
    chosen = (str(tmp_path / "private" / "otto"),)
    folder = _sweep(tmp_path / "out", file, subjects=chosen)
    cli.main(["report", str(folder), "--into", str(tmp_path / "docs")])
    page = (tmp_path / "docs" / "results.md").read_text()
    assert "`rgbavatar sweep two.yaml --subjects otto`" in page
    assert "subjects otto;" in page


def test_a_folder_is_reported_without_its_file(file, tmp_path, capsys):
    folder = _sweep(tmp_path / "out", file)
    cli.main(["report", str(folder), "--no-plots"])
    assert "31.50" in capsys.readouterr().out
    assert (folder / "report" / "two.md").exists()


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        ("none", "does not say what was swept there"),
        ("source", "does not say what was swept"),
        ("result", "holds no result of this version"),
    ],
)
def test_what_cannot_be_read_is_named(file, tmp_path, damage, told):
    from rgbavatar_ns.experiments.results import write_page, write_results

    folder, docs = _sweep(tmp_path / "out", file), tmp_path / "docs"
    if damage == "none":
        (folder / "two.source.json").unlink()
    if damage == "source":
        (folder / "two.source.json").write_text('{"file": 3}')
    (docs / "results").mkdir(parents=True)
    (docs / "results" / "old.json").write_text("[]")
    with pytest.raises(UserError, match=told):
        write_page(docs) if damage == "result" else write_results(folder, docs)


def test_nothing_to_report_on_is_told():
    from rgbavatar_ns.cli.report import run

    with pytest.raises(UserError, match="no sweep to report on"):
        run()
