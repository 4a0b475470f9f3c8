"""What `gpu_check.py` asks of training steps: gradients, bits, overflows, waits and a whole fit."""

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from gpu_sections import MOST_GRADIENT_ERROR, Finding, Place
from torch import Tensor

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.training import recorded_step as graphed_step
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.avatar.training.loop import TrainingBatch, make_optimizer
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.avatar.training.recorded_step import DeviceFrames, RecordedStep
from rgbavatar_ns.bench.scenes import front_camera as front_camera_of_head
from rgbavatar_ns.bench.scenes import on_device
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import rasterize
from tests.avatar.conftest import SMALL_CONFIG
from tests.avatar.fused_scene import (
    double,
    eager_step,
    far_batch,
    first_moments,
    fused_step,
    in_double,
    relative_differences,
    stir,
)
from tests.avatar.small_head import front_camera, random_theta, small_head, small_identity
from tests.avatar.test_fused_step import VARIANTS
from tests.kernels.scenes import ATTRIBUTES, random_scene, to

MOST_LOSS_ERROR = 1e-5
MOST_DIFFERENCE_OF_RUNS = 1e-6
FIRST_LOSSES, MOST_EARLY_DIFFERENCE, MOST_LATE_DIFFERENCE = 10, 1e-3, 3e-2
"""A recorded step and an eager one round differently, which 300 steps of Adam amplify."""
_FEW_VARIANTS = ("paper", "raw and scaled")


def small_avatar(**changes: Any) -> Avatar:
    """The tests' avatar, every parameter moved; always the same one."""
    config = dataclasses.replace(SMALL_CONFIG, **changes)
    return stir(Avatar(small_head(), small_identity(), config, seed=0))


def step_gradients(place: Place) -> Finding:
    """The fused step's loss and gradients against autograd through the float64 reference."""
    few = place.emulated or place.quick
    cases = {
        name: (changes, 3, 1)
        for name, changes in VARIANTS.items()
        if name in _FEW_VARIANTS or not few
    }
    if not few:
        cases |= {f"{count} images": ({}, count, count) for count in (1, 10, 17)}
    rows = {}
    for name, (changes, count, cameras) in cases.items():
        avatar, expected = small_avatar(**changes).to(place.device), double(small_avatar(**changes))
        batch, background = far_batch(expected, count, 36, 41, cameras)
        optimizer, expected_optimizer = make_optimizer(avatar), make_optimizer(expected)
        loss = fused_step(
            avatar, optimizer, on_device(batch, place.device), background.to(place.device)
        )
        right = eager_step(
            expected, expected_optimizer, in_double(batch), background.double(), "reference"
        )
        found = {n: m.cpu() for n, m in first_moments(avatar, optimizer).items()}
        groups = relative_differences(found, first_moments(expected, expected_optimizer))
        loss_error = abs(float(torch.as_tensor(loss)) / float(right) - 1)
        rows[name] = {"loss": loss_error, "gradients": groups}
    loss_error = max(row["loss"] for row in rows.values())
    worst = torch.tensor([e for row in rows.values() for e in row["gradients"].values()]).max()
    return Finding(
        loss_error < MOST_LOSS_ERROR and float(worst) < MOST_GRADIENT_ERROR,
        f"{len(rows)} cases: loss within {loss_error:.1e}, gradients within {worst:.1e}",
        {"cases": rows},
    )


def determinism(place: Place) -> Finding:
    """The largest difference between two runs with one seed; 0 is bit by bit."""
    scene = random_scene(3, width=70, height=50, count=100 if place.emulated else 4000)
    there = to(on_device(scene.gaussians, place.device), torch.float32)
    gradient_runs = [_gradients(there, on_device(scene.cameras, place.device)) for _ in range(2)]
    runs = {"rasterizer": gradient_runs}
    runs["eager steps"] = [_after_steps(place, recorded=False) for _ in range(2)]
    runs["recorded steps"] = [_after_steps(place, recorded=True) for _ in range(2)]
    largest = {
        name: float(torch.stack([(a - b).abs().max() for a, b in zip(*pair)]).max())
        for name, pair in runs.items()
    }
    told = ", ".join(
        f"{name} {'the same bits' if value == 0 else f'differ by {value:.1e}'}"
        for name, value in largest.items()
    )
    return Finding(
        all(value < MOST_DIFFERENCE_OF_RUNS for value in largest.values()), told, largest
    )


