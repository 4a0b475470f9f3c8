"""A run's config.yml, as nerfstudio's commands load it.

`ns-train METHOD --load-config RUN/config.yml` goes on with the run, or repeats it.
"""

import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import yaml
from nerfstudio.engine.trainer import TrainerConfig

from rgbavatar_ns.avatar.storage.checkpoint_file import (
    MODELS_FOLDER,
    SUMMARY_NAME,
    list_checkpoints,
)
from rgbavatar_ns.errors import UserError, first_few
from rgbavatar_ns.reading import DamagedFileError, damage_told, load_json, read_file

COMPLETED = "completed"
_MOST_BYTES = 1 << 22
_EVALUATION = "nerfstudio.utils.eval_utils"
_TRAINER = re.compile(r"tag:yaml\.org,2002:python/object:[\w.]+TrainerConfig")
"""What the root of a saved config names."""
_LOAD_CONFIG = re.compile(r"--load[-_]config(=|$)")


def loads_config(command_line: Sequence[str]) -> bool:
    """Whether a run's config is named, which then takes the place of all of the command's own."""
    return any(map(_LOAD_CONFIG.match, command_line))


def _named(command_line: Sequence[str]) -> Path:
    """The file that --load-config names."""
    words = iter(command_line)
    for word in words:
        if _LOAD_CONFIG.match(word):
            return Path(word.partition("=")[2] or next(words, ""))
    return Path()


def require_loadable(path: Path, command_line: Sequence[str]) -> None:
    """Raise UserError for options beside --load-config, and for a file that holds no config.

    The file is parsed and nothing of it made: what it names is executed by nerfstudio alone.
    """
    others = [
        word.partition("=")[0]
        for word in command_line
        if word.startswith("--") and not _LOAD_CONFIG.match(word)
    ]
    if others and loads_config(command_line):
        raise UserError(
            f"--load-config takes every option from its file, so {first_few(others)} would not "
            "count.",
            "Leave out one or the other; or change the option in a copy of the file.",
        )
    try:
        with damage_told():
            root = yaml.compose(read_file(path, _MOST_BYTES), yaml.SafeLoader)
    except DamagedFileError:
        root = None
    if root is None or not _TRAINER.fullmatch(root.tag):
        raise UserError(f"{path} holds no config of a run.", "Name the config.yml of a run.")


def go_on_or_repeat(
    config: TrainerConfig, command_line: Sequence[str], tell: Callable[[str], object]
) -> None:
    """Let a config that was loaded go on with its run, if that has stopped before its end.

    A complete run is repeated under a time of its own: it stays what it is. Raises UserError where
    the run lies elsewhere than its config says: it would begin from the start.
    """
    run, checkpoints = config.get_base_dir(), TrainerConfig.get_checkpoint_dir(config)
    beside = _named(command_line).resolve().parent
    if beside != run.resolve() and list_checkpoints(beside / MODELS_FOLDER):
        raise UserError(
            f"The run lies in {beside}, but its config says {run}.",
            "Start where it was trained from; or move config.yml out of the run to repeat it.",
        )
    if config.load_dir == checkpoints:
        config.load_dir = None
    if not list_checkpoints(checkpoints):
        return
    if _complete(run):
        config.timestamp = "{timestamp}"
        TrainerConfig.set_timestamp(config)
        tell(f"{run} is complete and stays; repeating it in {config.get_base_dir()}.")
    else:
        config.load_dir, config.load_checkpoint = checkpoints, None
        tell(f"Going on with {run}.")


def loaded_by_command() -> Path | None:
    """The config.yml that ns-eval, ns-viewer or ns-render has read; None where none of them asks.

    They pass the file's place on to nobody, and a run may lie elsewhere than its config says.
    """
    frame = sys._getframe()  # pyright: ignore[reportPrivateUsage]
    while frame is not None:
        named = frame.f_locals.get("config_path")
        if frame.f_globals.get("__name__") == _EVALUATION and isinstance(named, Path):
            return named
        frame = frame.f_back
    return None


def run_beside(path: Path, said: Path, tell: Callable[[str], object]) -> Path:
    """The folder of the run that this config.yml lies in, or a link leads to.

    said: the run's folder by the config itself, which counts, and is told, where no checkpoints lie
    beside the file. Raises UserError where there are none either.
    """
    for folder in (path.parent, path.resolve().parent):
        if list_checkpoints(folder / MODELS_FOLDER):
            return folder
    if not list_checkpoints(said / MODELS_FOLDER):
        raise UserError(
            f"There is no checkpoint in {path.parent / MODELS_FOLDER}.",
            "Name the config.yml in the run's own folder; or train, and save before you stop.",
        )
    tell(f"note: no checkpoint lies beside {path}; its run is taken from {said}.")
    return said


def _complete(run: Path) -> bool:
    try:
        summary = load_json(run / SUMMARY_NAME)
    except DamagedFileError:
        return False
    return isinstance(summary, dict) and summary.get("ended") == COMPLETED
