"""Which copies of the loops a processor runs, against what the system says of it."""

import platform
from pathlib import Path

import pytest

from rgbavatar_ns.kernels.cpu.backend import instruction_sets

CPUINFO = Path("/proc/cpuinfo")
FLAGS = {
    "avx512": {"avx512f", "avx512dq", "avx512vl", "avx512bw", "avx2", "fma"},
    "avx2": {"avx2", "fma"},
}


@pytest.mark.skipif(not CPUINFO.exists(), reason="only Linux lists a processor's flags here")
def test_the_sets_are_those_whose_flags_the_system_lists() -> None:
    lines = CPUINFO.read_text().splitlines()
    flags = {flag for line in lines if line.startswith("flags") for flag in line.split()}
    x86 = platform.machine() == "x86_64"
    expected = [name for name, needed in FLAGS.items() if x86 and needed <= flags]
    assert instruction_sets() == (*expected, "generic")
