"""The kernels compile for every architecture, with no GPU; what goes wrong is told."""

import ctypes
import re
import sys
from pathlib import Path

import pytest
import torch

from benchmarks.gpu import bare_driver
from rgbavatar_ns.kernels import DeviceError, constants
from rgbavatar_ns.kernels.cuda import arguments, source
from tests.kernels.cuda import emulator

ARCHITECTURES = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_120")


@pytest.fixture
def compiler():
    return pytest.importorskip("rgbavatar_ns.kernels.cuda.compiler", exc_type=ImportError)


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("RGBAVATAR_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_compiles_and_nothing_spills(compiler, architecture):
    """A value that leaves the registers costs more than what is computed with it."""
    code, log = compiler.compile_sources(source.sources(), architecture)
    assert code.startswith(b"\x7fELF")
    for kernel in source.kernels():
        assert f"{kernel}_kernel".encode() in code
    spills = re.findall(r"(\d+) bytes spill stores", log)
    assert len(spills) >= len(source.kernels())
    assert set(spills) == {"0"}


@pytest.mark.parametrize("architecture", ["sm_75", "sm_90"])
def test_the_oldest_compiler_takes_the_kernels(architecture):
    """CUDA builds of torch bring NVRTC of their own version, from 12.6 on."""
    pattern = "nvidia/cuda_nvrtc/lib/libnvrtc.so.12"
    places = [path for folder in sys.path for path in Path(folder).glob(pattern)]
    if not places:
        pytest.skip("no nvidia-cuda-nvrtc-cu12")
    library = ctypes.CDLL(str(places[0]))
    version = [ctypes.c_int(), ctypes.c_int()]
    assert library.nvrtcVersion(*map(ctypes.byref, version)) == 0
    assert [number.value for number in version] == [12, 6]
    code = bare_driver.compiled(library, source.sources(), source.MAIN, architecture)
    for kernel in source.kernels():
        assert f"{kernel}_kernel".encode() in code


def test_a_newer_gpu_gets_ptx_and_an_older_one_the_reason(compiler):
    assert b".target sm_" in compiler.compile_kernels("sm_999", cache=False)
    with pytest.raises(DeviceError, match=r"sm_75 .*sm_61.*device-type cpu"):
        compiler.compile_kernels("sm_61")


def test_what_was_compiled_is_kept(compiler, own_cache, monkeypatch):
    monkeypatch.setattr(compiler, "_compile", lambda target: target.encode())
    assert compiler.compile_kernels("sm_90") == b"sm_90"
    assert compiler.compile_kernels("sm_80") == b"sm_80"
    assert len(list(own_cache.iterdir())) == 2
    monkeypatch.setattr(compiler, "_compile", lambda target: pytest.fail("compiled again"))
    assert compiler.compile_kernels("sm_90") == b"sm_90"
    monkeypatch.setattr(compiler, "source_hash", lambda: "of changed sources")
    with pytest.raises(pytest.fail.Exception, match="compiled again"):
        compiler.compile_kernels("sm_90")


def test_what_was_compiled_with_other_options_is_not_taken(compiler, own_cache, monkeypatch):
    options = compiler._options
    monkeypatch.setattr(compiler, "_compile", lambda target: b"as ever")
    compiler.compile_kernels("sm_90")
    monkeypatch.setattr(compiler, "_options", lambda target: [*options(target), "--use_fast_math"])
    monkeypatch.setattr(compiler, "_compile", lambda target: b"fast")
    assert compiler.compile_kernels("sm_90") == b"fast"


def test_a_cache_that_cannot_be_written_is_done_without(compiler, own_cache, monkeypatch):
    own_cache.write_text("a file where the folder should be")
    monkeypatch.setattr(compiler, "_compile", lambda target: b"code")
    assert compiler.compile_kernels("sm_90") == b"code"


def test_a_failure_shows_nvrtc_s_log(compiler, own_cache, monkeypatch):
    broken = source.sources() | {"project.cuh": "int broken = ;"}
    monkeypatch.setattr(compiler, "sources", lambda: broken)
    with pytest.raises(DeviceError, match=r"(?s)project\.cuh.*expected an express"):
        compiler.compile_kernels("sm_90")
    assert not own_cache.exists()


@pytest.mark.skipif(emulator.compiler() is None, reason="no g++ to emulate CUDA with")
def test_structures_are_laid_out_as_the_compiler_s():
    for name, kernel in source.kernels().items():
        wanted = getattr(emulator.library(), f"{name}_argument_bytes")()
        assert ctypes.sizeof(kernel.arguments) == wanted, name


def test_the_sources_have_what_the_specification_says():
    texts = source.sources()
    assert source.constants()["kTileSide"] % constants.BLOCK_PX == 0
    assert set(source.kernels()) >= {"project", "blend", "sort", "draw", "train", "update"}
    assert {"kernels.cu", "arguments.h", "gaussian_math.h", "tangent_math.h"} <= set(texts)


def _frame(**changes):
    values = {"batch": 1, "count": 2, "width": 3, "height": 4, "tiles_x": 1, "tiles_y": 1}
    return values | changes


def test_values_that_do_not_fit_are_refused():
    cpu = torch.device("cpu")
    filled = arguments.fill("Frame", _frame(), cpu)
    assert (filled.batch, filled.height) == (1, 4)
    with pytest.raises(TypeError, match=r"missing or unknown.*depth"):
        arguments.fill("Frame", _frame(depth=1), cpu)
    cameras = {
        "world_to_camera": torch.eye(4)[None],
        "focal_px": torch.ones(1, 2),
        "principal_point_px": torch.ones(1, 2),
        "count": 1,
    }
    assert arguments.fill("CameraArrays", cameras, cpu).count == 1
    for name, wrong in (
        ("focal_px", torch.ones(1, 2, dtype=torch.float64)),
        ("world_to_camera", torch.ones(1, 4, 4).expand(2, 4, 4)),
        ("focal_px", torch.ones(1, 2, device="meta")),
    ):
        with pytest.raises(TypeError, match=name):
            arguments.fill("CameraArrays", cameras | {name: wrong}, cpu)
