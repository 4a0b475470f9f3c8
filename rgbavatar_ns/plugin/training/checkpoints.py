"""A trainer's checkpoints: written whole or not at all, and what it needs in order to go on."""

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from rgbavatar_ns.avatar.storage.bundle import CHECKPOINT_PREFIX
from rgbavatar_ns.avatar.storage.checkpoint_file import (
    checkpoints_of,
    list_checkpoints,
    read_checkpoint,
    read_newest,
)
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import atomic_write

_REQUIRED = frozenset({"step", "pipeline", "optimizers", "schedulers", "scalers"})
BEFORE_END = "before_end"
"""Where a checkpoint keeps what the end of its run has changed of the avatar, as it was before."""
LATEST = "latest"
# What a zip file's directory and small values may add to the tensors' bytes.
_OVERHEAD_BYTES = 4 << 20
_STILL_S = 60.0


def save_checkpoint(state: dict[str, Any], folder: Path, step: int, keep: int) -> Path:
    """Write `folder/step-XXXXXXXXX.ckpt` atomically, then remove all but the newest `keep`.

    So are those of later steps, which an earlier run has left here, or the way that a run has gone
    back from: everybody would take them for the newest. The file grows under another name beside
    the folder (nerfstudio takes every file inside it for a checkpoint), is synced and renamed: at
    any moment the folder holds only whole files.

    Raises:
        UserError: there is too little space; older checkpoints are untouched.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = checkpoint_of_step(folder, step)
    beside = _partial(folder)
    remedy = f"Free space and resume with --load-dir {folder}; the checkpoints there are untouched."
    _require_space(
        folder, sum(tensor.nbytes for tensor in _tensors(state)) + _OVERHEAD_BYTES, remedy
    )
    with (
        atomic_write(path, partial=beside, remedy=remedy, also=(RuntimeError,)) as partial,
        partial.open("wb") as file,
    ):
        torch.save(state, file)
    there = list_checkpoints(folder)
    kept = [one for number, one in there if number <= step][-max(1, keep) :]
    for _, old in there:
        if old not in kept:
            old.unlink()
    return path


def checkpoint_of_step(folder: Path, step: int) -> Path:
    """Where a step's checkpoint lies, as nerfstudio names it."""
    return folder / f"step-{step:09d}.ckpt"


def remove_leftover(folder: Path) -> None:
    """Remove what a run that was killed while it saved has left beside its checkpoints.

    A file that has just grown is left, for a run may be alive and saving.
    """
    leftover = _partial(folder)
    with suppress(OSError):
        if time.time() - leftover.stat().st_mtime > _STILL_S:
            leftover.unlink()


def _partial(folder: Path) -> Path:
    return folder.parent / f".{folder.name}.partial"


def load_newest(folder: Path, tell: Callable[[str], object]) -> tuple[dict[str, Any], Path]:
    """Read the newest checkpoint in `folder` that can be read, telling which were passed over.

    `folder` may be a run's folder too. Raises UserError where there is no readable one.
    """
    return read_newest(require_checkpoints(folder), read_training_state, tell)


def require_checkpoints(folder: Path) -> list[Path]:
    """Those in `folder`, or in a run's folder, oldest first; raises UserError without any."""
    checkpoints = checkpoints_of(folder)
    if not checkpoints:
        raise UserError(
            f"There is no checkpoint in {folder}.",
            "Give the folder that holds step-*.ckpt (a run's nerfstudio_models), or train from the "
            "start.",
        )
    return checkpoints


def readable_step(folder: Path, asked: int | None, tell: Callable[[str], object]) -> int:
    """The step that was asked for, if its checkpoint can be read; else that of `load_newest`."""
    if asked is not None:
        read_training_state(checkpoint_of_step(folder, asked))
        return asked
    _, path = load_newest(folder, tell)
    return dict((path, step) for step, path in list_checkpoints(path.parent))[path]


def read_training_state(path: Path) -> dict[str, Any]:
    """A checkpoint with all that training goes on from; raises UserError where there is none."""
    state = read_checkpoint(path)
    missing = _REQUIRED - state.keys()
    if missing:
        raise UserError(
            f"The checkpoint {path} lacks {', '.join(sorted(missing))}.",
            "Resume from another one of the run.",
        )
    for name in _REQUIRED | {BEFORE_END}:
        if not isinstance(state.get(name, {}), int if name == "step" else dict):
            raise UserError(
                f"The checkpoint {path} has something else as its {name}.",
                "Resume from another one of the run.",
            )
    return state


def state_before_end(state: dict[str, Any]) -> dict[str, Any]:
    """Return the pipeline's state that training goes on from: what a run's end did is undone."""
    before = state.get(BEFORE_END, {})
    return state["pipeline"] | {f"{CHECKPOINT_PREFIX}{k}": value for k, value in before.items()}


def link_latest(run: Path) -> None:
    """Let METHOD/latest lead to the newest run, for commands that take one run's config.yml."""
    link, fresh = run.with_name(LATEST), run.with_name(f".{LATEST}.{os.getpid()}")
    if run.name == LATEST or (link.exists() and not link.is_symlink()):
        return
    with suppress(OSError):  # a file system without links
        fresh.symlink_to(run.name, target_is_directory=True)
        fresh.replace(link)


def _require_space(folder: Path, needed: int, remedy: str) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise UserError(
            f"A checkpoint of {needed / 1e6:.0f} MB does not fit into the {free / 1e6:.0f} MB "
            f"free under {folder}.",
            remedy,
        )


def _tensors(state: Any) -> Iterator[torch.Tensor]:
    if isinstance(state, torch.Tensor):
        yield state
    elif isinstance(state, dict):
        for value in state.values():
            yield from _tensors(value)
    elif isinstance(state, list | tuple):
        for value in state:
            yield from _tensors(value)