def _gradients(gaussians: Any, cameras: Any) -> list[Tensor]:
    leaves = [getattr(gaussians, name).clone().requires_grad_() for name in ATTRIBUTES]
    drawn = rasterize(type(gaussians)(*leaves), to(cameras, torch.float32), backend="cuda")
    (drawn.image.square().sum() + drawn.alpha.sum()).backward()
    return [drawn.image.detach(), *(torch.as_tensor(leaf.grad) for leaf in leaves)]


def small_frames(place: Place, count: int) -> tuple[DeviceFrames, Tensor]:
    """The tests' far targets as frames on the device, and backgrounds in main memory."""
    batch, background = far_batch(small_avatar(), count)
    batch = on_device(batch, place.device)
    frames = DeviceFrames(batch.theta, batch.cameras, torch.as_tensor(batch.images_rgba))
    return frames, background


def recorded_step(
    place: Place, avatar: Avatar, optimizer: torch.optim.Optimizer, frames: DeviceFrames, size: int
) -> RecordedStep:
    """The step as it is trained with; emulated, what would be recorded is done again."""
    if place.emulated:
        return RecordedStep(avatar, [optimizer], frames, size, recorder=lambda work: work)
    return RecordedStep(avatar, [optimizer], frames, size)


def _after_steps(place: Place, *, recorded: bool, steps: int = 5) -> list[Tensor]:
    avatar = small_avatar().to(place.device)
    optimizer = make_optimizer(avatar)
    frames, background = small_frames(place, 3)
    step = step_of(place, avatar, optimizer, frames, 3, recorded=recorded)
    losses = [step([0, 1, 2], background) for _ in range(steps)]
    return [torch.stack(losses), *(p.detach() for p in avatar.parameters())]


def step_of(
    place: Place,
    avatar: Avatar,
    optimizer: torch.optim.Optimizer,
    frames: DeviceFrames,
    size: int,
    *,
    recorded: bool,
) -> Callable[[list[int], Tensor], Tensor]:
    """A step on chosen frames, recorded or not."""
    if recorded:
        return recorded_step(place, avatar, optimizer, frames, size)
    fused = FusedStep(avatar, [optimizer])

    def take(chosen: list[int], background: Tensor) -> Tensor:
        cameras = frames.cameras
        if len(cameras.focal_px) > 1:
            cameras = cameras.select(chosen)
        images = frames.images_rgba[chosen]
        there = background.to(place.device)
        return torch.as_tensor(fused(frames.theta[chosen], cameras, images, there)).clone()

    return take


def overflow(place: Place) -> Finding:
    """A step without room changes no Gaussian and is counted; the next has room; drawing waits."""
    avatar = small_avatar().to(place.device)
    frames, background = small_frames(place, 2)
    capacities = place.backend.capacities(place.device)
    key = (avatar.num_gaussians, frames.cameras.width, frames.cameras.height)
    gaussians = [
        p for n, ps in avatar.parameter_groups().items() for p in ps if n != "weight_network"
    ]
    before = [p.detach().clone() for p in gaussians]

    def changed() -> bool:
        return any(not torch.equal(p, b) for p, b in zip(gaussians, before))

    take = step_of(place, avatar, make_optimizer(avatar), frames, 2, recorded=False)
    skipped = capacities.skipped_steps
    capacities.per_image[key] = 5
    take([0, 1], background)
    place.wait()
    facts = {"overflowing step changed nothing": not changed()}
    take([0, 1], background)
    facts["the next step had room"] = changed() and capacities.per_image[key] > 5
    facts["counted once"] = capacities.skipped_steps == skipped + 1
    capacities.per_image[key] = 5
    with torch.no_grad():
        drawn = avatar.render(frames.theta, frames.cameras).image.cpu()
        right = (
            avatar.cpu()
            .render(
                frames.theta.cpu(),
                on_device(frames.cameras, torch.device("cpu")),
                backend="reference",
            )
            .image
        )
    facts["drawing made room"] = float((drawn - right).abs().max()) < 2 / 255
    wrong = [name for name, holds in facts.items() if not holds]
    return Finding(not wrong, "not so: " + ", ".join(wrong) if wrong else ", ".join(facts), facts)


