"""What can go wrong while cells run: each is named, ends in an exit code, and loses nothing."""

import errno
import multiprocessing
import os
import signal
import sys

import pytest

from rgbavatar_ns.cli import main as cli
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments import commands, engines, read_experiment, runner
from rgbavatar_ns.experiments import sweep as sweep_module
from rgbavatar_ns.experiments.engines import LocalEngine
from rgbavatar_ns.experiments.process_lock import alone_in, end_with_parent
from rgbavatar_ns.experiments.runner import run_cell, write_cell
from rgbavatar_ns.experiments.sweep import cells_of, sweep

TEXT = """
title: Failures
preset: rgbavatar-tiny
subjects: [data]
metrics: [psnr]
variants: [{name: first}, {name: second, set: {max_num_iterations: 3}}]
"""

FAKE = """
import json, os, pathlib, resource, signal, sys
folder = pathlib.Path(sys.argv[1])
cell = json.loads((folder / "cell.json").read_text())
with (folder / "calls.txt").open("a") as calls:
    calls.write("x")
if cell["variant"] == "second":
    BREAK
(folder / "result.json").write_text(json.dumps({"metrics": {"psnr": 30.0}}))
"""


@pytest.fixture
def sweep_of(tmp_path, monkeypatch):
    """Reads an experiment of two cells, the second of which runs `break_` first."""
    (tmp_path / "data").mkdir()
    (tmp_path / "failures.yaml").write_text(TEXT)

    def build(break_: str = "pass"):
        path = tmp_path / "fake_runner.py"
        path.write_text(FAKE.replace("BREAK", break_))
        monkeypatch.setattr(engines, "_RUNNER", (sys.executable, str(path)))
        return read_experiment(tmp_path / "failures.yaml")

    return build


def _no_space(*arguments, **options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "somewhere")


def test_a_cell_killed_by_the_system_is_named(sweep_of, tmp_path):
    experiment = sweep_of("os.kill(os.getpid(), signal.SIGKILL)")
    first, second = sweep(experiment, tmp_path / "out", LocalEngine())
    assert (first.state, second.state) == ("done", "failed")
    assert second.why[-1] == "The cell was killed by SIGKILL, probably out of memory."
    assert (second.folder / "calls.txt").read_text() == "xx"


def test_a_cell_without_memory_says_so_and_the_command_ends_with_1(sweep_of, tmp_path, capsys):
    limit = "resource.setrlimit(resource.RLIMIT_AS, (2**28, 2**28)); bytearray(2**30)"
    sweep_of(limit)
    arguments = ["sweep", str(tmp_path / "failures.yaml"), "--output", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == 1
    told = capsys.readouterr().out
    assert "MemoryError" in told
    assert "1 of 2 cells done" in told


@pytest.mark.parametrize("full", ["write_json", "write_cell", "make_demo_dataset"])
def test_a_full_disk_is_named_and_finished_cells_are_kept(sweep_of, tmp_path, monkeypatch, full):
    experiment = sweep_of()
    done = sweep(experiment, tmp_path / "out", LocalEngine())
    (done[1].folder / "result.json").unlink()
    if full == "make_demo_dataset":
        text = TEXT.replace("[data]", "[data, 'demo:0:8:16']")
        (tmp_path / "failures.yaml").write_text(text)
        experiment = read_experiment(tmp_path / "failures.yaml")
    with monkeypatch.context() as patched:
        patched.setattr(sweep_module, full, _no_space)
        with pytest.raises(UserError, match=r"(?i)no space left") as refused:
            sweep(experiment, tmp_path / "out", LocalEngine())
    assert "finished cells are kept" in refused.value.remedy
    assert not list((tmp_path / "out").glob("data/demo*"))
    after = sweep(read_experiment(tmp_path / "failures.yaml"), tmp_path / "out", LocalEngine())
    assert {status.state for status in after} == {"done"}
    assert (done[0].folder / "calls.txt").read_text() == "x"


def test_a_full_disk_leaves_no_half_written_result(tmp_path, monkeypatch, sweep_of, capsys):
    cell = cells_of(sweep_of())[0]
    write_cell(tmp_path, cell, tmp_path / "data")
    monkeypatch.setattr(runner, "run_cell", _no_space)
    monkeypatch.setattr(sys, "argv", ["runner", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        runner.main()
    assert ended.value.code == 1
    assert "No space left on device" in capsys.readouterr().err
    assert not (tmp_path / "result.json").exists()


def test_a_lost_data_set_is_named_by_the_cell(tmp_path, monkeypatch, sweep_of):
    """The folder went after the sweep had begun."""
    cell = cells_of(sweep_of())[0]
    write_cell(tmp_path, cell, tmp_path / "gone")
    told = []

    def refuse(*command):
        told.append(command)
        raise UserError("There is no dataset.", "")

    monkeypatch.setattr(commands, "run_nerfstudio", refuse)
    with pytest.raises(UserError):
        run_cell(tmp_path)
    assert told[0][:4] == ("ns-train", "rgbavatar-tiny", "--data", tmp_path / "gone")


def test_a_finished_cell_is_not_run_again_by_a_second_process(tmp_path, monkeypatch):
    """A cluster that lost sight of a cell starts it anew; the first may have ended well."""
    (tmp_path / "result.json").write_text('{"metrics": {}}')
    monkeypatch.setattr(runner, "run_cell", _no_space)
    monkeypatch.setattr(sys, "argv", ["runner", str(tmp_path)])
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
    end_with_parent()
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
