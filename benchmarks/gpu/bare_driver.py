"""The NVIDIA driver and its run-time compiler by themselves, without torch or bindings.

Through ctypes, so that a machine where neither torch nor cuda-bindings can be imported still tells
whether its driver starts a kernel (CUDA Driver API and NVRTC, as their manuals describe them).
"""

import ctypes
import glob
import os
import sysconfig
from collections.abc import Sequence
from typing import Any

DRIVER = "libcuda.so.1"
_COMPILER = "libnvrtc.so*"
_CAPABILITY_MAJOR, _CAPABILITY_MINOR = 75, 76  # CUdevice_attribute
_PROCESSORS = 16


class BareError(Exception):
    """What the driver or the compiler refuses, by its own name for it."""


class BareDriver:
    """A GPU through libcuda alone, or through what stands for it in a test."""

    def __init__(self, library: Any = None) -> None:
        self._library = ctypes.CDLL(DRIVER) if library is None else library
        self._call("cuInit", 0)

    def _call(self, name: str, *arguments: Any) -> None:
        error = getattr(self._library, name)(*arguments)
        if error:
            text = ctypes.c_char_p()
            self._library.cuGetErrorName(error, ctypes.byref(text))
            raise BareError(f"{name}: {(text.value or b'error').decode()} ({error})")

    def _integer(self, name: str, *arguments: Any) -> int:
        out = ctypes.c_int()
        self._call(name, ctypes.byref(out), *arguments)
        return out.value

    def facts(self) -> dict[str, Any]:
        """The CUDA version that the driver speaks, and every GPU's name and size."""
        version = self._integer("cuDriverGetVersion")
        gpus = []
        for number in range(self._integer("cuDeviceGetCount")):
            device = self._integer("cuDeviceGet", number)
            name, memory = ctypes.create_string_buffer(256), ctypes.c_size_t()
            self._call("cuDeviceGetName", name, len(name), device)
            self._call("cuDeviceTotalMem_v2", ctypes.byref(memory), device)
            gpus.append(
                {
                    "name": name.value.decode(),
                    "architecture": self.architecture(number),
                    "processors": self._integer("cuDeviceGetAttribute", _PROCESSORS, device),
                    "memory_mib": memory.value >> 20,
                }
            )
        return {"cuda": f"{version // 1000}.{version % 1000 // 10}", "gpus": gpus}

    def architecture(self, number: int = 0) -> str:
        """Such as "sm_90"."""
        device = self._integer("cuDeviceGet", number)
        major = self._integer("cuDeviceGetAttribute", _CAPABILITY_MAJOR, device)
        minor = self._integer("cuDeviceGetAttribute", _CAPABILITY_MINOR, device)
        return f"sm_{major}{minor}"

    def enter(self) -> None:
        """Make the first GPU's own context this thread's."""
        context = ctypes.c_void_p()
        self._call(
            "cuDevicePrimaryCtxRetain", ctypes.byref(context), self._integer("cuDeviceGet", 0)
        )
        self._call("cuCtxSetCurrent", context)

    def array(self, values: Sequence[int]) -> int:
        """The address on the GPU of these 32-bit numbers."""
        host, address = (ctypes.c_uint32 * len(values))(*values), ctypes.c_uint64()
        self._call("cuMemAlloc_v2", ctypes.byref(address), ctypes.c_size_t(ctypes.sizeof(host)))
        self._call("cuMemcpyHtoD_v2", address, host, ctypes.c_size_t(ctypes.sizeof(host)))
        return address.value

    def read(self, address: int, count: int) -> list[int]:
        """So many 32-bit numbers from there; waits for what was started."""
        host = (ctypes.c_uint32 * count)()
        self._call("cuCtxSynchronize")
        size = ctypes.c_size_t(ctypes.sizeof(host))
        self._call("cuMemcpyDtoH_v2", host, ctypes.c_uint64(address), size)
        return list(host)

    def start(self, image: bytes, kernel: str, threads: int, *arguments: Any) -> None:
        """Load machine code or PTX, and start a kernel of it on one block; ctypes arguments."""
        module, function = ctypes.c_void_p(), ctypes.c_void_p()
        self._call("cuModuleLoadData", ctypes.byref(module), ctypes.c_char_p(image))
        self._call("cuModuleGetFunction", ctypes.byref(function), module, kernel.encode())
        places = (ctypes.c_void_p * len(arguments))(*map(ctypes.addressof, arguments))
        self._call("cuLaunchKernel", function, 1, 1, 1, threads, 1, 1, 0, None, places, None)


def compiler_libraries() -> list[str]:
    """NVRTC where pip, a toolkit or the system puts it."""
    packages = {sysconfig.get_paths()[kind] for kind in ("purelib", "platlib")}
    folders = [f"{package}/nvidia/*/lib" for package in sorted(packages)]
    homes = [os.environ.get(name) for name in ("CUDA_HOME", "CUDA_PATH")]
    folders += [f"{home}/lib64" for home in (*homes, "/usr/local/cuda") if home]
    folders += ["/usr/lib/*-linux-gnu"]
    return [path for folder in folders for path in sorted(glob.glob(f"{folder}/{_COMPILER}"))]


def compiled(library: Any, sources: dict[str, str], main: str, architecture: str) -> bytes:
    """Machine code by NVRTC; raises BareError with its log."""
    texts = {name: text.encode() for name, text in sources.items() if name != main}
    many, program = ctypes.c_char_p * len(texts), ctypes.c_void_p()
    names = many(*(name.encode() for name in texts))
    start = sources[main].encode(), main.encode(), len(texts), many(*texts.values()), names
    _compiler_call(library, "nvrtcCreateProgram", ctypes.byref(program), *start)
    try:
        options = [f"--gpu-architecture={architecture}".encode(), b"--std=c++17"]
        given = (ctypes.c_char_p * len(options))(*options)
        if library.nvrtcCompileProgram(program, len(options), given):
            log = _output(library, program, "nvrtcGetProgramLog")
            raise BareError(f"NVRTC: {log.decode(errors='replace')[-1000:]}")
        return _output(library, program, "nvrtcGetCUBIN")
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


def _output(library: Any, program: ctypes.c_void_p, what: str) -> bytes:
    size = ctypes.c_size_t()
    _compiler_call(library, f"{what}Size", program, ctypes.byref(size))
    out = ctypes.create_string_buffer(size.value)
    _compiler_call(library, what, program, out)
    return out.raw


def _compiler_call(library: Any, name: str, *arguments: Any) -> None:
    error = getattr(library, name)(*arguments)
    if error:
        raise BareError(f"{name}: error {error}")
