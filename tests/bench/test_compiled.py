"""The command that counts what the CUDA kernels were compiled to."""

import runpy
from pathlib import Path

import pytest

from rgbavatar_ns.kernels import DeviceError
from rgbavatar_ns.kernels.cuda import source

SASS = """
\t.section\t.text.small_kernel,"ax",@progbits
small_kernel:
.text.small_kernel:
        /*0000*/                   LDC R1, c[0x0][0x28] ;
.L_x_2:
        /*0010*/               @P0 BRA `(.L_x_3) ;
.L_x_1:
        /*0020*/                   LDG.E.128 R4, desc[UR4][R2.64] ;
        /*0030*/                   FFMA R4, R5, R6, R7 ;
        /*0040*/               @P1 BRA `(.L_x_1) ;
        /*0050*/                   STG.E.U8 desc[UR4][R2.64], R4 ;
        /*0060*/              @!P2 BRA `(.L_x_2) ;
.L_x_3:
        /*0070*/                   CALL.REL.NOINC `($__internal_0_$__cuda_sm20_rcp) ;
        /*0080*/                   EXIT ;
.L_x_4:
        /*0090*/                   BRA `(.L_x_4);
        /*00a0*/                   NOP;
"""


@pytest.fixture(scope="module")
def script():
    pytest.importorskip("rgbavatar_ns.kernels.cuda.compiler", exc_type=ImportError)
    return runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "speed" / "compiled.py"))


@pytest.fixture(scope="module")
def kernels(script):
    return script["compiled"](source.sources(), "sm_90")


def test_a_listing_worked_by_hand(script):
    (instructions,) = script["parse_sass"](SASS).values()
    counts = script["count"](instructions)
    assert counts["instructions"] == "10"
    assert (counts["FP32"], counts["calls"], counts["branches"]) == ("1", "1", "5")
    assert (counts["global loads"], counts["global stores"]) == ("1 x 16 B", "1 x 1 B")
    kernel = script["Kernel"](32, 0, 0, 256, instructions)
    (loop,) = kernel.innermost_loops()
    assert [i.name for i in loop] == ["LDG.E.128", "FFMA", "BRA"]


@pytest.mark.parametrize(
    ("registers", "shared", "threads", "blocks"),
    [(32, 0, 256, 8), (33, 0, 256, 6), (128, 0, 256, 2), (32, 100_000, 128, 2), (16, 0, 32, 32)],
)
def test_blocks_that_fit_an_sm(script, registers, shared, threads, blocks):
    kernel = script["Kernel"](registers, 0, shared, threads, ())
    assert script["blocks_per_sm"](kernel, "sm_90") == blocks


def test_every_kernel_of_this_checkout_is_counted(script, kernels):
    assert set(kernels) == set(source.kernels())
    for name, kernel in kernels.items():
        assert kernel.threads == source.kernels()[name].threads
        assert len(kernel.instructions) > 50
        assert script["blocks_per_sm"](kernel, "sm_90") > 0
    assert kernels["train"].innermost_loops()
    assert int(script["count"](kernels["train"].instructions)["shuffles"]) > 0


def test_a_table_shows_what_changed(script):
    row = script["beside"]({"registers": "48", "calls": "0"}, {"registers": "40", "calls": "0"})
    assert row == {"registers": "48 → 40", "calls": "0"}
    assert script["beside"](None, {"registers": "40"}) == {"registers": "- → 40"}
    assert script["markdown"]({"train": row}).splitlines() == [
        "| kernel | registers |",
        "| --- | --- |",
        "| train | 48 → 40 |",
    ]


def test_what_is_not_there_is_told_with_the_remedy(script, capsys, monkeypatch):
    with pytest.raises(DeviceError, match=r"ls-tree.*Name a commit"):
        script["sources_of"]("no-such-revision")
    main = script["main"]
    monkeypatch.setitem(main.__globals__, "compiled", lambda texts, architecture: {})
    assert main(["--loops", "nothing"]) == 1
    assert "There is no kernel nothing" in capsys.readouterr().err
    monkeypatch.setitem(main.__globals__, "metadata", _NoPackage)
    with pytest.raises(DeviceError, match=r"pip install .*nvdisasm"):
        script["disassembled"](b"")


class _NoPackage:
    """Stands for importlib.metadata where nothing is installed."""

    PackageNotFoundError = KeyError

    @staticmethod
    def files(name: str) -> None:
        return None
