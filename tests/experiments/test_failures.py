"""What can go wrong while cells run: each is named, ends in an exit code, and loses nothing."""

import csv
import errno
import multiprocessing
import os
import signal
import sys

import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments import runner
from rgbavatar_ns.experiments import sweep as sweep_module
from rgbavatar_ns.experiments.engines import LocalEngine
from rgbavatar_ns.experiments.process_lock import alone_in, alone_in_sweep, end_with_parent
from rgbavatar_ns.experiments.report import write_report
from rgbavatar_ns.experiments.runner import run_cell, write_cell
from rgbavatar_ns.experiments.sweep import cells_of, read_statuses, sweep
from rgbavatar_ns.experiments.tables import result_table


def _no_space(*arguments, **options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "somewhere")


@pytest.mark.parametrize(
    ("break_", "told"),
    [
        (
            "os.kill(os.getpid(), signal.SIGKILL)",
            "The cell was killed by SIGKILL, probably out of memory.",
        ),
        (
            "resource.setrlimit(resource.RLIMIT_AS, (2**28, 2**28)); bytearray(2**30)",
            "MemoryError",
        ),
    ],
)
def test_a_cell_without_memory_is_named(experiment_of, tmp_path, break_, told):
    experiment = experiment_of("fine", "broken", seeds="0", break_=break_)
    first, second = sweep(experiment, tmp_path / "out", LocalEngine())
    assert (first.state, second.state) == ("done", "failed")
    assert second.why[-1] == told
    assert (second.folder / "calls.txt").read_text() == "xx"


@pytest.mark.parametrize("full", ["write_json", "write_cell", "make_demo_dataset"])
def test_a_full_disk_is_named_and_finished_cells_are_kept(
    experiment_of, tmp_path, monkeypatch, full
):
    experiment = experiment_of("first", "second", seeds="0")
    done = sweep(experiment, tmp_path / "out", LocalEngine())
    (done[1].folder / "result.json").unlink()
    if full == "make_demo_dataset":
        experiment = experiment_of("first", "second", seeds="0", subjects="data, 'demo:0:8:16'")
    with monkeypatch.context() as patched:
        patched.setattr(sweep_module, full, _no_space)
        with pytest.raises(UserError, match=r"(?i)no space left") as refused:
            sweep(experiment, tmp_path / "out", LocalEngine())
    assert "finished cells are kept" in refused.value.remedy
    assert not list((tmp_path / "out").glob("data/demo*"))
    after = sweep(experiment, tmp_path / "out", LocalEngine())
    assert {status.state for status in after} == {"done"}
    assert (done[0].folder / "calls.txt").read_text() == "x"


def test_a_full_disk_leaves_no_half_written_result(tmp_path, monkeypatch, experiment_of, capsys):
    cell = cells_of(experiment_of("first"))[0]
    write_cell(tmp_path, cell, tmp_path / "data")
    monkeypatch.setattr(runner, "run_cell", _no_space)
    monkeypatch.setattr(sys, "argv", ["runner", str(tmp_path), str(os.getppid())])
    with pytest.raises(SystemExit) as ended:
        runner.main()
    assert ended.value.code == 1
    assert "No space left on device" in capsys.readouterr().err
    assert not (tmp_path / "result.json").exists()


def test_what_the_system_refused_is_told_with_where_it_came_from(
    tmp_path, monkeypatch, experiment_of, capsys
):
    """It need not be the cell's folder, and what led to it says more."""
    cell = cells_of(experiment_of("first"))[0]
    write_cell(tmp_path, cell, tmp_path / "data")

    def load_the_trackers_library(folder):
        try:
            raise ValueError("the tracker's file is for another machine")
        except ValueError as error:
            raise OSError("libtracker.so cannot be loaded") from error

    monkeypatch.setattr(runner, "run_cell", load_the_trackers_library)
    monkeypatch.setattr(sys, "argv", ["runner", str(tmp_path), str(os.getppid())])
    with pytest.raises(SystemExit) as ended:
        runner.main()
    assert ended.value.code == 1
    told = capsys.readouterr().err
    assert "the tracker's file is for another machine" in told
    assert "in load_the_trackers_library" in told
    assert told.splitlines()[-1] == "The cell ended with OSError: libtracker.so cannot be loaded."


