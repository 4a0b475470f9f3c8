"""How a user's mistake is told under nerfstudio's commands."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType

import torch

from rgbavatar_ns.errors import UserError, told_as_user_error
from rgbavatar_ns.kernels import DeviceError
from rgbavatar_ns.plugin.host_commands import told_of_command

_SMALLER = (
    "Take less of it: --pipeline.datamanager.device-mib 0 leaves the images in main memory, and "
    "--pipeline.datamanager.batch-size and --pipeline.model.avatar.uv-resolution may be smaller."
)
# Older versions of torch say it with a plain RuntimeError, which may be anything.
_DeviceFailure: type[Exception] = getattr(torch, "AcceleratorError", DeviceError)
Hook = Callable[[type[BaseException], BaseException, TracebackType | None], object]


def install_user_error_hook() -> None:
    """Let an uncaught `UserError` or `DeviceError` end the process with its message and code 1.

    So does what the system refuses: a full disk, a path, a right; and what nerfstudio's commands
    cannot do with this method. Every other exception goes to the hook that was there before.
    Installing twice changes nothing.
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
        error = told_of_command(error, trace) or error
        if isinstance(error, (UserError, DeviceError)):
            print(f"\nError: {error.cause}\n{error.remedy}", file=sys.stderr, flush=True)
        else:
            self.before(kind, error, trace)
