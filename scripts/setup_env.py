"""Make the project's own virtual environment, or bring it up to date: `make setup`.

Runs on the system's Python with its standard library alone. Every step can be interrupted and
repeated; a stamp inside the environment says what is done, so that a second call costs nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
STAMP = VENV / "rgbavatar-setup.json"
TORCH = "2.13.0"
PYTORCH_CPU_INDEX = "https://download.pytorch.org/whl/cpu"
FIRST_IMPORTS = (
    "nerfstudio.scripts.train, nerfstudio.scripts.eval, nerfstudio.scripts.viewer.run_viewer",
    "torchmetrics.image, matplotlib.pyplot, scipy.optimize, av, rgbavatar_ns.cli.main",
    "mediapipe",
)
SUPPORTED = ((3, 11), (3, 10), (3, 12))


def say(message: str) -> None:
    """Print one line of progress at once."""
    print(f"[setup] {message}", flush=True)


def run(*command: str | Path, quiet: bool = False) -> bool:
    """Run a command; True if it succeeded. `quiet` hides what it prints."""
    output = subprocess.DEVNULL if quiet else None
    try:
        done = subprocess.run([str(c) for c in command], stdout=output, stderr=output)
    except OSError as error:  # no such program, or a link to one that went
        if not quiet:
            say(str(error))
        return False
    return done.returncode == 0


def must(why: str, *command: str | Path) -> None:
    """Run a command that the rest depends on, or stop with what to do."""
    say(why)
    if not run(*command):
        sys.exit(
            f"[setup] failed: {why}. The lines above have the cause. Once it is mended (network, "
            "disk space, a C++ compiler), run the same command again: it goes on from here."
        )


def pip(*arguments: str, quiet: bool = False) -> bool:
    """Call the environment's pip; bytecode is compiled on first import, which saves time here."""
    extra = ("--no-compile",) if arguments[0] == "install" else ()
    return run(PYTHON, "-m", "pip", "-q", *arguments[:1], *extra, *arguments[1:], quiet=quiet)


def uv_install(why: str, *arguments: str | Path) -> None:
    """Install with uv, held to the tested versions."""
    must(
        why,
        PYTHON, "-m", "uv", "pip", "install", "-q", "--python", PYTHON,
        "--constraint", ROOT / "requirements" / "constraints.txt",
        "--override", ROOT / "requirements" / "overrides.txt",
        *arguments,
    )  # fmt: skip


def suitable_python() -> str:
    """The interpreter to build the environment from: this one, else another on the PATH."""
    if sys.version_info[:2] in SUPPORTED:
        return sys.executable
    for major, minor in SUPPORTED:
        found = shutil.which(f"python{major}.{minor}")
        if found and run(found, "-c", "import venv", quiet=True):
            return found
    sys.exit(
        f"[setup] Python {platform.python_version()} is not supported. Install Python 3.10, 3.11 "
        "or 3.12 with its venv module, or name one: make setup PYTHON=/path/to/python3.11"
    )


def has_compiler() -> bool:
    """Whether there is a C++ compiler that CMake finds: the one named by CXX, or a usual one."""
    named = os.environ.get("CXX", "").split()[:1]
    return any(shutil.which(name) for name in (*named, "c++", "g++", "clang++"))


def make_venv() -> None:
    """Create the environment; one that an interruption left broken is made anew."""
    if VENV.exists() and not run(PYTHON, "-m", "pip", "--version", quiet=True):
        say("the environment is incomplete: making it anew")
        shutil.rmtree(VENV)
    if not VENV.exists():
        must("making the virtual environment .venv", suitable_python(), "-m", "venv", VENV)


def has_nvidia_gpu() -> bool:
    """Whether a driver answers: then torch's CUDA build is the right one."""
    return shutil.which("nvidia-smi") is not None and run("nvidia-smi", "-L", quiet=True)


def tell_what_stays() -> None:
    """Say where the environment is not what a new one would be; it is changed by hand alone."""
    anew = "`rm -rf .venv && make setup` makes it anew"
    made_by = re.search(r"^version = (\d+\.\d+)", _text(VENV / "pyvenv.cfg"), flags=re.M)
    asked = "{}.{}".format(*sys.version_info)
    # Make hands PYTHON on where somebody named it; its own default may be any Python.
    if made_by and made_by[1] != asked and "PYTHON" in os.environ:
        say(f"the environment stays one of Python {made_by[1]}, not of {asked}: {anew}")
    if any(VENV.glob("lib/python*/site-packages/torch-*+cpu.dist-info")) and has_nvidia_gpu():
        say(f"torch stays the CPU build though an NVIDIA driver answers: {anew}, with CUDA's")


def _text(path: Path) -> str:
    return path.read_text() if path.is_file() else ""


def installed_torch() -> str:
    """The installed torch's version with its build (`2.13.0+cpu`), or ''."""
    code = "import torch; print(torch.__version__)"
    result = subprocess.run([PYTHON, "-c", code], capture_output=True, text=True)
    return result.stdout.strip() if result.returncode == 0 else ""


def install_torch() -> None:
    """Install torch's CPU build, unless there is an NVIDIA GPU (or no CPU build to be had)."""
    if installed_torch().split("+")[0] == TORCH:
        return
    if platform.system() == "Linux" and not has_nvidia_gpu():
        say(f"installing torch {TORCH} (CPU build: no NVIDIA GPU found)")
        cpu = f"torch=={TORCH}+cpu"
        hurry = ("--timeout", "15", "--retries", "1")
        if pip("install", cpu, quiet=True):
            return
        if pip("install", *hurry, "--extra-index-url", PYTORCH_CPU_INDEX, cpu, quiet=True):
            return
        say("no CPU build of torch is within reach: installing the default one (large)")
    must(
        f"installing torch {TORCH}",
        PYTHON, "-m", "pip", "-q", "install", "--no-compile", f"torch=={TORCH}",
    )  # fmt: skip
    sees_gpu = "import sys, torch; sys.exit(not torch.cuda.is_available())"
    if has_nvidia_gpu() and not run(PYTHON, "-c", sees_gpu, quiet=True):
        say(
            "torch sees no GPU, though a driver answers: is it older than torch's CUDA? docs/gpu.md"
        )