def recorded_overflow(place: Place) -> Finding:
    """Recorded steps without room are skipped, counted, and recorded anew with more."""
    avatar = small_avatar().to(place.device)
    frames, background = small_frames(place, 2)
    capacities = place.backend.capacities(place.device)
    key = (avatar.num_gaussians, frames.cameras.width, frames.cameras.height)
    step = recorded_step(place, avatar, make_optimizer(avatar), frames, 2)
    for _ in range(3):
        step([0, 1], background)
    place.wait()
    capacities.per_image[key] = 5
    start = [p.detach().clone() for p in avatar.parameters()]
    for _ in range(graphed_step._LOOK_EVERY - 4):
        step([0, 1], background)
    still = all(torch.equal(p, b) for p, b in zip(avatar.parameters(), start))
    for _ in range(10):
        step([0, 1], background)
    moved = any(not torch.equal(p, b) for p, b in zip(avatar.parameters(), start))
    told = f"{step.skipped_steps} skipped; {'moved' if moved else 'did not move'} after that"
    figures = {"skipped": step.skipped_steps, "still": still, "moved": moved}
    return Finding(still and moved and step.skipped_steps > 0, told, figures)


def changeover(place: Place) -> Finding:
    """Steps through autograd, fused and recorded, in turn and after loading: one run's losses."""
    frames, background = small_frames(place, 3)
    there = TrainingBatch(frames.theta, frames.cameras, frames.images_rgba)
    losses = []
    for kinds in (("autograd",) * 6, ("autograd", "fused", "autograd", "recorded", "loaded") * 2):
        avatar = small_avatar().to(place.device)
        optimizer, taken = make_optimizer(avatar), []
        for kind in kinds:
            if kind == "loaded":
                optimizer.load_state_dict(optimizer.state_dict())
            elif kind == "autograd":
                on_gpu = background.to(place.device)
                taken.append(eager_step(avatar, optimizer, there, on_gpu, "cuda"))
            else:
                step = step_of(place, avatar, optimizer, frames, 3, recorded=kind == "recorded")
                taken.append(step([0, 1, 2], background))
        losses.append(torch.stack(taken)[:6])
    error = float((losses[1] / losses[0] - 1).abs().max())
    told = f"losses within {error:.1e} of those of one kind"
    return Finding(error < MOST_EARLY_DIFFERENCE, told, {"losses": [x.tolist() for x in losses]})


def waiting(place: Place, steps: int = 5) -> Finding:
    """How often the host waits for the GPU in a step, once it is warm."""
    found = {}
    for name, take in {
        "eager step": _eager_take(place),
        "recorded step": _recorded_take(place),
        "recorded step, resumed": _recorded_take(place, resumed=True),
    }.items():
        for _ in range(8):
            take()
        place.wait()
        found[name] = {
            "torch": _complaint_of_torch(take, steps),
            "driver": _waits_of_the_driver(take, steps),
        }
    told = "; ".join(
        f"{name}: torch {row['torch'] or 'never'}, run time {row['driver'] or 'never'}"
        for name, row in found.items()
    )
    return Finding(not any(row["torch"] or row["driver"] for row in found.values()), told, found)


def _eager_take(place: Place) -> Callable[[], object]:
    """A fused step with all it needs on the device."""
    avatar = small_avatar().to(place.device)
    frames, background = small_frames(place, 3)
    step, there = FusedStep(avatar, [make_optimizer(avatar)]), background.to(place.device)
    return lambda: step(frames.theta, frames.cameras, frames.images_rgba, there)


def _recorded_take(place: Place, *, resumed: bool = False) -> Callable[[], object]:
    avatar = small_avatar().to(place.device)
    frames, background = small_frames(place, 3)
    optimizer = make_optimizer(avatar)
    if resumed:  # a loaded state lies where torch puts it
        step_of(place, avatar, optimizer, frames, 3, recorded=False)([0, 1, 2], background)
        optimizer.load_state_dict(optimizer.state_dict())
    step = recorded_step(place, avatar, optimizer, frames, 3)
    return lambda: step([0, 1, 2], background)


