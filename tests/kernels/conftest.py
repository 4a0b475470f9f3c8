"""The compiled backend runs once for every instruction set of this processor."""

import pytest

from rgbavatar_ns.kernels import available_backends
from tests.kernels.cuda import emulator


def _variants() -> list[str]:
    if "cpu" not in available_backends():
        return []
    from rgbavatar_ns.kernels.cpu.backend import instruction_sets

    return list(instruction_sets())


@pytest.fixture(params=_variants())
def instruction_set(request, monkeypatch) -> str:
    """Instruction sets of the compiled backend, which is made to use them."""
    monkeypatch.setenv("RGBAVATAR_INSTRUCTION_SET", request.param)
    return request.param


@pytest.fixture(params=[*_variants(), "reference32", "emulated"])
def fast_backend(request, monkeypatch) -> str:
    """Names of float32 backends; "cpu" is given once per instruction set, "cuda" emulated."""
    if request.param == "reference32":
        return "reference"
    if request.param == "emulated":
        if emulator.compiler() is None:
            pytest.skip("no g++ to emulate CUDA with")
        emulator.install(monkeypatch)
        return "cuda"
    monkeypatch.setenv("RGBAVATAR_INSTRUCTION_SET", request.param)
    return "cpu"