def torchvision_works() -> bool:
    """Whether torchvision imports beside this torch; a mismatched build dies on import."""
    return run(PYTHON, "-c", "import torchvision, torchvision.transforms", quiet=True)


def install_torchvision() -> None:
    """Install a torchvision that imports beside the installed torch.

    The registry's newest build is for CUDA and dies beside a CPU build of torch; the last
    builds without that check (0.16.2, and 0.17.2 for Python 3.12) import beside any torch and
    have all that nerfstudio uses.
    """
    if torchvision_works():
        return
    say("installing torchvision")
    attempts: list[tuple[str, ...]] = []
    if installed_torch().endswith("+cpu"):
        index = ("--timeout", "15", "--retries", "1", "--index-url", PYTORCH_CPU_INDEX)
        minor = int(
            subprocess.check_output([PYTHON, "-c", "import sys; print(sys.version_info[1])"])
        )
        attempts.append(("torchvision==0.16.2" if minor < 12 else "torchvision==0.17.2",))
        attempts.append((*index, "torchvision==0.28.0+cpu"))
    attempts.append(("torchvision==0.28.0",))
    for attempt in attempts:
        if pip("install", "--no-deps", *attempt, quiet=True) and torchvision_works():
            return
    sys.exit(
        f"[setup] no torchvision imports beside torch {installed_torch()}. Install the matching "
        "build by hand (https://pytorch.org/get-started), then run the same command again."
    )


def link_ffmpeg() -> None:
    """Put imageio-ffmpeg's binary on the environment's PATH where the system has no ffmpeg."""
    link = VENV / "bin" / "ffmpeg"
    if link.exists() or shutil.which("ffmpeg"):
        return
    code = "import imageio_ffmpeg; print(imageio_ffmpeg.get_ffmpeg_exe())"
    found = subprocess.run([PYTHON, "-c", code], capture_output=True, text=True)
    if found.returncode == 0:
        link.unlink(missing_ok=True)
        link.symlink_to(found.stdout.strip())


def digest(*patterns: str) -> str:
    """A hash of the files that a step depends on; bytecode, which every run writes, is none."""
    total = hashlib.sha256()
    for pattern in patterns:
        for path in sorted(ROOT.glob(pattern)):
            if path.is_file() and path.suffix != ".pyc":
                total.update(path.read_bytes())
    return total.hexdigest()[:16]


def module_names() -> str:
    """A hash of the package's folders: the installed import hook lists them once."""
    folders = {str(path.parent.relative_to(ROOT)) for path in ROOT.glob("rgbavatar_ns/**/*.py")}
    return hashlib.sha256("\n".join(sorted(folders)).encode()).hexdigest()[:16]


def read_stamp() -> dict[str, str]:
    """What earlier calls finished."""
    try:
        return json.loads(STAMP.read_text())
    except (OSError, ValueError):
        return {}


def install_project() -> None:
    """Build the CPU rasterizer and install the project so that its sources stay live."""
    uv_install(
        "building rgbavatar_ns (C++ rasterizer included)",
        "--no-deps", "--no-build-isolation", "--reinstall-package", "rgbavatar-ns", "-e", ROOT,
    )  # fmt: skip


def first_imports() -> None:
    """Import once what the commands import, so that its bytecode is there for all of them.

    Also where Python is told to write none: each `ns-train` would compile torch anew, for 10 s.
    """
    say("importing once")
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": ""}
    for modules in FIRST_IMPORTS:
        command = [str(PYTHON), "-c", f"import {modules}"]
        subprocess.run(command, env=environment, capture_output=True, check=False)


def main() -> None:
    """Do what the stamp says is not done yet."""
    os.chdir(ROOT)
    started = time.monotonic()
    wanted = {
        "packages": digest("pyproject.toml", "requirements/*.txt", "scripts/setup_env.py"),
        "project": digest("pyproject.toml", "CMakeLists.txt", "rgbavatar_ns/kernels/**/*.[ch]*")
        + module_names(),
    }
    if VENV.exists():
        tell_what_stays()
    if PYTHON.exists() and read_stamp() == wanted:
        return
    if not has_compiler():
        sys.exit(
            "[setup] no C++ compiler found. Install one (Debian: apt-get install g++), or name "
            "one: make setup CXX=/path/to/clang++"
        )
    make_venv()
    if read_stamp().get("packages") != wanted["packages"]:  # a new environment has no stamp
        if not run(PYTHON, "-m", "uv", "--version", quiet=True):
            must("installing uv", PYTHON, "-m", "pip", "-q", "install", "uv==0.13.8")
        install_torch()
        uv_install(
            "installing nerfstudio and the other packages",
            "-r", "pyproject.toml", "--extra", "dev", "--extra", "track", "--extra", "docs",
        )  # fmt: skip
        install_torchvision()
        link_ffmpeg()
        STAMP.write_text(json.dumps({"packages": wanted["packages"]}))
    install_project()
    first_imports()
    STAMP.write_text(json.dumps(wanted))
    say(f"ready in {time.monotonic() - started:.0f} s")


if __name__ == "__main__":
    main()