def test_a_failure_is_kept_for_reports_until_the_cell_is_done(experiment_of, tmp_path):
    out, subjects = tmp_path / "out", "data, more"
    (tmp_path / "more").mkdir()
    fine = experiment_of("fine", "broken", subjects=subjects, seeds="0", break_="pass")
    done = sweep(fine, out, LocalEngine(2))
    assert [row.shown_name for row in result_table(fine, done).rows] == ["fine", "broken"]
    (done[3].folder / "result.json").unlink()
    lines = [
        "Error: The loss of step 3 is nan.",
        "Take smaller rates.",
        "ns-train ended with exit code 1; its last lines above say why. Then call it again.",
    ]
    break_ = f"print(*{lines!r}, sep=chr(10)); sys.exit(1)"
    experiment = experiment_of("fine", "broken", subjects=subjects, seeds="0", break_=break_)
    sweep(experiment, out, LocalEngine(2))
    statuses = read_statuses(out, "bases")
    assert [status.state for status in statuses] == ["done"] * 3 + ["failed"]
    assert "Take smaller rates." in statuses[3].why
    table = result_table(experiment, statuses)
    markdown = table.to_markdown()
    assert "| fine | 31.00 |" in markdown
    # Its mean is over one subject, which the row says.
    assert "| broken (1 of 2 cells) | 32.00 |" in markdown
    assert "| more | broken (0 of 1 cells) | - |" in markdown
    reason = "broken: 1 of 2 cells; failed: more, seed 0: The loss of step 3 is nan."
    assert f"- {reason}\n" in markdown
    assert "broken (1 of 2 cells) &" in table.to_latex()
    planned = [row["planned"] for row in csv.DictReader(table.to_csv().splitlines())]
    assert planned == ["2", "2", "1", "1", "1", "1"]
    page = write_report(experiment, out).paths[-1].read_text()
    assert reason in page
    assert "Take smaller rates." in page
    again = experiment_of("fine", "broken", subjects=subjects, seeds="0", break_="pass")
    assert {status.state for status in sweep(again, out, LocalEngine(2))} == {"done"}
    assert not list(out.glob("cells/*/failed.json"))
    assert [s.state for s in read_statuses(out, "bases")] == ["done"] * 4


def test_a_second_sweep_into_a_folder_is_refused(experiment_of, tmp_path):
    experiment = experiment_of("first", seeds="0")
    here, there = _fork.Pipe()
    other = _fork.Process(target=_sweep_into, args=(tmp_path / "out", there))
    other.start()
    assert here.poll(_SECONDS)
    with pytest.raises(UserError, match=r"Another process sweeps into .*out") as refused:
        sweep(experiment, tmp_path / "out", LocalEngine())
    assert "--output" in refused.value.remedy
    assert not (tmp_path / "out" / "bases.json").exists()
    here.send("end")
    other.join()
    (status,) = sweep(experiment, tmp_path / "out", LocalEngine())
    assert status.state == "done"


def _sweep_into(folder, pipe):
    with alone_in_sweep(folder):
        pipe.send("held")
        pipe.recv()


def test_a_lost_data_set_is_named_by_the_cell(tmp_path, monkeypatch, experiment_of):
    """The folder went after the sweep had begun."""
    cell = cells_of(experiment_of("first"))[0]
    write_cell(tmp_path, cell, tmp_path / "gone")
    told = []

    def refuse(*command):
        told.append(command)
        raise UserError("There is no dataset.", "")

    monkeypatch.setattr(runner.commands, "run_nerfstudio", refuse)
    with pytest.raises(UserError):
        run_cell(tmp_path)
    assert told[0][:4] == ("ns-train", "rgbavatar-tiny", "--data", tmp_path / "gone")


def test_a_finished_cell_is_not_run_again_by_a_second_process(tmp_path, monkeypatch):
    """A cluster that lost sight of a cell starts it anew; the first may have ended well."""
    (tmp_path / "result.json").write_text('{"metrics": {}}')
    monkeypatch.setattr(runner, "run_cell", _no_space)
    monkeypatch.setattr(sys, "argv", ["runner", str(tmp_path), str(os.getppid())])
    runner.main()


# Copies of this process: they need not import anything again.
_fork = multiprocessing.get_context("fork")
_SECONDS = 60.0


def _hold(folder, pipe):
    with alone_in(folder):
        pipe.send("held")
        pipe.recv()
        (folder / "ended").touch()


def test_one_process_at_a_time_works_in_a_folder(tmp_path):
    here, there = _fork.Pipe()
    other = _fork.Process(target=_hold, args=(tmp_path, there))
    other.start()
    assert here.poll(_SECONDS)

    def let_it_end(line):
        assert "still works on this cell" in line
        assert not (tmp_path / "ended").exists()
        here.send("end")

    with alone_in(tmp_path, let_it_end):
        assert (tmp_path / "ended").exists()
    other.join()


def _work(pipe):
    cell = _fork.Process(target=_work_on_a_cell, args=(pipe,))
    cell.start()
    cell.join()


def _work_on_a_cell(pipe):
    os.setsid()
    end_with_parent(os.getppid())
    try:
        pipe.send("begun")
        signal.pause()
    except KeyboardInterrupt:
        pipe.send("interrupted")


def test_a_cell_ends_with_the_worker_that_started_it():
    here, there = _fork.Pipe()
    worker = _fork.Process(target=_work, args=(there,))
    worker.start()
    assert here.poll(_SECONDS)
    assert here.recv() == "begun"
    worker.kill()
    assert here.poll(_SECONDS)
    assert here.recv() == "interrupted"
    worker.join()
