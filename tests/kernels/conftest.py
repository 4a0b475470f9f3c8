"""The compiled backend runs once for every instruction set of this processor."""

import pytest

from rgbavatar_ns.kernels import available_backends


def instruction_sets() -> tuple[str, ...]:
    """Those that this processor's compiled backend has, the fastest first."""
    if "cpu" not in available_backends():
        return ()
    from rgbavatar_ns.kernels.cpu import backend

    return backend.instruction_sets()


@pytest.fixture(params=instruction_sets())
def instruction_set(request, monkeypatch) -> str:
    """Instruction sets of the compiled backend, which is made to use them."""
    monkeypatch.setenv("RGBAVATAR_INSTRUCTION_SET", request.param)
    return request.param


@pytest.fixture(params=[*instruction_sets(), "reference32", "emulated"])
def fast_backend(request, monkeypatch) -> str:
    """Names of float32 backends; "cpu" is given once per instruction set, "cuda" emulated."""
    if request.param == "reference32":
        return "reference"
    if request.param == "emulated":
        request.getfixturevalue("emulated")
        return "cuda"
    monkeypatch.setenv("RGBAVATAR_INSTRUCTION_SET", request.param)
    return "cpu"
