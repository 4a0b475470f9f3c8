"""The three training schemes, the device that is measured, and how busy it is."""

import json
import time
from typing import get_args

import pytest
import torch

from rgbavatar_ns.avatar.training.loop import TrainingOptions
from rgbavatar_ns.bench import machine, utilisation
from rgbavatar_ns.bench.options import RasterizerOptions, RenderOptions, Scheme, StepOptions
from rgbavatar_ns.bench.rasterizer import bench_rasterizer
from rgbavatar_ns.bench.render import bench_render
from rgbavatar_ns.bench.report import print_report
from rgbavatar_ns.bench.roofline import measure_speed
from rgbavatar_ns.bench.schemes import (
    WHOLE_STEP,
    RecordedScheme,
    WholeStep,
    parameters_of,
    steps_of,
)
from rgbavatar_ns.bench.step import bench_step
from rgbavatar_ns.bench.timing import CPU, Stopwatch, waiting_for
from rgbavatar_ns.bench.utilisation import gpu_utilisation, mean_while_busy
from rgbavatar_ns.bench.workloads import avatar_workload
from rgbavatar_ns.errors import UserError
from tests.kernels.cuda import emulator

TINY = {"uv": 24, "bases": 2, "size": 48}
EAGER = TrainingOptions(color_init=None, fast=False)

needs_no_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")


@pytest.fixture(autouse=True)
def small_probes(monkeypatch):
    speed = measure_speed(matrix_side=64, copy_mib=1, repetitions=1)
    monkeypatch.setattr("rgbavatar_ns.bench.step.measure_speed", lambda device: speed)


@pytest.fixture
def workload():
    return avatar_workload(StepOptions(**TINY), 3)


@pytest.mark.parametrize("scheme", get_args(Scheme))
def test_every_scheme_is_measured(scheme):
    options = StepOptions(**TINY, batch=2, repetitions=1, scheme=scheme, device="cpu")
    figures = json.loads(json.dumps(bench_step(options).to_json()))
    assert figures["workload"]["scheme"] == scheme
    assert figures["workload"]["device"] == "cpu"
    assert figures["images_per_second"] == pytest.approx(2e3 / figures["parts"][WHOLE_STEP])
    assert figures["gpu_utilisation_percent"] is None
    assert (figures["forward_ms_per_image"] is None) == (scheme != "batch-parallel")
    assert len(figures["peers"]) == 1


def test_images_drawn_one_by_one_give_the_gradients_of_the_batch(workload):
    found = []
    for scheme in ("batch-parallel", "naive-batch"):
        step = WholeStep(workload.avatar, workload.batch, EAGER, scheme)
        loss = step.run()
        step.restore()
        gradients = [parameter.grad for parameter in parameters_of(workload.avatar)]
        assert all(gradient is not None for gradient in gradients)
        found.append((loss, torch.cat([torch.as_tensor(g).flatten() for g in gradients])))
    (loss, gradient), (naive_loss, naive_gradient) = found
    assert float(naive_loss) == pytest.approx(float(loss), rel=1e-5)
    assert (naive_gradient - gradient).norm() < 1e-5 * gradient.norm()


def test_one_image_a_step_takes_as_many_steps_as_images(workload):
    step = WholeStep(workload.avatar, workload.batch, EAGER, "single")
    step.run()
    counts = {int(state["step"]) for state in step.optimizer.state.values()}
    assert counts == {3}


@pytest.mark.skipif(emulator.compiler() is None, reason="no g++ to emulate CUDA with")
def test_a_recorded_step_is_the_same_step(workload, monkeypatch):
    backend = emulator.install(monkeypatch)
    recordings = []

    def record(work):
        recordings.append(work)
        return work

    before = [parameter.detach().clone() for parameter in parameters_of(workload.avatar)]
    recorded = RecordedScheme(workload.avatar, workload.batch, record)
    assert len(recordings) == 1
    assert all(torch.equal(a, b) for a, b in zip(before, parameters_of(workload.avatar)))
    backend.emulated.launched.clear()
    loss = recorded.run()
    assert "train" in backend.emulated.launched
    recorded.restore()
    expected = WholeStep(workload.avatar, workload.batch, EAGER).run()
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("scheme", get_args(Scheme))
def test_a_scheme_starts_from_the_same_parameters_again(scheme, workload):
    before = [parameter.detach().clone() for parameter in parameters_of(workload.avatar)]
    for make in steps_of(scheme, workload.avatar, workload.batch).values():
        step = make()
        step.run()
        assert any(not torch.equal(a, b) for a, b in zip(before, parameters_of(workload.avatar)))
        step.restore()
        assert all(torch.equal(a, b) for a, b in zip(before, parameters_of(workload.avatar)))


@needs_no_gpu
@pytest.mark.parametrize(
    "run",
    [
        lambda: bench_step(StepOptions(**TINY, device="cuda")),
        lambda: bench_render(RenderOptions(**TINY, device="cuda")),
        lambda: bench_rasterizer(RasterizerOptions(count=10, size=8, device="cuda")),
    ],
)
def test_a_gpu_that_is_not_there_is_refused_with_the_reason(run):
    with pytest.raises(UserError, match=r"no GPU to measure on: .*(torch|bindings)"):
        run()


def test_the_gpu_is_taken_where_it_can_be_used(monkeypatch):
    monkeypatch.setattr(machine.cuda_backend, "load", lambda: None)
    assert machine.chosen_device(None).type == "cuda"
    assert machine.chosen_device("cpu").type == "cpu"
    assert machine.chosen_device(None, "cpu").type == "cpu"
    assert machine.chosen_device(None, "reference").type == "cpu"
    assert machine.chosen_device("cuda", "reference").type == "cuda"
    with pytest.raises(UserError, match="'cpu' does not draw on the device 'cuda'"):
        machine.chosen_device("cuda", "cpu")


def test_what_a_device_still_has_to_do_belongs_to_the_part_that_asked_for_it():
    asked = []

    def wait():
        time.sleep(0.02 * len(asked))
        asked.clear()

    def call(lap):
        asked.append("work")
        lap("first")
        lap("second")

    laps = Stopwatch(1, warm_up=False, wait=wait).laps("two", call)
    assert laps["first"].median_ms >= 20
    assert laps["second"].median_ms < 10
    assert waiting_for(CPU)() is None


def test_utilisation_is_the_mean_of_what_is_read_meanwhile():
    calls, waited = [], []

    def call():
        time.sleep(0.005)
        calls.append(0)

    percents = iter([40, *[60] * 1000])
    mean = mean_while_busy(call, lambda: next(percents), lambda: waited.append(0), 0.4, 0.1)
    assert 50 < mean < 60
    assert len(calls) > 20
    assert waited


def test_without_nvml_the_reason_is_told(monkeypatch, capsys):
    def refuse(device):
        raise ModuleNotFoundError("no pynvml here")

    monkeypatch.setattr(utilisation.torch.cuda, "utilization", refuse)
    found = gpu_utilisation(lambda: None, torch.device("cuda"))
    assert found.percent is None
    assert found.note == "ModuleNotFoundError: no pynvml here"
    monkeypatch.setattr("rgbavatar_ns.bench.step.gpu_utilisation", lambda call, device: found)
    print_report(bench_step(StepOptions(**TINY, batch=1, repetitions=1, device="cpu")))
    assert "GPU utilisation: not measured (ModuleNotFoundError" in capsys.readouterr().out
