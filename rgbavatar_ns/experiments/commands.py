"""nerfstudio's commands as child processes of this environment."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from rgbavatar_ns.errors import UserError

_QUIET = {
    # OpenMP's threads spin while they wait, which stalls training where other programs run too.
    "OMP_WAIT_POLICY": "PASSIVE",
    # torchvision's file decoders, which nothing here uses, may not match the build of torch.
    "PYTHONWARNINGS": "ignore::UserWarning:torchvision.io.image,ignore::FutureWarning",
}


def run_nerfstudio(*command: str | Path) -> None:
    """Run `ns-train`, `ns-eval` and the like; their output is shown as it comes.

    On Ctrl-C the command is given the time to save what it has. Raises UserError where it ends
    with another exit code than 0, KeyboardInterrupt where it was interrupted.
    """
    program = Path(sys.executable).with_name(str(command[0]))
    environment = _QUIET | os.environ
    with subprocess.Popen([program, *map(str, command[1:])], env=environment) as process:
        try:
            code = process.wait()
        except KeyboardInterrupt:
            process.wait()
            raise
    if code == 130:
        raise KeyboardInterrupt
    if code < 0:
        raise UserError(
            f"{command[0]} was {killed_by(code)}.",
            "Run the same command again: finished stages are kept. For less memory, lower "
            "--pipeline.datamanager.batch-size, --pipeline.datamanager.cache-mib or the number of "
            "Gaussians, --pipeline.model.avatar.uv-resolution.",
        )
    if code != 0:
        raise UserError(
            f"{command[0]} ended with exit code {code}; its last lines above say why.",
            "Once that is mended, run the same command again: finished stages are kept.",
        )


def killed_by(code: int) -> str:
    """What a process's negative exit code says: "killed by SIGKILL, probably out of memory"."""
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    # Nobody else sends it uncalled: the system does, to whom takes more memory than there is.
    guess = ", probably out of memory" if name == "SIGKILL" else ""
    return f"killed by {name}{guess}"
