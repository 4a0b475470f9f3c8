"""The `rgbavatar` command: finds the sub-command and imports only what that one needs."""

import contextlib
import functools
import importlib
import inspect
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

from rgbavatar_ns.errors import told_without_traceback
from rgbavatar_ns.options import check_options

COMMANDS = {
    "demo": "demo subject (or your video) to a trained avatar, its metrics, a film and a picture",
    "demo-data": "render the procedural demo subject as a dataset",
    "track": "turn a video of a head into a dataset",
    "import": "turn other systems' data (INSTA, VHAP, metrical-tracker, ...) into a dataset",
    "check": "look at data before training: what it is, what is odd, and a picture of the fit",
    "render": "films and pictures: held-out frames, another's performance, views, learned bases",
    "drive": "an avatar moved live by a camera, a phone, a film or any program",
    "export": "the avatar as a bundle, Gaussians for other programs, a texture or a web page",
    "sweep": "train and evaluate every cell of an experiment, configs/*.yaml or your own",
    "report": "tables and plots of a sweep",
    "bench": "how fast the rasterizer, a training step and rendering are on this machine",
    "info": "what is installed here and which rasterizer backends can be used",
}
_MODULES = {"import": "import_data"}
"""Of commands whose name cannot be a module's."""


def module_name(command: str) -> str:
    """The module in `rgbavatar_ns.cli` whose `run` a command is."""
    return _MODULES.get(command, command.replace("-", "_"))


def _help() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, text in COMMANDS.items())
    return (
        f"usage: rgbavatar COMMAND [options]\n\n{rows}\n\n"
        "rgbavatar COMMAND --help shows the options. Training, evaluation and the viewer are\n"
        "nerfstudio's: ns-train rgbavatar, ns-train rgbavatar-quick, ns-eval, ns-viewer, ns-render."
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one sub-command; whoever reads its output may leave (`| head`), which ends it."""
    try:
        _run(arguments)
    except BrokenPipeError:
        if _is_read("\n"):  # Some other pipe broke.
            raise
        sys.exit(_ENDED_BY_A_PIPE)
    finally:
        _is_read()


_ENDED_BY_A_PIPE = 141
"""What shells give for SIGPIPE, 128 + 13."""


def _is_read(more: str = "") -> bool:
    """Whether somebody takes what was printed, and `more`; else nothing is left to be written."""
    try:
        print(more, end="", flush=True)
    except BrokenPipeError:  # Python would complain when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True


def _run(arguments: Sequence[str] | None) -> None:
    """Run one sub-command; a mistake of the user's is told without a traceback (exit code 1).

    So is what the system refuses: a full disk, a path, a right. SIGTERM ends like Ctrl-C, so that
    nothing half-written is left behind.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    name = arguments[0] if arguments else "--help"
    if name in ("--help", "-h"):
        with contextlib.suppress(BrokenPipeError):
            print(_help())
        return
    if name not in COMMANDS:
        print(f"There is no command {name!r}.\n\n{_help()}", file=sys.stderr)
        sys.exit(2)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _terminate)
    try:
        import tyro

        with told_without_traceback(f"rgbavatar {name}"):
            module = importlib.import_module(f"rgbavatar_ns.cli.{module_name(name)}")
            tyro.cli(_checked(module.run), prog=f"rgbavatar {name}", args=arguments[1:])
    except KeyboardInterrupt:
        print(f"rgbavatar {name}: interrupted; run it again to go on.", file=sys.stderr)
        sys.exit(130)


def _terminate(number: int, _frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


def _checked(run: Callable[..., None]) -> Callable[..., None]:
    """The command, which first looks whether its options lie within their ranges."""

    @functools.wraps(run)
    def checked(*values: Any, **named: Any) -> None:
        check_options(run, inspect.signature(run).bind(*values, **named).arguments)
        run(*values, **named)

    return checked
