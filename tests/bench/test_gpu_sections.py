"""The sections of the GPU's check, on an emulated GPU and on what was written by hand."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.gpu import beside_gsplat, churn, lists, targets, waits
from benchmarks.gpu.kernel_times import kernel_times, shares
from benchmarks.gpu.sections import SECTIONS
from benchmarks.gpu.small_case import CASES, DONE
from benchmarks.gpu.workload import Workload
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize
from tests.bench.gpu_stand_in import rows_from
from tests.kernels.cuda import emulator

ROOT = Path(__file__).parents[2]
EMULATED = [
    *("smoke", "steps", "kernels", "waits", "rendering", "rasterizer", "training", "refinement"),
    *("stream", "gsplat", "lists", "churn"),
]
needs_a_compiler = pytest.mark.skipif(
    emulator.compiler() is None, reason="no g++ to emulate CUDA with"
)


@pytest.fixture(scope="module")
def stand_in() -> list[str]:
    """What sections and small cases print, one after another."""
    command = [sys.executable, "-m", "tests.bench.gpu_stand_in", *EMULATED, *CASES]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout.splitlines()


@pytest.fixture
def emulated(stand_in) -> dict[str, dict[str, Any]]:
    """The rows of every section that an emulated GPU can answer."""
    sections: dict[str, dict[str, Any]] = {}
    rows: dict[str, Any] = {}
    for line in stand_in:
        if line in EMULATED:
            rows = sections[line] = {}
        elif line.startswith("{"):
            message = json.loads(line)
            if "row" in message:
                rows[message["row"]] = message["figures"]
    return sections


def test_every_section_is_asked_here_or_by_its_tool():
    tool_s = {"preflight", "memcheck", "racecheck", "synccheck", "initcheck", "ncu"}
    assert {section.name for section in SECTIONS} == {*EMULATED, *tool_s}
    assert sum(section.limit_s <= 60 for section in SECTIONS) == len(SECTIONS)


@needs_a_compiler
def test_the_smoke_test_compares_with_the_reference(emulated):
    rows = emulated["smoke"]
    assert list(rows) == ["compile", "picture", "step", "replay", "crowded_picture"]
    assert not any("failed" in figures for figures in rows.values()), rows
    assert rows["picture"]["largest_difference"] < 1e-4
    for name in ("picture", "step"):
        assert max(rows[name]["gradients"].values()) < 1e-4
        assert len(rows[name]["gradients"]) >= 5
    assert rows["replay"]["losses"][-1] < rows["replay"]["losses"][0]


@needs_a_compiler
def test_times_come_with_how_far_their_targets_are(emulated):
    recorded = emulated["steps"]["recorded"]
    assert recorded["of_3000"] == pytest.approx(recorded["images_per_second"] / 3000, rel=1e-4)
    assert emulated["steps"]["fused"]["images_per_second"] > 0
    assert recorded["peak_mib"] == 5
    assert recorded["in_use_on_the_gpu_mib"] == 3 << 10
    drawn = emulated["rendering"]["recorded_by_1"]
    assert drawn["of_1500"] == pytest.approx(drawn["frames_per_second"] / 1500, rel=1e-4)
    run = emulated["training"]["whole_run"]
    assert run["step"].startswith("recorded")
    assert run["of_15_s"] == pytest.approx(15 / run["seconds_for_50000"], rel=1e-4)
    assert run["seconds_for_50000"] > run["ready_s"] > 0
    assert run["last_loss"] < run["first_loss"]
    assert "tracking is refined" in emulated["refinement"]["refinement"]["step"]
    assert "failed" not in emulated["refinement"]["refinement"]
    assert emulated["stream"]["stream"]["images_per_second"] > 0
    assert 0 < emulated["rasterizer"]["roofline"]["reached"] < 1
    assert emulated["rasterizer"]["times"]["both"]["median_ms"] > 0


@needs_a_compiler
def test_what_cannot_be_asked_on_a_processor_says_how_it_could(emulated):
    assert "pip install gsplat" in emulated["gsplat"]["library"]["remedy"]
    assert emulated["kernels"]["whole"]["median_us"] == 1000
    assert "nvidia-cuda-cupti" in emulated["kernels"]["by_name"]["remedy"]
    # An emulated step is over when it returns, as one that waits is.
    assert all("failed" in emulated["waits"][kind] for kind in ("recorded", "fused"))


@needs_a_compiler
def test_lists_and_replays_among_other_memory(emulated):
    step = emulated["lists"]["step"]
    assert 0 < step["median"] <= step["percentile_99"] <= step["most"]
    assert 0 < step["used_share"] <= 1
    for name in ("training", "pictures"):
        assert emulated["churn"][name]["bits_are_the_same"]


@needs_a_compiler
def test_the_tools_small_cases_run_to_their_last_word(stand_in):
    assert [line for line in stand_in if line == DONE] == [DONE] * len(CASES)


def test_targets_are_reached_at_one():
    assert targets.at_least(4500.0, (3000.0, 6000.0)) == {"of_3000": 1.5, "of_6000": 0.75}
    assert targets.at_most(12.0, (15.0, 10.0)) == pytest.approx({"of_15_s": 1.25, "of_10_s": 5 / 6})


def test_list_figures_of_known_lists():
    bins = {
        "tile_start": torch.tensor([0, 0, 3, 4, 10], dtype=torch.int32),
        "status": torch.tensor([10, 12, 0, 0], dtype=torch.int32),
        "capacity": 16,
    }
    figures = lists.list_figures(bins)
    assert figures["empty_share"] == 0.25
    assert figures["entries"] == 10
    assert figures["used_share"] == 12 / 16
    assert (figures["median"], figures["most"]) == (3, 6)
    assert "failed" not in figures
    overflowed = bins | {"status": torch.tensor([20, 12, 1, 1], dtype=torch.int32)}
    assert "overflowed" in lists.list_figures(overflowed)["failed"]


HERE = Workload(torch.device("cpu"), calls=1)


def test_a_graph_that_reads_freed_memory_is_found():
    """A run whose result is another when something happened between its calls."""

    def run(work: Workload, between) -> list[torch.Tensor]:
        happened: list[int] = []
        between(0)
        happened += [0] * (between is not churn._nothing)
        return [torch.tensor([1.0, float("nan") if happened else 2.0])]

    assert "changes the results" in churn.compared(run, HERE)["failed"]


def test_a_run_that_never_repeats_itself_may_differ_as_much_again():
    ends = iter([1.0, 1.1, 1.15, 1.0, 1.1, 1.5])

    def run(work: Workload, between) -> list[torch.Tensor]:
        return [torch.tensor([next(ends)])]

    assert "failed" not in churn.compared(run, HERE)
    assert "failed" in churn.compared(run, HERE)


class OnGpu(Workload):
    """Claims to be one, with a clock's worth of work to wait for."""

    on_gpu = True

    def wait(self) -> None:
        for done in self.pending:
            done()
        self.pending.clear()

    pending: list = []  # noqa: RUF012