def _complaint_of_torch(take: Callable[[], object], steps: int) -> str | None:
    """What torch says where it has to wait within some steps."""
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(steps):
            take()
    except RuntimeError as error:
        return str(error).splitlines()[0]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return None


def _waits_of_the_driver(take: Callable[[], object], steps: int) -> dict[str, int]:
    """Calls of the CUDA run time that wait, by name, within some steps."""
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with (
        torch.profiler.profile(activities=activities) as profile,
        torch.profiler.record_function("steps"),
    ):
        for _ in range(steps):
            take()
    events = [event for event in profile.events() or [] if event.device_type.name == "CPU"]
    whole = next(event.time_range for event in events if event.name == "steps")
    inside = [e.name for e in events if whole.start <= e.time_range.start <= whole.end]
    return {name: inside.count(name) for name in set(inside) if "Synchronize" in name}


def film(avatar: Avatar, count: int, size_px: int, place: Place, small: bool) -> DeviceFrames:
    """Frames of the avatar with other parameters, as 8-bit pictures with alpha."""
    camera = front_camera(size_px) if small else front_camera_of_head(avatar, size_px)
    generator = torch.Generator().manual_seed(0)
    theta = random_theta(avatar.layout, count)
    if not small:
        theta = 0.05 * torch.randn(count, avatar.layout.size, generator=generator)
    shown = Avatar.from_state(avatar.to_state())
    shown.load_state_dict(avatar.state_dict())
    shown = stir(shown).to(place.device)
    theta, camera = theta.to(place.device), on_device(camera, place.device)
    pictures = []
    for part in theta.split(10):
        with torch.no_grad():
            drawn = shown.render(part, camera, backend="cuda")
        straight = drawn.image / drawn.alpha.clamp(min=1e-6)
        rgba = torch.cat([straight, drawn.alpha], -1)
        pictures.append((255 * rgba.clamp(0, 1)).round().to(torch.uint8))
    return DeviceFrames(theta, camera, torch.cat(pictures))


def training(place: Place) -> Finding:
    """A fit: the loss falls, and recorded steps give the losses of eager ones."""
    small = place.emulated
    steps = 24 if small else (100 if place.quick else 300)
    count, size_px, batch = (4, 24, 2) if small else (40, 256, 10)
    losses = {}
    for recorded in (False, True):
        avatar = _fresh_avatar(small)
        frames = film(avatar, count, size_px, place, small)
        avatar = avatar.to(place.device)
        optimizer = make_optimizer(avatar)
        step = step_of(place, avatar, optimizer, frames, batch, recorded=recorded)
        order = torch.Generator().manual_seed(1)
        taken = []
        for number in range(steps):
            chosen = torch.randperm(count, generator=order)[:batch].tolist()
            taken.append(step(chosen, random_backgrounds(number, batch)))
        losses[recorded] = torch.stack(taken).cpu()
    eager, ours = losses[False], losses[True]
    fell = float(ours[-10:].mean() / ours[:FIRST_LOSSES].mean())
    early = float((ours / eager - 1).abs()[:FIRST_LOSSES].max())
    late = abs(float(ours[-steps // 4 :].mean() / eager[-steps // 4 :].mean()) - 1)
    passed = fell < 0.5 and early < MOST_EARLY_DIFFERENCE and late < MOST_LATE_DIFFERENCE
    told = (
        f"{steps} steps: loss to {fell:.2f} of its start; recorded and eager within {early:.1e} "
        f"in the first {FIRST_LOSSES}, {late:.1e} in the last quarter"
    )
    return Finding(passed, told, {"recorded": ours.tolist(), "eager": eager.tolist()})


def _fresh_avatar(small: bool) -> Avatar:
    if small:
        return Avatar(small_head(), small_identity(), SMALL_CONFIG)
    head = HeadModel.embedded()
    return Avatar(head, torch.zeros(head.num_identity), AvatarConfig(uv_resolution=128))
