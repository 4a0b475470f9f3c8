"""Launching on a GPU through its driver."""

import ctypes
import threading
from collections.abc import Callable, Sequence
from typing import Any

import torch
from cuda.bindings import driver  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from rgbavatar_ns.kernels.cuda.arguments import fill
from rgbavatar_ns.kernels.cuda.compiler import compile_kernels
from rgbavatar_ns.kernels.cuda.source import kernels
from rgbavatar_ns.kernels.types import DeviceError

_SHARED_WITHOUT_ASKING = 16 << 10
"""A block has 48 KiB without asking, of which the kernels' own arrays take up to 32."""


class CudaLauncher:
    """One GPU, on torch's current stream."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        capability = torch.cuda.get_device_capability(device)
        image = compile_kernels(f"sm_{capability[0]}{capability[1]}")
        with torch.cuda.device(device):
            torch.zeros(1, device=device)  # torch makes the context that the module is loaded into
            self._context = _checked(driver.cuCtxGetCurrent(), "tell its context")
            module = _checked(driver.cuModuleLoadData(image), "load the kernels")
            self._functions = {
                name: _checked(
                    driver.cuModuleGetFunction(module, f"{name}_kernel".encode()), f"find {name}"
                )
                for name in kernels()
            }
        self._seen = threading.local()
        self._asked: dict[str, int] = {}

    @property
    def device(self) -> torch.device:
        """The GPU."""
        return self._device

    def launch(
        self, kernel: str, grid: Sequence[int], shared_bytes: int = 0, **values: Any
    ) -> None:
        """See `Launcher`."""
        known = kernels()[kernel]
        arguments = fill(known.arguments.__name__, values, self._device)
        # One parameter: an array of one address.
        parameters = (ctypes.c_void_p * 1)(ctypes.addressof(arguments))
        function = self._functions[kernel]
        stream = torch.cuda.current_stream(self._device).cuda_stream
        with torch.cuda.device(self._device):
            self._enter_thread()
            if shared_bytes > self._asked.get(kernel, _SHARED_WITHOUT_ASKING):
                self._ask_for_shared_memory(kernel, shared_bytes)
            started = driver.cuLaunchKernel(
                function,
                *grid,
                1,
                known.threads,
                1,
                1,
                shared_bytes,
                stream,
                ctypes.addressof(parameters),
                0,
            )
        _checked(started, f"start {kernel}")

    def _enter_thread(self) -> None:
        """A thread that has called nothing of CUDA's runtime yet has no context."""
        if not getattr(self._seen, "entered", False):
            _checked(driver.cuCtxSetCurrent(self._context), "enter its context")
            self._seen.entered = True

    def _ask_for_shared_memory(self, kernel: str, shared_bytes: int) -> None:
        attribute = driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
        result = driver.cuFuncSetAttribute(self._functions[kernel], attribute, shared_bytes)
        if result[0] == driver.CUresult.CUDA_ERROR_INVALID_VALUE:
            raise DeviceError(
                f"{kernel} wants {shared_bytes / 1024:.0f} KiB for the weights of a step's images, "
                "more than this GPU holds for a block of threads.",
                "Take fewer images a step (--pipeline.datamanager.batch-size) or fewer bases.",
            )
        _checked(result, "enlarge shared memory")
        self._asked[kernel] = shared_bytes

    def read_later(self, numbers: Tensor) -> Callable[[], list[int] | None]:
        """See `Launcher`."""
        copy = torch.empty(numbers.shape, dtype=numbers.dtype, pin_memory=True)
        copy.copy_(numbers, non_blocking=True)
        event = torch.cuda.Event()
        event.record(torch.cuda.current_stream(self._device))
        return lambda: copy.tolist() if event.query() else None

    def capturing(self) -> bool:
        """See `Launcher`."""
        with torch.cuda.device(self._device):
            return torch.cuda.is_current_stream_capturing()


def _checked(result: tuple, doing: str) -> Any:
    error, *values = result
    if error == driver.CUresult.CUDA_SUCCESS:
        return values[0] if values else None
    _, name = driver.cuGetErrorName(error)
    raise DeviceError(
        f"The GPU's driver could not {doing}: {name.decode() if name else error}.",
        "If it is older than the installed cuda-bindings, update the driver or install bindings of "
        "its version (`nvidia-smi` shows it). After a kernel's failure start again from the last "
        "checkpoint. To go on without the GPU: --machine.device-type cpu.",
    )
