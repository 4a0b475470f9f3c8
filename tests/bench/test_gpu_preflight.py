"""What the GPU's check says of a machine before it uses it; a driver is stood for."""

import ctypes
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.gpu import preflight as asked
from benchmarks.gpu.bare_driver import BareDriver, BareError, compiler_libraries
from tests.bench.gpu_stand_in import rows_from
from tests.kernels.cuda import emulator

ROOT = Path(__file__).parents[2]
WRONG_ADDRESS = 700
NO_DEVICE = 100


class StandInDriver:
    """libcuda's functions upon main memory: our kernels emulated, the carried text interpreted."""

    def __init__(self, fails: str = "", gpus: int = 1) -> None:
        self._fails, self._gpus, self._memory = fails, gpus, {}
        self._image, self._kernel = b"", b""

    def __getattr__(self, name: str):
        if name == self._fails:
            return lambda *arguments: WRONG_ADDRESS
        return lambda *arguments: 0  # what only has to succeed

    def cuGetErrorName(self, error, text) -> int:
        text._obj.value = {WRONG_ADDRESS: b"CUDA_ERROR_ILLEGAL_ADDRESS"}.get(error, b"CUDA_ERROR")
        return 0

    def cuInit(self, flags) -> int:
        return NO_DEVICE if self._fails == "cuInit" else 0

    def cuDriverGetVersion(self, out) -> int:
        out._obj.value = 13020
        return 0

    def cuDeviceGetCount(self, out) -> int:
        out._obj.value = self._gpus
        return 0

    def cuDeviceGetName(self, name, length, device) -> int:
        name.value = b"Stand-in"
        return 0

    def cuDeviceTotalMem_v2(self, out, device) -> int:
        out._obj.value = 8 << 30
        return 0

    def cuDeviceGetAttribute(self, out, attribute, device) -> int:
        out._obj.value = {75: 9, 76: 0, 16: 132}[attribute]
        return 0

    def cuMemAlloc_v2(self, out, size) -> int:
        memory = ctypes.create_string_buffer(size.value)
        out._obj.value = ctypes.addressof(memory)
        self._memory[out._obj.value] = memory
        return 0

    def cuMemcpyHtoD_v2(self, there, here, size) -> int:
        ctypes.memmove(there.value, here, size.value)
        return 0

    def cuMemcpyDtoH_v2(self, here, there, size) -> int:
        ctypes.memmove(here, there.value, size.value)
        return 0

    def cuModuleLoadData(self, module, image) -> int:
        self._image = image.value
        return 0

    def cuModuleGetFunction(self, function, module, name) -> int:
        self._kernel = name
        return 0

    def cuLaunchKernel(self, function, x, y, z, threads, ty, tz, shared, stream, places, extra):
        assert (y, z, ty, tz, shared, stream, extra) == (1, 1, 1, 1, 0, None, None)
        if self._fails == "cuLaunchKernel":
            return WRONG_ADDRESS
        if self._kernel == b"scan_kernel":
            assert self._image.startswith(b"\x7fELF")
            run = emulator.library().scan_emulated
            run(ctypes.c_void_p(places[0]), x, y, threads, 0)
        else:
            assert threads == 1
            interpret(self._image.decode(), [places[number] for number in range(3)])
        return 0


def instructions(ptx: str) -> list[str]:
    """The lines of a kernel's body, without declarations and comments."""
    bare = re.sub(r"//.*", "", ptx)
    body = bare[bare.index("{") + 1 : bare.rindex("}")]
    return [line for line in map(str.strip, body.splitlines()) if line]


def interpret(ptx: str, places: list[int]) -> None:
    """Run the few instructions of PTX that the carried kernel is made of, one thread."""
    names = re.findall(r"\.param \.(u\d\d) (\w+)", ptx)
    parameters = {
        name: (ctypes.c_uint64 if kind == "u64" else ctypes.c_uint32).from_address(place).value
        for (kind, name), place in zip(names, places)
    }
    lines = [line for line in instructions(ptx) if line[0] != "."]
    labels = {line[:-1]: number for number, line in enumerate(lines) if line.endswith(":")}
    registers: dict[str, int] = {}

    def value(text: str) -> int:
        return registers[text] if text.startswith("%") else int(text)

    at = 0
    while lines[at] != "ret;":
        line, at = lines[at].rstrip(";"), at + 1
        if line.endswith(":"):
            continue
        condition, words = True, line.replace(",", "").split()
        if words[0].startswith("@"):
            condition = bool(registers[words.pop(0)[1:]])
        what, to, *operands = words
        place = to.strip("[]") if what.startswith("st") else (operands or [""])[0].strip("[]")
        if what == "bra":
            at = labels[to] if condition else at
        elif what.startswith("ld.param"):
            registers[to] = parameters[place]
        elif what == "ld.global.u32":
            registers[to] = ctypes.c_uint32.from_address(registers[place]).value
        elif what == "st.global.u32":
            ctypes.c_uint32.from_address(registers[place]).value = value(operands[0])
        elif what == "setp.lt.s32":
            registers[to] = value(operands[0]) < value(operands[1])
        elif what in ("add.s32", "add.s64"):
            registers[to] = value(operands[0]) + value(operands[1])
        else:
            assert what in ("mov.u32", "cvta.to.global.u64"), what
            registers[to] = value(operands[0])


