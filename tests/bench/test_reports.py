import json
from pathlib import Path

import pytest
import torch

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.bench import machine, step
from rgbavatar_ns.bench.options import RasterizerOptions, RenderOptions, StepOptions
from rgbavatar_ns.bench.rasterizer import bench_rasterizer
from rgbavatar_ns.bench.render import VIEWER_FRAME, bench_render
from rgbavatar_ns.bench.roofline import measure_speed
from rgbavatar_ns.bench.scenes import ellipsoid_scene
from rgbavatar_ns.bench.step import bench_step
from rgbavatar_ns.bench.timing import CPU, Stopwatch
from rgbavatar_ns.bench.trainer import bare_images_per_second, bench_trainer
from rgbavatar_ns.bench.workloads import avatar_workload, parameters_of
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import rasterize
from tests.avatar.training.test_recorded_step import Recorder
from tests.export.subject import avatar_of
from tests.kernels.cuda import emulator
from tests.plugin.tiny import SIZE, tiny_dataset

KEYS = {
    "forward_ms_per_image",
    "backward_ms_per_image",
    "images_per_second",
    "frames_per_second",
    "parts",
    "peers",
    "machine",
    "workload",
    "spread",
    "roofline",
    "bytes_per_image",
}
SOMEWHERE = Path("somewhere")
TINY = {"uv": 32, "bases": 3, "size": 64}


@pytest.fixture(autouse=True)
def small_probes(monkeypatch):
    """Measure the machine on small matrices: these tests ask for shapes, not for its speed."""
    speed = measure_speed(matrix_side=64, copy_mib=1, seconds=0.001)
    for name in ("rasterizer", "step", "render"):
        monkeypatch.setattr(f"rgbavatar_ns.bench.{name}.measure_speed", lambda device: speed)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("data") / "subject")


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    path = tmp_path_factory.mktemp("avatar") / "bundle"
    avatar_of(num_bases=2, uv_resolution=24).save(path)
    return path


def values(avatar):
    return torch.cat([parameter.detach().flatten() for parameter in parameters_of(avatar)])


def checked_json(report):
    figures = json.loads(json.dumps(report.to_json()))
    assert set(figures) >= KEYS
    assert figures["parts"]
    assert all(value > 0 for value in figures["parts"].values())
    assert set(figures["spread"]) == set(figures["parts"])
    assert figures["roofline"]["reached"] == pytest.approx(
        figures["roofline"]["ms_per_image"] * figures["images_per_second"] / 1e3
    )
    for fact in ("processor", "cores", "threads", "instruction_set", "python", "torch", "date"):
        assert fact in figures["machine"]
    return figures


def test_rasterizer_report():
    options = RasterizerOptions(count=300, size=64, batch=2, repetitions=2, peers=False)
    figures = checked_json(bench_rasterizer(options))
    whole_ms = figures["parts"]["forward and backward"]
    assert figures["images_per_second"] == pytest.approx(2e3 / whole_ms)
    assert figures["roofline"]["forward"]["ms_per_image"] < figures["roofline"]["ms_per_image"]
    assert figures["frames_per_second"] is None
    assert figures["peers"] == {}
    assert figures["workload"]["gaussians"] == 300


def test_rasterizer_of_an_avatar(bundle, dataset):
    options = RasterizerOptions(
        avatar=bundle, data=dataset.root, batch=3, repetitions=1, peers=False
    )
    figures = checked_json(bench_rasterizer(options))
    assert figures["workload"]["name"] == "avatar"
    assert figures["workload"]["width_px"] == SIZE


def test_a_step_has_its_parts_and_is_compared_with_the_eager_one():
    figures = checked_json(bench_step(StepOptions(**TINY, batch=2, repetitions=1)))
    eager, parts = figures["peers"]["whole step, eager"], figures["parts"]
    assert figures["images_per_second"] == pytest.approx(2e3 / parts["whole step"])
    assert figures["trainer"] is None
    assert eager["ratio"] == pytest.approx(parts["whole step, eager"] / parts["whole step"])
    assert eager["images_per_second"] == pytest.approx(2e3 / parts["whole step, eager"])
    assert {"network", "head", "prepare", "forward and loss", "backward and Adam"} < set(parts)


