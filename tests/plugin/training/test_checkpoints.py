"""Checkpoints are whole or absent, and a damaged newest one is passed over by name."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbavatar_ns.avatar.storage.checkpoint_file import list_checkpoints, read_checkpoint
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.training.checkpoints import (
    load_newest,
    remove_leftover,
    save_checkpoint,
)


def _state(step: int, size: int = 1000) -> dict[str, Any]:
    return {
        "step": step,
        "pipeline": {"weight": torch.full((size,), float(step))},
        "optimizers": {},
        "schedulers": {},
        "scalers": {},
    }


def _folder(tmp_path: Path, *steps: int, keep: int = 2) -> Path:
    folder = tmp_path / "run" / "nerfstudio_models"
    for step in steps:
        save_checkpoint(_state(step), folder, step, keep)
    return folder


def test_only_the_newest_are_kept(tmp_path: Path):
    folder = _folder(tmp_path, 10, 20, 30, keep=2)
    assert [step for step, _ in list_checkpoints(folder)] == [20, 30]
    assert sorted(os.listdir(folder)) == ["step-000000020.ckpt", "step-000000030.ckpt"]
    assert os.listdir(folder.parent) == ["nerfstudio_models"]


def test_newest_is_loaded(tmp_path: Path):
    folder = _folder(tmp_path, 10, 20)
    for place in (folder, folder.parent):
        told: list[str] = []
        state, path = load_newest(place, told.append)
        assert state["step"] == 20
        assert path.name == "step-000000020.ckpt"
        assert not told


@pytest.mark.parametrize("damage", ["truncated", "empty", "bit", "other"])
def test_damaged_newest_is_passed_over_and_named(tmp_path: Path, damage: str):
    folder = _folder(tmp_path, 10, 20)
    newest = folder / "step-000000020.ckpt"
    content = bytearray(newest.read_bytes())
    if damage == "truncated":
        content = content[: len(content) // 2]
    elif damage == "empty":
        content = bytearray()
    elif damage == "bit":
        # Inside the stored tensor, whose bytes are those of 20.0 over and over.
        content[content.index(torch.full((8,), 20.0).numpy().tobytes()) + 3] ^= 1
    else:
        torch.save({"step": 20}, newest)
        content = bytearray(newest.read_bytes())
    newest.write_bytes(bytes(content))
    told: list[str] = []
    state, path = load_newest(folder, told.append)
    assert state["step"] == 10
    assert torch.equal(state["pipeline"]["weight"], torch.full((1000,), 10.0))
    assert path.name == "step-000000010.ckpt"
    assert len(told) == 1
    assert newest.name in told[0]


def test_no_checkpoint_at_all_is_a_user_error(tmp_path: Path):
    with pytest.raises(UserError, match="no checkpoint in"):
        load_newest(tmp_path / "absent", print)
    folder = _folder(tmp_path, 10)
    (folder / "step-000000010.ckpt").write_bytes(b"no checkpoint")
    with pytest.raises(UserError, match="None of the 1 checkpoints"):
        load_newest(folder, print)
    with pytest.raises(UserError, match="no checkpoint"):
        read_checkpoint(folder / "step-000000099.ckpt")


def test_code_in_a_checkpoint_is_not_run(tmp_path: Path):
    class Trap:
        def __reduce__(self) -> Any:
            return (Path(tmp_path / "ran").touch, ())

    folder = _folder(tmp_path, 10)
    torch.save(_state(20) | {"trap": Trap()}, folder / "step-000000020.ckpt")
    assert load_newest(folder, lambda _: None)[0]["step"] == 10
    assert not (tmp_path / "ran").exists()


def test_failing_write_keeps_the_old_checkpoint(tmp_path: Path):
    folder = _folder(tmp_path, 10)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(
            UserError, match=r"Cannot write .*step-000000020.*resume with --load-dir"
        ):
            save_checkpoint(_state(20, size=1_000_000), folder, 20, 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert os.listdir(folder.parent) == ["nerfstudio_models"]
    assert load_newest(folder, print)[0]["step"] == 10


_KILLED_WHILE_WRITING = """
import os, signal, sys, torch
from pathlib import Path
from rgbavatar_ns.plugin.training.checkpoints import save_checkpoint
def die(*_): os.kill(os.getpid(), signal.SIGKILL)
setattr(os, sys.argv[2], die)
state = {"step": 20, "pipeline": {"w": torch.zeros(1000)}}
save_checkpoint(state, Path(sys.argv[1]), 20, 1)
"""


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["fsync", "replace"])
def test_sigkill_while_writing_keeps_the_old_checkpoint(tmp_path: Path, moment: str):
    folder = _folder(tmp_path, 10)
    command = [sys.executable, "-c", _KILLED_WHILE_WRITING, str(folder), moment]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    assert sorted(os.listdir(folder)) == ["step-000000010.ckpt"]
    assert load_newest(folder, print)[0]["step"] == 10
    # What the killed write left behind does not stand in the way of the next one.
    save_checkpoint(_state(30), folder, 30, 1)
    assert os.listdir(folder.parent) == ["nerfstudio_models"]
    assert load_newest(folder, print)[0]["step"] == 30


@pytest.mark.parametrize(("age_s", "stays"), [(0.0, True), (3600.0, False)])
def test_what_a_killed_run_left_is_removed_unless_one_may_be_saving(
    tmp_path: Path, age_s: float, stays: bool
):
    leftover = tmp_path / ".nerfstudio_models.partial"
    leftover.write_bytes(b"half")
    os.utime(leftover, (time.time() - age_s,) * 2)
    for _ in range(2):
        remove_leftover(tmp_path / "nerfstudio_models")
        assert leftover.exists() == stays