def test_the_driver_tells_what_it_sees():
    assert asked.driver(StandInDriver()) == {
        "cuda": "13.2",
        "gpus": [
            {"name": "Stand-in", "architecture": "sm_90", "processors": 132, "memory_mib": 8192}
        ],
    }
    with pytest.raises(asked.Missing, match=r"no GPU.*CUDA_VISIBLE_DEVICES"):
        asked.driver(StandInDriver(gpus=0))
    with pytest.raises(asked.Missing, match=r"CUDA_ERROR \(100\).*nvidia-smi.*--gpus all"):
        asked.driver(StandInDriver(fails="cuInit"))


def test_the_carried_kernel_sums_without_torch():
    told = asked.carried_kernel(StandInDriver())
    assert "failed" not in told


def test_wrong_sums_are_told(monkeypatch):
    monkeypatch.setattr(asked, "_sums_of", lambda counts: [0])
    assert "sums are wrong" in asked.carried_kernel(StandInDriver())["failed"]


def test_a_failing_start_has_the_driver_s_name_for_it():
    with pytest.raises(BareError, match=r"cuLaunchKernel: CUDA_ERROR_ILLEGAL_ADDRESS \(700\)"):
        asked.carried_kernel(StandInDriver(fails="cuLaunchKernel"))


@pytest.mark.skipif(not compiler_libraries(), reason="no NVRTC")
def test_the_carried_text_is_what_the_assembler_takes():
    """Its instructions within a kernel that NVRTC compiles to machine code."""
    from benchmarks.gpu.bare_driver import compiled

    lines = instructions((ROOT / "benchmarks" / "gpu" / "exclusive_sums.ptx").read_text())
    assert lines.pop() == "ret;"
    operands = iter("012")
    for number, line in enumerate(lines):
        if line.startswith("ld.param"):  # the compiler gives parameters in registers
            line = re.sub(r"\[\w+\]", f"${next(operands)}", line.replace("ld.param", "mov"))
        lines[number] = line.replace("%", "%%").replace("$", "%")
    inlined = "\n".join(f'"{line}\\n"' for line in lines)
    source = (
        'extern "C" __global__ void inlined(const unsigned* counts, unsigned* starts, int count) '
        '{ asm volatile("{\\n"\n' + inlined + '\n"}" :: "l"(counts), "l"(starts), "r"(count)); }'
    )
    library = ctypes.CDLL(compiler_libraries()[0])
    assert compiled(library, {"a.cu": source}, "a.cu", "sm_75").startswith(b"\x7fELF")
    with pytest.raises(BareError, match="NVRTC"):
        compiled(library, {"a.cu": source.replace("add.s32", "add.s33")}, "a.cu", "sm_75")


@pytest.mark.skipif(emulator.compiler() is None, reason="no g++ to emulate CUDA with")
@pytest.mark.skipif(not compiler_libraries(), reason="no NVRTC")
def test_our_scan_is_compiled_and_sums_without_torch():
    told = asked.compiled_kernel(StandInDriver())
    assert "failed" not in told
    assert told["code_bytes"] > 10_000


def test_without_a_compiler_it_is_told_and_others_may_go_on(monkeypatch):
    monkeypatch.setattr(asked, "compiler_libraries", list)
    with pytest.raises(asked.Missing, match=r"pip install nvidia-cuda-nvrtc") as lack:
        asked.compiled_kernel(StandInDriver())
    assert lack.value.what is None


def rows_of(monkeypatch, **changes) -> dict[str, dict]:
    for name in ("carried_kernel", "compiled_kernel", "machine"):
        monkeypatch.setattr(asked, name, lambda: {})
    for name, change in changes.items():
        monkeypatch.setattr(asked, name, change)
    return rows_from(asked.preflight)