def test_step_of_a_trained_avatar_on_its_pictures(bundle, dataset):
    options = StepOptions(avatar=bundle, data=dataset.root, batch=2, repetitions=1)
    figures = checked_json(bench_step(options))
    assert figures["workload"]["uv_resolution"] == 24
    assert figures["workload"]["height_px"] == SIZE


def test_timing_parts_leaves_the_avatar_as_it_was():
    workload = avatar_workload(StepOptions(**TINY), 2)
    before = {name: value.clone() for name, value in workload.avatar.state_dict().items()}
    step.time_parts(workload, Stopwatch(1))
    after = workload.avatar.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())


def test_every_repetition_of_a_step_starts_from_the_same_parameters():
    workload = avatar_workload(StepOptions(**TINY), 2)
    start, before = step.StartingPoint(workload.avatar), values(workload.avatar)
    step.step_by_step(workload.avatar, workload.batch, fast=True)()
    assert not torch.equal(values(workload.avatar), before)
    start.restore()
    assert torch.equal(values(workload.avatar), before)


@pytest.mark.skipif(emulator.compiler() is None, reason="no g++ to emulate CUDA with")
def test_a_recorded_step_is_the_same_step(monkeypatch):
    workload = avatar_workload(StepOptions(uv=24, bases=2, size=48), 3)
    backend, recorded = emulator.install(monkeypatch), []
    before = values(workload.avatar)

    def record(work):
        recorded.append(work)
        return work

    take = step.recorded_step(workload.avatar, workload.batch, record)
    assert len(recorded) == 1
    assert torch.equal(values(workload.avatar), before)
    backend.emulated.launched.clear()
    loss = take()
    assert "train" in backend.emulated.launched
    monkeypatch.undo()
    fresh = avatar_workload(StepOptions(uv=24, bases=2, size=48), 3)
    expected = step.step_by_step(fresh.avatar, fresh.batch, fast=False)()
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)


def test_render_report(bundle):
    figures = checked_json(bench_render(RenderOptions(avatar=bundle, size=64, repetitions=2)))
    assert figures["frames_per_second"] == pytest.approx(1e3 / figures["parts"]["whole frame"])
    assert {"head", "network", "prepare", "draw"} < set(figures["parts"])
    # It has depth and bytes beside what a frame has.
    assert figures["parts"][VIEWER_FRAME] > 0
    eager = figures["peers"]["whole frame, eager"]
    assert eager["ratio"] == pytest.approx(
        figures["parts"]["whole frame, eager"] / figures["parts"]["whole frame"]
    )
    assert figures["backward_ms_per_image"] is None


@pytest.mark.slow
def test_the_trainer_is_compared_with_the_bare_step(dataset):
    found = bench_trainer(
        StepOptions(data=dataset.root, uv=24, bases=2, batch=4, trainer_steps=6), CPU
    )
    assert found["steps"] == 6
    assert found["share_of_bare_step"] == pytest.approx(
        found["images_per_second"] / found["bare_images_per_second"]
    )


@pytest.mark.parametrize(("device_mib", "kind", "records"), [(1, "recorded", 1), (0, "fused", 0)])
def test_bare_steps_are_of_the_trainers_kind(emulated, dataset, device_mib, kind, records):
    """On a GPU both are recorded, or both are not."""
    config = AvatarConfig(uv_resolution=8, num_bases=2, hidden_width=8)
    avatar = Avatar(HeadModel(dataset.arrays), dataset.identity, config)
    recorder = Recorder()
    speed, found = bare_images_per_second(
        avatar, dataset, 2, 5, lambda what, done, total: None, device_mib, recorder
    )
    assert (found, recorder.records) == (kind, records)
    assert speed > 0


def test_the_ellipsoid_fills_three_fifths_of_the_image():
    gaussians, cameras = ellipsoid_scene(20_000, 256, 1)
    alpha = rasterize(gaussians, cameras).alpha
    assert float((alpha > 0.1).float().mean()) == pytest.approx(0.6, abs=0.02)


