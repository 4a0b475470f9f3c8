"""Launching on a GPU through its driver."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from cuda.bindings import driver  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor

from rgbavatar_ns.kernels.cuda.arguments import fill
from rgbavatar_ns.kernels.cuda.compiler import compile_kernels
from rgbavatar_ns.kernels.cuda.source import kernels
from rgbavatar_ns.kernels.types import DeviceError


class CudaLauncher:
    """One GPU, on torch's current stream."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        capability = torch.cuda.get_device_capability(device)
        image = compile_kernels(f"sm_{capability[0]}{capability[1]}")
        with torch.cuda.device(device):
            torch.cuda.current_stream()  # torch makes the context that the module is loaded into
            torch.empty(1, device=device)
            module = _checked(driver.cuModuleLoadData(image), "load the kernels")
            self._functions = {
                name: _checked(
                    driver.cuModuleGetFunction(module, f"{name}_kernel".encode()), f"find {name}"
                )
                for name in kernels()
            }
        self._large: set[str] = set()

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
        function = self._functions[kernel]
        if shared_bytes > 48 << 10 and kernel not in self._large:
            attribute = driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
            most = torch.cuda.get_device_properties(self._device).shared_memory_per_block_optin
            _checked(driver.cuFuncSetAttribute(function, attribute, most), "enlarge shared memory")
            self._large.add(kernel)
        stream = torch.cuda.current_stream(self._device).cuda_stream
        with torch.cuda.device(self._device):
            _checked(
                driver.cuLaunchKernel(
                    function,
                    grid[0],
                    grid[1],
                    1,
                    known.threads,
                    1,
                    1,
                    shared_bytes,
                    stream,
                    ((arguments,), (None,)),
                    0,
                ),
                f"start {kernel}",
            )

    def read_later(self, numbers: Tensor) -> Callable[[], list[int] | None]:
        """See `Launcher`."""
        copy = torch.empty(numbers.shape, dtype=numbers.dtype, pin_memory=True)
        copy.copy_(numbers, non_blocking=True)
        event = torch.cuda.Event()
        event.record(torch.cuda.current_stream(self._device))
        return lambda: copy.tolist() if event.query() else None

    def capturing(self) -> bool:
        """See `Launcher`."""
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
