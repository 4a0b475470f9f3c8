"""nerfstudio's commands, each in a process forked from one that has imported them and run nothing.

A command takes seconds to start, which are imports. Tests of the viewer start theirs as users do.
"""

import atexit
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
from multiprocessing.context import ForkServerContext
from pathlib import Path
from unittest.mock import patch

_IMPORTED = ["nerfstudio.scripts.train", "nerfstudio.scripts.eval"]
_PATIENCE_S = 600.0


def run_forked(
    words: list[str], environment: Mapping[str, str]
) -> "subprocess.CompletedProcess[str]":
    """Run one of the environment's commands to its end, as `subprocess.run` does."""
    with tempfile.TemporaryDirectory() as folder:
        told = [Path(folder) / name for name in ("stdout", "stderr")]
        with patch.dict(os.environ, environment):
            process = _context().Process(target=_command, args=(words, dict(environment), told))
            process.start()
        process.join(_PATIENCE_S)
        if process.exitcode is None:
            process.kill()
            raise subprocess.TimeoutExpired(words, _PATIENCE_S)
        output, errors = (path.read_text() for path in told)
    return subprocess.CompletedProcess(words, process.exitcode, output, errors)


@cache
def _context() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_IMPORTED)
    return context


def _command(words: list[str], environment: dict[str, str], told: list[Path]) -> None:
    """What the installed script of a command does, in the process that was forked for it."""
    for number, path in enumerate(told, 1):
        with path.open("wb") as file:
            os.dup2(file.fileno(), number)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:0] = filter(None, environment.get("PYTHONPATH", "").split(os.pathsep))
    sys.argv = words
    (script,) = entry_points(group="console_scripts", name=Path(words[0]).name)
    try:
        sys.exit(script.load()())
    except Exception:
        sys.excepthook(*sys.exc_info())
        sys.exit(1)
    finally:
        atexit._run_exitfuncs()