@pytest.mark.parametrize(
    ("make", "cause"),
    [
        (lambda: RasterizerOptions(batch=0), "--batch is 0"),
        (lambda: RasterizerOptions(count=0), "--count is 0"),
        (lambda: RasterizerOptions(repetitions=0), "--repetitions is 0"),
        (lambda: RasterizerOptions(peer_repetitions=0), "--peer-repetitions is 0"),
        (lambda: StepOptions(trainer_steps=0), "--trainer-steps is 0"),
        (lambda: StepOptions(threads=0), "--threads is 0"),
        (lambda: StepOptions(size=-1), "--size is -1"),
        (lambda: RenderOptions(frames=0), "--frames is 0"),
        (lambda: RasterizerOptions(data=SOMEWHERE), "--data drives an avatar"),
        (lambda: RasterizerOptions(avatar=SOMEWHERE, count=5), "synthetic workload"),
        (lambda: RasterizerOptions(avatar=SOMEWHERE, shared=True), "synthetic workload"),
        (lambda: RenderOptions(avatar=SOMEWHERE, uv=64), "made for the benchmark"),
    ],
)
def test_options_that_cannot_be_measured_are_refused(make, cause):
    with pytest.raises(UserError, match=cause):
        make()


def test_an_avatar_or_dataset_that_is_not_there_is_named(tmp_path, bundle):
    with pytest.raises(UserError, match="missing"):
        bench_render(RenderOptions(avatar=tmp_path / "missing", repetitions=1))
    with pytest.raises(UserError, match="missing"):
        bench_step(StepOptions(avatar=bundle, data=tmp_path / "missing", repetitions=1))


def test_another_size_or_head_than_the_datasets_is_refused(tmp_path, bundle, dataset):
    with pytest.raises(UserError, match="not 64 x 64"):
        bench_render(RenderOptions(avatar=bundle, data=dataset.root, size=64, repetitions=1))
    other = tiny_dataset(tmp_path / "other", frames=4, test=1, fewer_expressions=2)
    with pytest.raises(UserError, match="has theta of"):
        bench_render(RenderOptions(avatar=bundle, data=other.root, repetitions=1))


@pytest.fixture(
    params=[
        lambda **options: bench_rasterizer(RasterizerOptions(count=10, size=8, **options)),
        lambda **options: bench_step(StepOptions(**TINY, **options)),
        lambda **options: bench_render(RenderOptions(**TINY, **options)),
    ]
)
def run(request):
    """Each benchmark with options of one's own."""
    return request.param


def test_without_a_compiled_backend_the_remedy_is_told(run, monkeypatch):
    monkeypatch.setattr(machine, "available_backends", lambda: ("reference",))
    with pytest.raises(UserError, match=r"'cpu' cannot be used here.*C\+\+17"):
        run()


def test_the_readable_backend_is_measured_where_it_is_asked_for(monkeypatch):
    monkeypatch.setattr(machine, "available_backends", lambda: ("reference",))
    small = RasterizerOptions(
        count=50, size=16, batch=1, repetitions=1, backend="reference", peers=False
    )
    assert bench_rasterizer(small).workload["backend"] == "reference"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_refused_with_the_reason(run):
    with pytest.raises(UserError, match=r"no GPU to measure on: .*(torch|bindings)"):
        run(device="cuda")


def test_the_gpu_is_taken_where_it_can_be_used(monkeypatch):
    monkeypatch.setattr(machine, "unavailable_backends", dict)
    assert machine.chosen_device(None).type == "cuda"
    assert machine.chosen_device("cpu").type == "cpu"
    assert machine.chosen_device(None, "cpu").type == "cpu"
    assert machine.chosen_device(None, "reference").type == "cpu"
    assert machine.chosen_device("cuda", "reference").type == "cuda"
    with pytest.raises(UserError, match="'cpu' does not draw on the device 'cuda'"):
        machine.chosen_device("cuda", "cpu")


def test_an_unknown_backend_is_refused():
    with pytest.raises(UserError, match="'tpu'"):
        bench_rasterizer(RasterizerOptions(backend="tpu"))
