"""The C++ loops under the address and undefined-behaviour sanitizers, on the kernel tests."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.kernels.conftest import instruction_sets

ROOT = Path(__file__).parents[2]
SANITIZERS = "address,undefined,float-cast-overflow"
# Without these passes the compiler takes half as long; the checks are the same.
FLAGS = "-O1 -g1 -fno-tree-pta -fira-algorithm=priority -fira-region=one"
# libstdc++ as well: the address sanitizer looks for its exceptions when the process starts.
PRELOADED = ("libasan.so", "libubsan.so", "libstdc++.so.6")
VARIANTS = ("fastest", "generic")
TESTS = (
    "kernels/test_backends_agree.py",
    "kernels/test_bad_input.py",
    "kernels/test_extremes.py",
    "kernels/test_harmonics.py",
    "kernels/test_isolation.py",
    "kernels/test_laws.py",
    "kernels/test_screen_offset.py",
    "kernels/test_similarity.py",
    "kernels/test_sizes.py",
    "kernels/test_weighted_colors.py",
    "avatar/test_pictures_to_be_seen.py",
    "avatar/test_posing.py",
    "avatar/training/test_fused_step.py",
    "avatar/refinement/test_refinement_gradient.py",
)
# A pytest plugin that puts the module built here where the package looks for its own.
PLUGIN = """
import importlib.util
import sys

NAME, PATH = "rgbavatar_ns.kernels.cpu._native", {path!r}
spec = importlib.util.spec_from_file_location(NAME, PATH)
sys.modules[NAME] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sys.modules[NAME])


def pytest_report_header():
    from rgbavatar_ns.kernels.cpu import backend

    return "rasterizer: " + backend._native.__file__
"""

# In place of the compiler: what is not of this project or never runs here is not instrumented.
LAUNCHER = """#!{python} -IS
import os
import sys

command = sys.argv[1:]
if any(word in argument for word in {plain!r} for argument in command):
    command = [argument for argument in command if "-sanitize" not in argument]
os.execvp(command[0], command)
"""


def _program(name: str) -> str:
    places = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return shutil.which(name, path=places) or pytest.skip(f"{name} is not installed")


def _preloaded() -> str:
    compiler = os.environ.get("CXX", "c++")
    if sys.platform != "linux" or not shutil.which(compiler):
        pytest.skip("needs Linux and a C++ compiler")
    paths = []
    for library in PRELOADED:
        command = [compiler, f"-print-file-name={library}"]
        path = subprocess.run(command, capture_output=True, text=True).stdout.strip()
        if not Path(path).is_absolute():
            pytest.skip(f"{compiler} has no {library}")
        paths.append(path)
    return ":".join(paths)


def _run(command: list[str], **options) -> subprocess.CompletedProcess[str]:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    return subprocess.run(command, text=True, errors="replace", **pipes, **options)


def _chosen(which: str) -> str:
    return instruction_sets()[0] if which == "fastest" else which


def _launcher(folder: Path) -> Path:
    """A compiler that instruments the project's own sources and the loops that are run."""
    loops = re.findall(r"add_instruction_set\((\w+)", (ROOT / "CMakeLists.txt").read_text())
    assert set(VARIANTS) - {"fastest"} <= set(loops)
    unused = set(loops) - {_chosen(which) for which in VARIANTS}
    plain = [f"RGBAVATAR_ISA={name}" for name in sorted(unused)]
    path = folder / "launcher"
    text = LAUNCHER.format(python=sys.executable, plain=[*plain, "nanobind-static.dir"])
    path.write_text(text)
    path.chmod(0o755)
    return path


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory) -> dict[str, str]:
    """Environment variables of a process in which the package uses a sanitized build."""
    if not instruction_sets():
        pytest.skip("the extension is not compiled")
    pytest.importorskip("nanobind")
    preloaded, cmake, ninja = _preloaded(), _program("cmake"), _program("ninja")
    build = tmp_path_factory.mktemp("sanitized")
    nanobind = _run([sys.executable, "-m", "nanobind", "--cmake_dir"]).stdout.strip()
    options = {
        "CMAKE_MAKE_PROGRAM": ninja,
        "CMAKE_BUILD_TYPE": "RelWithDebInfo",
        "CMAKE_CXX_FLAGS_RELWITHDEBINFO": FLAGS,
        "CMAKE_CXX_COMPILER_LAUNCHER": str(_launcher(build)),
        "Python_EXECUTABLE": sys.executable,
        "nanobind_DIR": nanobind,
        "RGBAVATAR_SANITIZE": SANITIZERS,
    }
    definitions = [f"-D{name}={value}" for name, value in options.items()]
    for arguments in (
        ["-G", "Ninja", "-S", str(ROOT), "-B", str(build), *definitions],
        ["--build", str(build), "--parallel", str(os.cpu_count() or 1)],
    ):
        made = _run([cmake, *arguments])
        assert made.returncode == 0, made.stdout[-4000:]
    (module,) = build.glob("_native*.so")
    (build / "sanitized_native.py").write_text(PLUGIN.format(path=str(module)))
    return {
        "PYTHONPATH": str(build),
        "LD_PRELOAD": preloaded,
        "ASAN_OPTIONS": "detect_leaks=0",
        "UBSAN_OPTIONS": "halt_on_error=1:print_stacktrace=1",
        "OMP_NUM_THREADS": "2",
    }


def _summary(output: str) -> str:
    """The sanitizer's finding and where it is, or what pytest says at last."""
    lines = output.splitlines()
    for number, line in enumerate(lines):
        if re.search(r"runtime error:|ERROR: \w+Sanitizer", line):
            return "\n".join(each[:300] for each in lines[number : number + 12])
    return output[-4000:]


@pytest.mark.nightly
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("which", VARIANTS)
def test_kernel_tests_are_clean(sanitized, which):
    chosen = _chosen(which)
    # The emulated GPU is another library, whose own build traps.
    others = {*instruction_sets(), "reference", "emulated"} - {chosen}
    command = [sys.executable, "-m", "pytest", "-x", "-v", "--capture=sys"]
    command += ["-m", "not slow and not nightly"]
    command += ["-p", "sanitized_native", "-p", "no:cacheprovider", "-o", "addopts="]
    command += ["-k", " and ".join(f"not [{name}" for name in others)]
    command += [str(ROOT / "tests" / name) for name in TESTS]
    environment = {**os.environ, **sanitized, "RGBAVATAR_INSTRUCTION_SET": chosen}
    result = _run(command, cwd=ROOT, env=environment)
    assert f"rasterizer: {sanitized['PYTHONPATH']}" in result.stdout, result.stdout[-4000:]
    if result.returncode:
        pytest.fail(_summary(result.stdout), pytrace=False)