class FakeTorch:
    """What of torch is asked."""

    __version__ = "9.9"

    def __init__(self, cuda: str | None, available: bool, capability=(9, 0)) -> None:
        self.version = type("version", (), {"cuda": cuda})
        self.cuda = type(
            "cuda",
            (),
            {
                "is_available": staticmethod(lambda: available),
                "get_device_capability": staticmethod(lambda: capability),
                "get_device_name": staticmethod(lambda: "Stand-in"),
                "get_arch_list": staticmethod(lambda: ["sm_90"]),
                "mem_get_info": staticmethod(lambda: (4 << 20, 8 << 20)),
            },
        )


@pytest.mark.parametrize(
    ("found", "missing", "remedy"),
    [
        (None, "torch", "pytorch.org"),
        (FakeTorch(None, False), "a CUDA build of torch", "pytorch.org"),
        (FakeTorch("13.0", False), "a GPU that torch can use", "update the driver"),
        (FakeTorch("13.0", True, (6, 1)), "a GPU of sm_75 or newer", "another GPU"),
        (FakeTorch("13.0", True), None, None),
    ],
)
def test_what_torch_lacks_is_named_with_its_remedy(monkeypatch, found, missing, remedy):
    with monkeypatch.context() as within:
        within.setitem(sys.modules, "torch", found)
        told = rows_of(within, driver=lambda: {}, bindings=lambda: {}, packages=lambda: {})
    if missing is None:
        assert told["verdict"] == {"missing": []}
        assert told["torch"]["free_mib"] == 4
    else:
        assert told["verdict"]["missing"] == [missing]
        assert remedy in told["torch"]["remedy"]


def test_absent_packages_and_bindings_are_named(monkeypatch):
    with monkeypatch.context() as within:
        within.setattr(asked, "_PACKAGES", ("numpy", "no-such-package"))
        within.setitem(sys.modules, "cuda.bindings.driver", None)
        within.setitem(sys.modules, "torch", FakeTorch("13.0", True))
        told = rows_of(within, driver=lambda: {})
    assert told["verdict"]["missing"] == ["no-such-package", "cuda-bindings"]
    assert "pip install no-such-package" in told["packages"]["remedy"]
    assert "pip install cuda-bindings" in told["bindings"]["remedy"]


def test_a_question_that_breaks_ends_no_other(monkeypatch):
    def broken() -> dict:
        raise RuntimeError("the driver is strange")

    with monkeypatch.context() as within:
        within.setitem(sys.modules, "torch", FakeTorch("13.0", True))
        told = rows_of(within, driver=broken, packages=lambda: {}, bindings=lambda: {})
    assert told["driver"]["failed"] == "RuntimeError: the driver is strange"
    assert told["verdict"] == {"missing": []}


def test_nvidia_smi_s_line_is_read_and_its_refusal_told(tmp_path, monkeypatch):
    program = tmp_path / "nvidia-smi"
    values = ", ".join(str(number) for number in range(len(asked._SMI_FACTS)))
    program.write_text(
        f'#!/bin/sh\ncase "$1" in --query-gpu*) echo "{values}";; *) echo "7, train, 900";; esac\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    told = asked.nvidia_smi()
    assert told["name"] == "0"
    assert told["others_on_it"] == ["7, train, 900"]
    program.write_text("#!/bin/sh\necho 'NVIDIA-SMI has failed'; exit 9\n")
    assert asked.nvidia_smi() == {"says": "NVIDIA-SMI has failed"}


def test_the_command_without_a_gpu_says_what_to_do_and_asks_nothing_else(tmp_path):
    """Where neither torch nor the bindings can be imported."""
    path = tmp_path / "gpu.json"
    for name in ("torch", "cuda"):
        (tmp_path / f"{name}.py").write_text("raise ModuleNotFoundError('it is hidden')")
    command = [sys.executable, str(ROOT / "benchmarks" / "gpu_check.py"), "--json", str(path)]
    hidden = {**os.environ, "PYTHONPATH": str(tmp_path)}
    ran = subprocess.run(command, capture_output=True, text=True, env=hidden)
    assert ran.returncode == 1, ran.stderr
    sections = json.loads(path.read_text())["sections"]
    rows = sections.pop("preflight")["rows"]
    assert {"torch", "cuda-bindings"} <= set(rows["verdict"]["missing"])
    for name in ("torch", "bindings"):
        assert "it is hidden" in rows[name]["failed"]
        assert rows[name]["remedy"]
    assert all(section["state"] == "not run" for section in sections.values())
    assert all("torch" in section["why"] for section in sections.values())


def test_the_driver_is_loaded_by_its_name(monkeypatch):
    monkeypatch.setattr("benchmarks.gpu.bare_driver.DRIVER", "libnosuchdriver.so.1")
    with pytest.raises(asked.Missing, match=r"no driver: libnosuchdriver.*--gpus all"):
        asked.driver()
    assert BareDriver(StandInDriver()).architecture() == "sm_90"
