"""What is handed to the driver, looked at in its place."""

import contextlib
import ctypes
from types import SimpleNamespace

import pytest
import torch

from rgbavatar_ns.kernels import DeviceError
from rgbavatar_ns.kernels.cuda import morphed, source

driver = pytest.importorskip("rgbavatar_ns.kernels.cuda.driver", exc_type=ImportError)

CPU = torch.device("cpu")


class Driver:
    """Answers as the bindings do: the error first."""

    CUresult = SimpleNamespace(CUDA_SUCCESS=0, CUDA_ERROR_INVALID_VALUE=1)
    CUfunction_attribute = SimpleNamespace(
        CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES="dynamic shared bytes"
    )

    def __init__(self) -> None:
        self.error, self.launched, self.contexts, self.attributes = 0, [], [], []
        self.most_shared_bytes = 227 << 10

    def cuCtxGetCurrent(self):
        return 0, "context"

    def cuCtxSetCurrent(self, context):
        self.contexts.append(context)
        return (0,)

    def cuModuleLoadData(self, image):
        return 0, image

    def cuModuleGetFunction(self, module, name):
        return 0, name

    def cuFuncSetAttribute(self, *attribute):
        self.attributes.append(attribute)
        return (int(attribute[-1] > self.most_shared_bytes),)

    def cuLaunchKernel(self, function, *rest):
        *sizes, parameters, extra = rest
        place = ctypes.cast(parameters, ctypes.POINTER(ctypes.c_void_p))[0]
        kernel = source.kernels()[function.decode().removesuffix("_kernel")]
        seen = kernel.arguments.from_buffer_copy(
            ctypes.string_at(place, ctypes.sizeof(kernel.arguments))
        )
        self.launched.append((function, sizes, seen, extra))
        return (self.error,)

    def cuGetErrorName(self, error):
        return 0, b"CUDA_ERROR_NO_BINARY_FOR_GPU"


@pytest.fixture
def launcher(monkeypatch):
    fake = Driver()
    monkeypatch.setattr(driver, "driver", fake)
    monkeypatch.setattr(driver, "compile_kernels", lambda target: target.encode())
    cuda = driver.torch.cuda
    monkeypatch.setattr(cuda, "get_device_capability", lambda device: (9, 0))
    monkeypatch.setattr(cuda, "device", lambda device: contextlib.nullcontext())
    monkeypatch.setattr(cuda, "current_stream", lambda device: SimpleNamespace(cuda_stream=77))
    return driver.CudaLauncher(CPU), fake


def _update(batch: int) -> dict:
    columns = morphed._NO_COLUMNS | {"columns": 11}
    status = torch.zeros(6, dtype=torch.int32)
    together = {f"columns{place}": columns for place in range(5)}
    return {**together, "batch": batch, "weights": None, "status": status}


def test_a_launch_brings_its_structure_stream_and_sizes(launcher):
    made, fake = launcher
    made.launch("update", (3, 1), 64, **_update(5))
    ((function, sizes, seen, extra),) = fake.launched
    assert function == b"update_kernel"
    assert sizes == [3, 1, 1, 256, 1, 1, 64, 77]
    assert (seen.batch, seen.columns4.columns, seen.columns4.bases, extra) == (5, 11, 0, 0)
    assert seen.columns0.gradient is None
    assert seen.status
    assert fake.contexts == ["context"]
    made.launch("update", (3, 1), 50 << 10, **_update(5))
    made.launch("update", (3, 1), 50 << 10, **_update(5))
    made.launch("update", (3, 1), 20 << 10, **_update(5))
    assert fake.attributes == [(b"update_kernel", "dynamic shared bytes", 50 << 10)]
    assert fake.contexts == ["context"]


def test_weights_that_no_block_holds_are_told_with_fewer_images(launcher):
    made, fake = launcher
    with pytest.raises(DeviceError, match=r"228 KiB.*fewer images a step"):
        made.launch("update", (3, 1), 228 << 10, **_update(5))
    assert fake.launched == []
    made.launch("update", (3, 1), 227 << 10, **_update(5))
    assert len(fake.launched) == 1


def test_a_failure_names_cause_and_remedy(launcher):
    made, fake = launcher
    fake.error = 209
    with pytest.raises(DeviceError, match=r"start update.*NO_BINARY.*update the driver"):
        made.launch("update", (3, 1), 64, **_update(5))