def test_a_call_that_waits_for_the_sleep_is_told(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(waits.time, "perf_counter", lambda: now[0])
    work = OnGpu(torch.device("cpu"))

    def take(seconds: float) -> None:
        now[0] += seconds

    def sleep() -> None:
        work.pending.append(lambda: take(0.25))

    quick = waits.returned(work, lambda: take(0.001), sleep)
    assert quick["returned_ms"] == pytest.approx(1)
    assert quick["done_ms"] == pytest.approx(251)
    assert "failed" not in quick
    assert "waits for the GPU" in waits.returned(work, work.wait, sleep)["failed"]
    assert "did not sleep" in waits.returned(work, lambda: None, lambda: None)["failed"]


def event(name: str, start: float, duration: float, category: str = "kernel", **more: Any):
    return {"ph": "X", "cat": category, "name": name, "ts": start, "dur": duration, **more}


def test_kernel_times_from_a_trace_s_events():
    update = [event("update_kernel", t, d) for t, d in ((1, 2.0), (2, 4.0), (11, 3.0), (12, 5.0))]
    events = [
        *update[::-1],  # in any order
        event("train_kernel", 5, 30.0, args={"registers per thread": 64, "grid": [1024, 10, 1]}),
        event("train_kernel", 15, 34.0, args={"registers per thread": 64, "grid": [1024, 10, 1]}),
        event("void at::native::elementwise<4>(int)", 8, 1.0),
        event("Memcpy HtoD (Pinned -> Device)", 0, 2.0, "gpu_memcpy"),
        event("Memcpy HtoD (Pinned -> Device)", 10, 2.0, "gpu_memcpy"),
        event("cudaGraphLaunch", 0, 500.0, "cuda_runtime"),
        {"ph": "M", "name": "process_name"},
    ]
    found = kernel_times(events, calls=2)
    assert list(found)[:2] == ["train", "update"]
    assert found["train"] == {
        "median_us": 32.0,
        "step_us": 32.0,
        "launches": 1.0,
        "registers": 64,
        "grid": [1024, 10, 1],
    }
    assert found["update"] == {"median_us": 3.5, "step_us": 7.0, "launches": 2.0}
    assert found["void at::native::elementwise<4>(int)"]["step_us"] == 0.5
    assert "cudaGraphLaunch" not in found
    own, others = shares(found)
    assert set(own) == {"train", "update"}
    assert own["train"]["share"] == pytest.approx(32 / (32 + 7 + 0.5 + 2))
    assert sum(each["share"] for each in (*own.values(), *others.values())) == pytest.approx(1)


class FakeGsplat:
    """An old gsplat, which takes one set of Gaussians, drawn by the reference."""

    __version__ = "1.4"

    def rasterization(self, means, quats, scales, opacities, colors, viewmats, Ks, **size):
        if means.ndim > 2:
            raise AssertionError("means must be [N, 3]")
        focal, centre = Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2]
        cameras = PinholeCameras(viewmats, focal, centre, size["width"], size["height"])
        one = GaussianSet(*(t[None] for t in (means, quats, scales, opacities, colors)))
        return rasterize(one, cameras, backend="reference").image, None, {}


@needs_a_compiler
def test_gsplat_is_timed_beside_ours_as_far_as_its_version_goes(monkeypatch):
    emulator.install(monkeypatch)
    monkeypatch.setitem(sys.modules, "gsplat", FakeGsplat())
    tiny = Workload(torch.device("cpu"), seconds=0.001, gaussians=60, size_px=16, batch=2)
    monkeypatch.setattr(Workload, "here", lambda: tiny)
    rows = rows_from(beside_gsplat.gsplat)
    assert rows["library"] == {"version": "1.4"}
    assert "means must be [N, 3]" in rows["batched"]["unavailable"]
    assert rows["one_by_one"]["mean_difference"] < 1e-5
    own = sum(rows[name]["both"]["median_ms"] for name in ("ours_before", "ours_after")) / 2
    ratio = rows["one_by_one"]["both"]["median_ms"] / own
    assert list(rows["over_ours"]) == ["one_by_one"]
    assert rows["over_ours"]["one_by_one"]["both"] == pytest.approx(ratio, rel=1e-3)
