"""nerfstudio's commands as child processes of this environment."""

import os
import shutil
import signal
import site
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rgbavatar_ns.avatar.storage.checkpoint_file import CONFIG_NAME, MODELS_FOLDER, SUMMARY_NAME
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import written_json
from rgbavatar_ns.plugin.training.interruption import PARENT_VARIABLE

_QUIET = {
    # OpenMP's threads spin while they wait, which stalls training where other programs run too.
    "OMP_WAIT_POLICY": "PASSIVE",
    # torchvision's file decoders, which nothing here uses, may not match the build of torch.
    "PYTHONWARNINGS": "ignore::UserWarning:torchvision.io.image,ignore::FutureWarning",
}


def find_program(name: str) -> Path | None:
    """Where this environment has a program such as `ns-train`; else the PATH's; None without one.

    A system's Python has its programs in another folder than itself, `pip install --user` in the
    user's, and an environment with --system-site-packages uses the system's.
    """
    places = [sysconfig.get_path("scripts")]
    if site.ENABLE_USER_SITE:
        places.append(sysconfig.get_path("scripts", sysconfig.get_preferred_scheme("user")))
    places.append(os.path.dirname(sys.executable))
    found = shutil.which(name, path=os.pathsep.join(places)) or shutil.which(name)
    return None if found is None else Path(found)


def require_program(name: str) -> Path:
    """As `find_program`; raises UserError where there is none."""
    found = find_program(name)
    if found is None:
        raise UserError(
            f"There is no {name} in the environment {sys.prefix}, nor on the PATH.",
            f"Install the project there as docs/install.md says, or put {name}'s folder on the "
            "PATH.",
        )
    return found


def run_nerfstudio(*command: str | Path) -> None:
    """Run `ns-train`, `ns-eval` and the like; their output is shown as it comes.

    On Ctrl-C and SIGTERM the command is given the time to save what it has; it ends with this
    process. Raises UserError where it is not there or ends with another exit code than 0,
    KeyboardInterrupt where it was interrupted.
    """
    program = require_program(str(command[0]))
    environment = _QUIET | os.environ | {PARENT_VARIABLE: str(os.getpid())}
    with subprocess.Popen([program, *map(str, command[1:])], env=environment) as process:
        try:
            code = process.wait()
        except KeyboardInterrupt:
            process.wait()
            raise
        except SystemExit:
            # SIGTERM reaches this process alone, where Ctrl-C reaches both.
            process.terminate()
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


def train(
    method: str, data: Path, run_folder: Path, seed: int, options: Sequence[str | Path] = ()
) -> dict[str, Any]:
    """Train by `ns-train`, going on from the newest checkpoint; return what training.json tells.

    `run_folder` is OUTPUT/EXPERIMENT/METHOD/TIMESTAMP. Raises as `run_nerfstudio`.
    """
    experiment = run_folder.parent.parent
    flags: list[str | Path] = ["--data", data, "--output-dir", experiment.parent]
    flags += ["--experiment-name", experiment.name, "--timestamp", run_folder.name]
    flags += ["--vis", "tensorboard", "--machine.seed", str(seed), *options]
    if any(run_folder.glob(f"{MODELS_FOLDER}/*.ckpt")):
        flags += ["--load-dir", run_folder / MODELS_FOLDER]
    run_nerfstudio("ns-train", method, *flags)
    return written_json(run_folder / SUMMARY_NAME)


def evaluate(run_folder: Path, destination: Path) -> dict[str, Any]:
    """Evaluate a run by `ns-eval`, which writes the JSON file; return its results."""
    run_nerfstudio(
        "ns-eval", "--load-config", run_folder / CONFIG_NAME, "--output-path", destination
    )
    return written_json(destination)["results"]


def killed_by(code: int) -> str:
    """What a process's negative exit code says: "killed by SIGKILL, probably out of memory"."""
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    # Nobody else sends it uncalled: the system does, to whom takes more memory than there is.
    guess = ", probably out of memory" if name == "SIGKILL" else ""
    return f"killed by {name}{guess}"
