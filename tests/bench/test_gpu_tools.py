"""What NVIDIA's tools say, from short texts, and tools that are absent, refuse or do not end."""

from pathlib import Path

import pytest

from benchmarks.gpu import sanitizer, tools
from benchmarks.gpu.counters import counters, ncu
from benchmarks.gpu.rows import LeftOut
from benchmarks.gpu.small_case import DONE
from benchmarks.gpu.tools import Ran
from tests.bench.gpu_stand_in import rows_from

MEMCHECK = f"""========= COMPUTE-SANITIZER
{DONE}
========= Invalid __global__ read of size 4 bytes
=========     at train_kernel+0x1a0
=========     by thread (3,0,0) in block (1,0,0)
=========     Address 0x7f0000001000 is out of bounds
=========
========= Invalid __global__ read of size 4 bytes
=========     at train_kernel+0x1a0
=========     by thread (4,0,0) in block (1,0,0)
=========
========= ERROR SUMMARY: 2 errors
"""
RACECHECK = f"""========= COMPUTE-SANITIZER
========= Error: Race reported between Write access at sort_kernel+0x50
=========     and Read access at sort_kernel+0x90 [8 hazards]
=========
{DONE}
========= RACECHECK SUMMARY: 1 hazard displayed (1 error, 0 warnings)
"""
OTHERS = f"""========= COMPUTE-SANITIZER
========= Uninitialized __global__ memory read of size 4 bytes
=========     at void at::native::reduce_kernel<512>(int)+0x10
=========     by thread (0,0,0) in block (0,0,0)
=========
{DONE}
========= ERROR SUMMARY: 1 error
"""
CLEAN = f"========= COMPUTE-SANITIZER\n{DONE}\n========= ERROR SUMMARY: 0 errors\n"


def test_what_the_sanitizer_finds_in_our_kernels_fails():
    found = sanitizer.judged(Ran(MEMCHECK, True, 3.0))
    assert found["errors"] == 2
    assert found["in_our_kernels"] == {
        "Invalid __global__ read of size 4 bytes at train_kernel+...": 2
    }
    assert "our kernels" in found["failed"]
    race = sanitizer.judged(Ran(RACECHECK, True, 3.0))
    assert len(race["in_our_kernels"]) == 1
    assert "failed" in race


def test_what_the_sanitizer_finds_elsewhere_is_told_only():
    found = sanitizer.judged(Ran(OTHERS, True, 3.0))
    assert len(found["in_others"]) == 1
    assert "failed" not in found
    assert sanitizer.judged(Ran(CLEAN, True, 3.0)) == {
        "seconds": 3.0,
        "errors": 0,
        "in_our_kernels": {},
        "in_others": {},
    }


@pytest.mark.parametrize(
    "ran",
    [
        Ran(CLEAN.replace(DONE, ""), True, 1.0),  # it never ran the case
        Ran(CLEAN, False, 50.0),
        Ran(f"{DONE}\n", True, 1.0),
        Ran(f"{DONE}\n========= ERROR SUMMARY: 3 errors\n", True, 1.0),
    ],
)
def test_a_sanitizer_that_has_not_seen_all_fails(ran):
    assert "failed" in sanitizer.judged(ran)


RAW = """==PROF== Connected to process 12
"ID","Kernel Name","gpu__time_duration.sum","sm__throughput.avg.pct_of_peak_sustained_elapsed"
"","","ns","%"
"0","train_kernel(TrainArguments)","1,203,400","61.5"
"1","update_kernel","100","10"
"2","update_kernel","300","20"
"""
LONG = """small case: done
"ID","Kernel Name","Metric Name","Metric Unit","Metric Value"
"0","sort_kernel","gpu__time_duration.sum","ns","2,000"
"0","sort_kernel","sm__warps_active.avg.pct_of_peak_sustained_active","%","43.25"
"""


