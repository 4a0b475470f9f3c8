"""What the plots of a sweep show, read off the figures before they are written."""

from dataclasses import replace

import numpy as np
import pytest

from rgbavatar_ns.experiments import plots
from rgbavatar_ns.experiments.runner import run_folder_of
from rgbavatar_ns.experiments.sweep import CellStatus, cells_of
from rgbavatar_ns.files import write_json


@pytest.fixture
def drawn(monkeypatch):
    """The figures that would have been saved."""
    figures = []

    def keep(figure, folder, stem):
        figures.append(figure)
        return folder / stem

    monkeypatch.setattr(plots, "_saved", keep)
    return figures


def _done(cell, folder, seconds):
    """A finished cell of 41 steps, whose score at the end is 30."""
    place = folder / cell.key
    metrics = {"steps": 41, "train_seconds": seconds, "psnr": 30.0}
    return CellStatus(cell, place, "done", {"metrics": metrics})


def test_convergence_has_a_line_a_variant_and_a_thin_one_a_seed(experiment_of, tmp_path, drawn):
    experiment = experiment_of("a", "b", "c")
    statuses = [
        _done(cell, tmp_path / "cells", 8.0 + 2 * k) for k, cell in enumerate(cells_of(experiment))
    ]
    # The first seed of a was looked at once more; c never was.
    for k, steps in enumerate([(10, 20, 30), (10, 30), (10, 30), (10, 30)]):
        points = [
            {"step": step, "train_seconds": step / 10 + k, "psnr": 20 + step / 10 + k}
            for step in steps
        ]
        folder = run_folder_of(statuses[k].folder, statuses[k].cell)
        write_json(folder / "curve.json", {"points": points})
    plots.write_convergence(experiment, statuses, tmp_path, "x")
    (axes,) = drawn[0].axes
    lines = {line.get_label(): np.array(line.get_data()).T for line in axes.lines}
    named = [name for name in lines if not name.startswith("_")]
    assert named == ["a", "b"]
    assert len(axes.lines) == 6
    # Means over both seeds at the steps that both have, and at the end.
    assert lines["a"] == pytest.approx(np.array([[1.5, 21.5], [3.5, 23.5], [9.0, 30.0]]))
    assert axes.get_xscale() == "linear"
    assert axes.get_xlim()[0] == 0


def test_convergence_passes_over_points_without_psnr(experiment_of, tmp_path):
    """As they were written where no score was a finite number."""
    status = _done(cells_of(experiment_of("a"))[0], tmp_path, 9.0)
    points = [
        {"step": 10, "train_seconds": 1.0, "psnr": 21.0},
        {"step": 20, "train_seconds": 2.0, "ssim": 1.0},
    ]
    write_json(run_folder_of(status.folder, status.cell) / "curve.json", {"points": points})
    assert plots.convergence(status) == {10: (1.0, 21.0), 40: (9.0, 30.0)}


def test_no_convergence_without_evaluations_in_training(experiment_of, tmp_path, drawn):
    experiment = experiment_of("a")
    statuses = [_done(cell, tmp_path, 1.0) for cell in cells_of(experiment)]
    statuses.append(replace(statuses[0], state="failed", result=None))
    assert plots.write_convergence(experiment, statuses, tmp_path, "x") == []
    assert drawn == []


def test_forgetting_has_a_panel_a_variant_with_both_lines(experiment_of, tmp_path, drawn):
    experiment = experiment_of("a", "b", seeds="0")
    statuses = [_done(cell, tmp_path, 1.0) for cell in cells_of(experiment)]
    watched = {"watched_index": [0, 2], "least_l1": [0.1, 0.2]}
    for status, least in zip(statuses, (watched, {})):
        content = {"frame_index": [0, 1, 2], "l1": [0.3, 0.5, 0.2], **least}
        write_json(status.folder / "streamed.json", content)
    plots.write_forgetting_curves(statuses, tmp_path, "x")
    first, second = drawn[0].axes
    assert first.get_title() == "a: 0.10000 forgotten"
    after, least = (np.array(line.get_data()).T.tolist() for line in first.lines)
    assert after == [[0, 0.3], [2, 0.2]]
    assert least == [[0, 0.1], [2, 0.2]]
    assert second.get_title() == "b"
    assert [len(line.get_xdata()) for line in second.lines] == [3]
    assert first.get_ylim() == second.get_ylim()


def test_axes_do_not_make_small_differences_large():
    """0.1 dB do not fill an axis of PSNR; what is counted begins at 0; wide ranges stay."""
    low, high = plots._fair_range("psnr", (30.0, 30.1))
    assert (low + high) / 2 == pytest.approx(30.05)
    assert high - low == pytest.approx(2)
    assert plots._fair_range("psnr", (20.0, 30.0)) == (20.0, 30.0)
    assert plots._fair_range("train_seconds", (80.0, 81.0)) == (0.0, 81.0)
