"""How a user's mistake is told under nerfstudio's commands."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType

import torch

from rgbavatar_ns.errors import UserError, told_as_user_error
from rgbavatar_ns.kernels import DeviceError

_SMALLER = (
    "Take less of it: --pipeline.datamanager.device-mib 0 leaves the images in main memory, and "
    "--pipeline.datamanager.batch-size and --pipeline.model.avatar.uv-resolution may be smaller."
)
# Older versions of torch say it with a plain RuntimeError, which may be anything.
_DeviceFailure: type[Exception] = getattr(torch, "AcceleratorError", DeviceError)
_INSTEAD = {
    "nerfstudio.scripts.render": (
        "This kind of ns-render takes only methods that sample rays.",
        "`rgbavatar render RUN OUT --show turntable` turns the camera about the head, --show orbit "
        "swings it around; `ns-render interpolate`, `camera-path` and `dataset` work too.",
    ),
    "nerfstudio.scripts.exporter": (
        "This kind of ns-export takes only nerfstudio's own methods.",
        "`rgbavatar export RUN DST --format ply` writes Gaussians, of one frame or of many; gltf, "
        "spz, compressed-ply, sog, web and others: `rgbavatar export --help`. There is no mesh to "
        "export.",
    ),
}
"""By the module of nerfstudio's that refuses: what to say, and what does it."""
Hook = Callable[[type[BaseException], BaseException, TracebackType | None], object]


def install_user_error_hook() -> None:
    """Let an uncaught `UserError` or `DeviceError` end the process with its message and code 1.

    So does what the system refuses (a full disk, a path, a right), and a command of nerfstudio's
    that asserts to have one of its own methods before it. Every other exception goes to the hook
    that was there before. Installing twice changes nothing.
    """
    if isinstance(sys.excepthook, _UserErrorHook):
        return
    sys.excepthook = _UserErrorHook(sys.excepthook)


@contextlib.contextmanager
def device_errors_told(checkpoints: Path) -> Iterator[None]:
    """Turn what a GPU, its driver or its compiler cannot do into a `UserError`.

    Checkpoints are whole files and stay; nothing is written to a device that has failed.
    """
    resume = f"Checkpoints so far are in {checkpoints}: --load-dir resumes from the newest."
    try:
        yield
    except DeviceError as error:
        raise UserError(error.cause, f"{error.remedy} {resume}") from error
    except torch.cuda.OutOfMemoryError as error:
        raise UserError("The GPU's memory is full.", f"{_SMALLER} {resume}") from error
    except _DeviceFailure as error:
        first_line = str(error).splitlines()[0]
        raise UserError(f"The GPU failed: {first_line}.", f"Start again. {resume}") from error


class _UserErrorHook:
    def __init__(self, before: Hook) -> None:
        self.before = before

    def __call__(
        self, kind: type[BaseException], error: BaseException, trace: TracebackType | None
    ) -> None:
        if isinstance(error, OSError):
            error = told_as_user_error(error) or error
        elif isinstance(error, AssertionError):
            error = _told_instead(trace) or error
        if isinstance(error, (UserError, DeviceError)):
            print(f"\nError: {error.cause}\n{error.remedy}", file=sys.stderr, flush=True)
        else:
            self.before(kind, error, trace)


def _told_instead(trace: TracebackType | None) -> UserError | None:
    """Of an assertion of nerfstudio's that another kind of method is there; None of others."""
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    module = "" if trace is None else trace.tb_frame.f_globals.get("__name__", "")
    return UserError(*_INSTEAD[module]) if module in _INSTEAD else None