def test_ncu_s_two_tables_are_read():
    assert counters(RAW) == {
        "train": {"launches": 1, "duration_ns": 1203400.0, "sm_percent": 61.5},
        "update": {"launches": 2, "duration_ns": 200.0, "sm_percent": 15.0},
    }
    assert counters(LONG) == {
        "sort": {"launches": 1, "duration_ns": 2000.0, "occupancy_percent": 43.25}
    }
    assert counters("==ERROR== nothing was profiled") == {}


def executable(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def test_a_section_of_a_tool_starts_it_over_its_cases(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    log = f'echo "$PYTORCH_NO_CUDA_MEMORY_CACHING $*" >> {tmp_path}/log'
    executable(tmp_path / "compute-sanitizer", f"cat <<END\n{CLEAN}END\n{log}")
    rows = rows_from(sanitizer.memcheck)
    assert list(rows) == ["fused", "recorded"]
    assert not any("failed" in figures for figures in rows.values())
    commands = (tmp_path / "log").read_text().splitlines()
    assert all("--tool memcheck" in command for command in commands)
    assert [command.split()[-1] for command in commands] == ["fused", "recorded"]
    assert [command.startswith("1 ") for command in commands] == [True, False]


def test_counters_that_the_driver_keeps_back_are_left_out_with_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    program = executable(tmp_path / "ncu", f"cat <<END\n{RAW}\nEND")
    assert rows_from(ncu)["step"]["train"]["sm_percent"] == 61.5
    executable(program, "echo '==ERROR== ERR_NVGPUCTRPERM - no permission'; exit 1")
    assert "NVreg_RestrictProfilingToAdminUsers" in rows_from(ncu)["step"]["remedy"]
    executable(program, "echo '==ERROR== Failed to find metric'; exit 1")
    assert "Failed to find metric" in rows_from(ncu)["step"]["failed"]


def test_tools_are_found_in_path_toolkits_and_packages(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path / "path"))
    monkeypatch.delenv("CUDA_PATH", raising=False)
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "home"))
    packages = {"purelib": str(tmp_path / "pure"), "platlib": str(tmp_path / "plat")}
    monkeypatch.setattr(tools.sysconfig, "get_paths", lambda: packages)
    if tools.tool("compute-sanitizer") is None:
        with pytest.raises(LeftOut, match="nvidia-cuda-sanitizer-api"):
            tools.required_tool("compute-sanitizer")
    places = [
        tmp_path / "plat" / "nvidia" / "cu13" / "bin",
        tmp_path / "home" / "bin",
        tmp_path / "path",
    ]
    for place in places:  # each is looked at before the ones of before
        made = executable(place / "compute-sanitizer", "exit 0")
        assert tools.required_tool("compute-sanitizer") == str(made)


def test_the_newest_of_several_versions_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path / "path"))
    for variable in ("CUDA_PATH", "CUDA_HOME"):
        monkeypatch.delenv(variable, raising=False)
    packages = {"purelib": str(tmp_path), "platlib": str(tmp_path)}
    monkeypatch.setattr(tools.sysconfig, "get_paths", lambda: packages)
    made = [
        executable(tmp_path / "nvidia" / f"cu{version}" / "bin" / "some-tool", "exit 0")
        for version in ("9.2", "10.1", "13", "9.10")
    ]
    assert tools.tool("some-tool") == str(made[2])


def test_a_tool_that_does_not_end_is_ended_and_what_it_said_is_kept(tmp_path):
    made = executable(tmp_path / "tool", "exec sleep 600")
    assert not tools.run_case([str(made)], "fused", {}, 0.0).ended
    said = executable(tmp_path / "says", 'echo "asked for $*"; echo "$ONE"')
    told = tools.run_case([str(said), "--tool"], "fused", {"ONE": "two"}, 60.0)
    assert told.ended
    assert told.text.splitlines()[1] == "two"
    assert "benchmarks.gpu.small_case fused" in told.text
