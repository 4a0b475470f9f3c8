"""Checkpoints that survive being killed: written whole or not at all, read from the newest good."""

import re
import shutil
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import atomic_write

_NAME = re.compile(r"step-(\d+)\.ckpt")
_REQUIRED = frozenset({"step", "pipeline", "optimizers", "schedulers", "scalers"})
# What a zip file's directory and small values may add to the tensors' bytes.
_OVERHEAD_BYTES = 4 << 20
_STILL_S = 60.0


def list_checkpoints(folder: Path) -> list[tuple[int, Path]]:
    """Step and path of the checkpoints in `folder`, oldest first; empty if there is no folder."""
    if not folder.is_dir():
        return []
    named = ((_NAME.fullmatch(path.name), path) for path in folder.iterdir())
    return sorted((int(name.group(1)), path) for name, path in named if name)


def save_checkpoint(state: dict[str, Any], folder: Path, step: int, keep: int) -> Path:
    """Write `folder/step-XXXXXXXXX.ckpt` atomically, then remove all but the newest `keep`.

    The file grows under another name beside the folder (nerfstudio takes every file inside it
    for a checkpoint), is synced and renamed: at any moment the folder holds only whole files.

    Raises:
        UserError: there is too little space; older checkpoints are untouched.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"step-{step:09d}.ckpt"
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
    for _, old in list_checkpoints(folder)[: -max(1, keep)]:
        old.unlink()
    return path


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


def load_newest(folder: Path, tell: Callable[[str], None]) -> tuple[dict[str, Any], Path]:
    """Read the newest checkpoint in `folder` that can be read, telling which were passed over.

    `folder` may be a run's folder too.

    Raises:
        UserError: there is no readable checkpoint.
    """
    inside = folder / "nerfstudio_models"
    candidates = list_checkpoints(folder) or list_checkpoints(inside)
    if not candidates:
        raise UserError(
            f"There is no checkpoint in {folder}.",
            "Give the folder that holds step-*.ckpt (a run's nerfstudio_models), or leave out "
            "--load-dir to train from the start.",
        )
    for _, path in reversed(candidates):
        try:
            return read_checkpoint(path), path
        except UserError as error:
            tell(f"Passing over an unreadable checkpoint: {error.cause}")
    raise UserError(
        f"None of the {len(candidates)} checkpoints in {folder} can be read.",
        "Leave out --load-dir to train from the start.",
    )


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read one checkpoint on the CPU with safe loading; raises UserError if that fails."""
    if not path.is_file():
        raise UserError(f"There is no checkpoint {path}.", "Check --load-checkpoint/--load-step.")
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"{damaged} is damaged")
        state = torch.load(path, map_location="cpu", weights_only=True)
        missing = _REQUIRED - state.keys()
        if missing:
            raise ValueError(f"{', '.join(sorted(missing))} missing")
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"{path} cannot be read ({reason}).", "Resume from an older checkpoint."
        ) from error
    return state


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
