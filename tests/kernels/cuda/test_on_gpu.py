"""The CUDA backend on a GPU: its own rounding, races, CUDA graphs and waits.

Questions that need no GPU are also asked of the emulation.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.avatar.training import make_optimizer
from rgbavatar_ns.avatar.training import recorded_step as recorded_steps
from rgbavatar_ns.avatar.training.batches import DeviceFrames
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.avatar.training.recorded_step import RecordedStep
from rgbavatar_ns.bench.scenes import ellipsoid_scene, leaf_gaussians, on_device
from rgbavatar_ns.kernels import rasterize
from rgbavatar_ns.kernels.registry import choose
from tests.avatar.fused_scene import (
    VARIANTS,
    assert_gradients_agree,
    double,
    eager_step,
    far_batch,
    first_moments,
    fused_step,
    in_double,
    relative_differences,
    stir,
)
from tests.avatar.prior.test_mesh_field import embedded_avatar
from tests.avatar.small_head import front_camera, random_theta
from tests.kernels.agreement import assert_agrees, expect
from tests.kernels.scenes import moved, random_scene, to
from tests.kernels.test_backends_agree import SCENES

GPU = pytest.param(
    "cuda",
    marks=[
        pytest.mark.cuda,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no NVIDIA GPU"),
    ],
)
CASES = {name: (changes, 3, 1) for name, changes in VARIANTS.items()}
CASES |= {f"{count} images": ({}, count, count) for count in (1, 10, 17)}
ROUNDING_OF_EARLY_LOSSES, ROUNDING_OF_LATE_LOSSES = 1e-3, 3e-2
"""Two ways to step round differently, which Adam amplifies step by step."""


@dataclass(frozen=True)
class Place:
    """Where the kernels run."""

    device: torch.device
    backend: Any

    @property
    def emulated(self) -> bool:
        return self.device.type == "cpu"

    def wait(self) -> None:
        if not self.emulated:
            torch.cuda.synchronize(self.device)


@pytest.fixture(params=[GPU, "emulated"])
def place(request) -> Place:
    if request.param == "emulated":
        return Place(torch.device("cpu"), request.getfixturevalue("emulated"))
    device = torch.device("cuda:0")
    return Place(device, choose("cuda", device, torch.float32))


@pytest.fixture(params=[GPU])
def gpu(request) -> torch.device:
    return torch.device("cuda:0")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", SCENES)
def test_values_and_gradients_match_the_reference(gpu, name, seed):
    assert_agrees(expect(random_scene(seed, **SCENES[name])), "cuda", device="cuda:0")


def test_moved_means_match_the_reference(gpu):
    assert_agrees(expect(moved(random_scene(0))), "cuda", device="cuda:0")


@pytest.mark.parametrize("name", CASES)
def test_a_fused_step_has_the_reference_s_gradients(place, make_avatar, name):
    changes, count, cameras = CASES[name]
    avatar = stir(make_avatar(**changes))
    expected = double(avatar)
    batch, background = far_batch(expected, count, 36, 41, cameras)
    avatar.to(place.device)
    optimizer, expected_optimizer = make_optimizer(avatar), make_optimizer(expected)
    there = on_device(batch, place.device), background.to(place.device)
    loss = fused_step(avatar, optimizer, *there)
    right = eager_step(
        expected, expected_optimizer, in_double(batch), background.double(), "reference"
    )
    assert float(torch.as_tensor(loss)) == pytest.approx(float(right), rel=1e-5)
    if place.emulated:
        assert "train" in place.backend.emulated.launched
        assert_gradients_agree(avatar, optimizer, expected, expected_optimizer)
    else:
        moments = first_moments(avatar, optimizer), first_moments(expected, expected_optimizer)
        differences = relative_differences(*moments)
        assert max(differences.values()) < 1e-3, differences


Step = Callable[[list[int], Tensor], Tensor]


def frames_on(place: Place, avatar: Avatar, count: int) -> tuple[DeviceFrames, Tensor]:
    """Frames far from what the avatar shows, and backgrounds in main memory."""
    batch, background = far_batch(avatar, count)
    batch = on_device(batch, place.device)
    return DeviceFrames(batch.theta, batch.cameras, torch.as_tensor(batch.images_rgba)), background


def step_of(place: Place, avatar, optimizer, frames: DeviceFrames, size: int, kind: str) -> Step:
    """A step on chosen frames, recorded, fused or through autograd."""
    if kind == "recorded":
        recorder = (lambda work: work) if place.emulated else recorded_steps.record_cuda_graph
        return RecordedStep(avatar, [optimizer], frames, size, recorder=recorder)

    def take(chosen: list[int], background: Tensor) -> Tensor:
        batch, there = frames.batch(chosen), background.to(place.device)
        if kind == "autograd":
            return eager_step(avatar, optimizer, batch, there, "cuda")
        fused = FusedStep(avatar, [optimizer], "cuda")
        return fused(batch.theta, batch.cameras, torch.as_tensor(batch.images_rgba), there).clone()

    return take


def test_every_kernel_sees_the_same_lists(place, make_avatar, monkeypatch):
    """A tile that one counts and another leaves out is a hole in a list or sum, here a NaN."""
    launcher = place.backend.launcher(place.device)
    launch, lists = launcher.launch, []

    def watched(kernel: str, *arguments: Any, **values: Any) -> None:
        if "slots" in values and kernel in ("train", "differentiate", "average"):
            values["slots"].fill_(torch.nan)
        launch(kernel, *arguments, **values)
        if kernel == "sort":
            bins = values["bins"]
            lists.append(len(bins["tile_count"]))
            assert not bins["tile_count"].any(), "holes in a list"
            assert out_of_order(bins["tile_start"], bins["entries"]) == 0
        if kernel in ("project_backward", "blend_backward", "collect"):
            sums = [v for n, v in values.items() if n != "slots" and isinstance(v, Tensor)]
            assert not any(bool(value.isnan().any()) for value in sums), f"a hole in {kernel}"

    monkeypatch.setattr(launcher, "launch", watched)
    avatar = stir(make_avatar()).to(place.device)
    frames, background = frames_on(place, avatar, 3)
    step = step_of(place, avatar, make_optimizer(avatar), frames, 3, "fused")
    for seed in range(1 if place.emulated else 10):
        scene = ellipsoid_scene(*((300, 48, 2) if place.emulated else (60_000, 512, 10)), seed=seed)
        gaussians, cameras = (on_device(value, place.device) for value in scene)
        drawn = rasterize(leaf_gaussians(gaussians), cameras, backend="cuda", with_visibility=True)
        drawn.image.square().sum().backward()
        step([0, 1, 2], background)
    assert lists


def out_of_order(starts: Tensor, entries: Tensor) -> int:
    """Neighbours in a list of which the first lies behind; depths are positive, so bits sort."""
    length = int(starts[-1])
    descends = entries[1:length] < entries[: length - 1]
    begins = torch.zeros(length + 1, dtype=torch.bool, device=entries.device)
    begins[starts.long().clamp(max=length)] = True
    return int((descends & ~begins[1:length]).sum())


def test_two_drawings_have_the_same_bits(place):
    scene = random_scene(3, width=70, height=50, count=100 if place.emulated else 4000)
    gaussians, cameras = (
        to(to(value, torch.float32), place.device) for value in (scene.gaussians, scene.cameras)
    )
    runs = []
    for _ in range(2):
        leaves = leaf_gaussians(gaussians)
        drawn = rasterize(leaves, cameras, backend="cuda")
        (drawn.image.square().sum() + drawn.alpha.sum()).backward()
        runs.append([drawn.image, *(torch.as_tensor(leaf.grad) for leaf in vars(leaves).values())])
    assert all(torch.equal(a, b) for a, b in zip(*runs))


@pytest.mark.parametrize("kind", ["fused", "recorded"])
def test_two_trainings_are_the_same(place, make_avatar, kind):
    ends = []
    for _ in range(2):
        avatar = stir(make_avatar()).to(place.device)
        frames, background = frames_on(place, avatar, 3)
        step = step_of(place, avatar, make_optimizer(avatar), frames, 3, kind)
        losses = [step([0, 1, 2], background) for _ in range(5)]
        ends.append([torch.stack(losses), *(p.detach() for p in avatar.parameters())])
    # The weight network's gradients are torch's, whose sums on a GPU may be in another order.
    assert max(float((a - b).abs().max()) for a, b in zip(*ends)) < 1e-6


@pytest.mark.parametrize("kind", ["fused", "recorded"])
def test_steps_without_room_change_no_gaussian_until_there_is_more(
    place, make_avatar, kind, monkeypatch
):
    monkeypatch.setattr(recorded_steps, "_LOOK_EVERY", 8)
    avatar = stir(make_avatar()).to(place.device)
    frames, background = frames_on(place, avatar, 2)
    capacities = place.backend.capacities(place.device)
    step = step_of(place, avatar, make_optimizer(avatar), frames, 2, kind)
    for _ in range(3 if kind == "recorded" else 0):
        step([0, 1], background)
    place.wait()
    capacities.per_image[(avatar.num_gaussians, 40, 40)] = 5
    skipped, position = capacities.skipped_steps, avatar.blendshapes.position
    before = position.detach().clone()
    step([0, 1], background)
    place.wait()
    assert torch.equal(position, before)
    for _ in range(10):
        step([0, 1], background)
    assert not torch.equal(position, before)
    assert getattr(step, "skipped_steps", capacities.skipped_steps - skipped) > 0


def test_changing_the_kind_of_step_changes_no_loss(place, make_avatar):
    kinds = ("autograd", "fused", "autograd", "recorded", "loaded", "fused", "recorded")
    losses = []
    for sequence in (("autograd",) * 6, kinds):
        avatar = stir(make_avatar()).to(place.device)
        frames, background = frames_on(place, avatar, 3)
        optimizer, taken = make_optimizer(avatar), []
        for kind in sequence:
            if kind == "loaded":
                optimizer.load_state_dict(optimizer.state_dict())
                continue
            step = step_of(place, avatar, optimizer, frames, 3, kind)
            taken.append(step([0, 1, 2], background))
        losses.append(torch.stack(taken))
    assert float((losses[1] / losses[0] - 1).abs().max()) < ROUNDING_OF_EARLY_LOSSES


@pytest.mark.parametrize("resumed", [False, True])
@pytest.mark.parametrize("kind", ["fused", "recorded"])
def test_nothing_waits_in_a_step(gpu, make_avatar, kind, resumed):
    place = Place(gpu, choose("cuda", gpu, torch.float32))
    avatar = stir(make_avatar()).to(gpu)
    frames, background = frames_on(place, avatar, 3)
    optimizer, there = make_optimizer(avatar), background.to(gpu)
    fused = FusedStep(avatar, [optimizer], "cuda")
    values = (frames.theta, frames.cameras, frames.images_rgba, there)
    if resumed:  # a loaded state lies where torch puts it
        fused(*values)
        optimizer.load_state_dict(optimizer.state_dict())
    recorded = step_of(place, avatar, optimizer, frames, 3, "recorded")

    def take() -> None:
        recorded([0, 1, 2], background) if kind == "recorded" else fused(*values)

    for _ in range(8):
        take()
    place.wait()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(5):
            take()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert waits_of_the_run_time(take) == []


def waits_of_the_run_time(take: Callable[[], None], steps: int = 5) -> list[str]:
    """Calls of the CUDA run time that wait, within some steps."""
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with (
        torch.profiler.profile(activities=activities) as profile,
        torch.profiler.record_function("steps"),
    ):
        for _ in range(steps):
            take()
    events = [event for event in profile.events() or [] if event.device_type.name == "CPU"]
    whole = next(event.time_range for event in events if event.name == "steps")
    inside = (e.name for e in events if whole.start <= e.time_range.start <= whole.end)
    return [name for name in inside if "Synchronize" in name]


def test_a_whole_fit_recorded_and_fused(place, make_avatar):
    steps, count = (24, 4) if place.emulated else (300, 40)
    config = {} if place.emulated else {"uv_resolution": 64}
    shown = stir(make_avatar(**config)).to(place.device)
    theta = random_theta(shown.layout, count).to(place.device)
    cameras = on_device(front_camera(24 if place.emulated else 256), place.device)
    with torch.no_grad():
        drawn = shown.render(theta, cameras, backend="cuda")
    rgba = torch.cat([drawn.image / drawn.alpha.clamp(min=1e-6), drawn.alpha], -1)
    frames = DeviceFrames(theta, cameras, (255 * rgba.clamp(0, 1)).round().to(torch.uint8))
    losses = {}
    for kind in ("fused", "recorded"):
        avatar = make_avatar(**config).to(place.device)
        step = step_of(place, avatar, make_optimizer(avatar), frames, count // 2, kind)
        order, taken = torch.Generator().manual_seed(1), []
        for number in range(steps):
            chosen = torch.randperm(count, generator=order)[: count // 2].tolist()
            taken.append(step(chosen, random_backgrounds(number, count // 2)))
        losses[kind] = torch.stack(taken).cpu()
    apart = losses["recorded"] / losses["fused"] - 1
    assert losses["recorded"][-10:].mean() < 0.5 * losses["recorded"][:10].mean()
    assert float(apart[:10].abs().max()) < ROUNDING_OF_EARLY_LOSSES
    assert abs(float(apart[-steps // 4 :].mean())) < ROUNDING_OF_LATE_LOSSES


def test_a_surface_is_continued_as_on_a_processor(place):
    """By sparse products, of libraries that read their indices each in its own way."""
    avatar = embedded_avatar()
    random = torch.Generator().manual_seed(0)
    values = torch.rand(len(avatar.head.arrays.v_template), 3, generator=random)
    confidence = (values[:, 0] > 0.5).float()
    found = [
        MeshField(avatar.to(device))
        .continued(
            *(part.to(device) for part in (values, confidence, values)),
            stiffness=0.1,
            rest=1e-3,
            iterations=30,
        )
        .cpu()
        for device in (torch.device("cpu"), place.device)
    ]
    torch.testing.assert_close(found[1], found[0], atol=1e-4, rtol=1e-3)
