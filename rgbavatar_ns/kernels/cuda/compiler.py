"""CUDA C++ to machine code with NVRTC, kept on disk for the next time."""

import contextlib
import hashlib
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from cuda.bindings import nvrtc  # pyright: ignore[reportAttributeAccessIssue]

from rgbavatar_ns.kernels.cuda.code_cache import cached
from rgbavatar_ns.kernels.cuda.source import MAIN, source_hash, sources
from rgbavatar_ns.kernels.types import DeviceError

OLDEST = 75
"""The oldest architecture that the kernels are written for: Turing."""


_REINSTALL = "reinstall cuda-bindings and nvidia-cuda-nvrtc of one version."
_CPU_INSTEAD = "Or train on the CPU: --machine.device-type cpu."


def compile_kernels(architecture: str, *, cache: bool = True) -> bytes:
    """Return the machine code of all kernels for an architecture such as "sm_90".

    For a GPU newer than the compiler it is PTX of the newest architecture known, which the driver
    translates. Raises DeviceError for GPUs older than sm_75 and where NVRTC fails, with its
    log.
    """
    target = _target(architecture)
    version = "{}.{}".format(*_checked(nvrtc.nvrtcVersion(), "tell its version"))
    if not cache:
        return _compile(target)
    options = hashlib.sha256(" ".join(_options(target)).encode()).hexdigest()[:8]
    name = f"{source_hash()}-{target}-{options}-nvrtc{version}.bin"
    return cached(name, lambda: _compile(target))


def _target(architecture: str) -> str:
    """The architecture itself, or the newest one known as a virtual one."""
    match = re.fullmatch(r"sm_(\d+)", architecture)
    if match is None or int(match[1]) < OLDEST:
        raise DeviceError(
            f"The kernels need a GPU of architecture sm_{OLDEST} (Turing) or newer; this one is "
            f"{architecture}.",
            f"Use another GPU. {_CPU_INSTEAD}",
        )
    known = _checked(nvrtc.nvrtcGetSupportedArchs(), "list its architectures")
    if int(match[1]) in known:
        return architecture
    return f"compute_{max(n for n in known if n <= max(int(match[1]), OLDEST))}"


def compile_sources(texts: Mapping[str, str], architecture: str) -> tuple[bytes, str]:
    """The machine code of these sources by name, and what the assembler says of each kernel.

    It tells registers, shared memory and spills.
    """
    with _compiled(_target(architecture), "--ptxas-options=-v", texts=texts) as program:
        code = _output(program, nvrtc.nvrtcGetCUBINSize, nvrtc.nvrtcGetCUBIN)
        return code, _log(program)


def _compile(target: str) -> bytes:
    with _compiled(target) as program:
        if target.startswith("compute_"):
            return _output(program, nvrtc.nvrtcGetPTXSize, nvrtc.nvrtcGetPTX)
        return _output(program, nvrtc.nvrtcGetCUBINSize, nvrtc.nvrtcGetCUBIN)


def _options(target: str) -> list[str]:
    return [f"--gpu-architecture={target}", "--std=c++17"]


@contextlib.contextmanager
def _compiled(target: str, *more: str, texts: Mapping[str, str] | None = None) -> Iterator[Any]:
    """NVRTC's program of all kernels."""
    texts = dict(sources() if texts is None else texts)
    main = texts.pop(MAIN)
    program = _checked(
        nvrtc.nvrtcCreateProgram(
            main.encode(),
            MAIN.encode(),
            len(texts),
            [text.encode() for text in texts.values()],
            [name.encode() for name in texts],
        ),
        "take the sources",
    )
    options = [*_options(target), *more]
    try:
        (error,) = nvrtc.nvrtcCompileProgram(program, len(options), [o.encode() for o in options])
        if error != nvrtc.nvrtcResult.NVRTC_SUCCESS:
            raise DeviceError(
                f"NVRTC could not compile the kernels for {target}:\n{_log(program)}",
                f"If the sources are unchanged, {_REINSTALL} {_CPU_INSTEAD}",
            )
        yield program
    finally:
        nvrtc.nvrtcDestroyProgram(program)


def _output(program: Any, size: Callable[..., tuple], get: Callable[..., tuple]) -> bytes:
    out = bytes(_checked(size(program), "give its output's size"))
    _checked(get(program, out), "give its output")
    return out


def _log(program: Any) -> str:
    log = _output(program, nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog)
    return log.rstrip(b"\0").decode(errors="replace").strip()


def _checked(result: tuple, doing: str) -> Any:
    error, *values = result
    if error != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        raise DeviceError(
            f"NVRTC could not {doing} ({error}).", f"To mend it, {_REINSTALL} {_CPU_INSTEAD}"
        )
    return values[0] if len(values) == 1 else values
