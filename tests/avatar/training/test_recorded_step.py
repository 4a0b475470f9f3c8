"""The recorded step, on the emulated CUDA backend: the same steps, and nothing that waits."""

import weakref

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from rgbavatar_ns import kernels
from rgbavatar_ns.avatar.recorded_rendering import RecordedRendering
from rgbavatar_ns.avatar.training import make_optimizer
from rgbavatar_ns.avatar.training.batches import DeviceFrames
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.avatar.training.optimizer_states import AdamStates
from rgbavatar_ns.avatar.training.recorded_step import RecordedStep
from tests.avatar.fused_scene import eager_step, far_batch, fused_step, parting, stir

ORDER = [[0, 2], [1, 3], [3, 0], [2, 1], [0, 1], [3, 2]]


class Recorder:
    """Repeats the work itself; what a graph would keep is looked at meanwhile."""

    def __init__(self, watch=None) -> None:
        self.records, self.replays, self.watch = 0, 0, watch

    def __call__(self, work):
        self.records += 1

        def replay() -> None:
            self.replays += 1
            if self.watch is None:
                work()
            else:
                with self.watch:
                    work()

        return replay


class NothingWaits(TorchDispatchMode):
    """Refuses what a recorded stream refuses: reading numbers, copies from the host."""

    WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "lift_fresh", "equal")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.__name__.split(".")[0]
        assert name not in self.WAITING, f"{name} waits for the device"
        if name in ("index", "index_put", "index_put_"):
            indices = [t for t in args[1] if t is not None]
            assert all(t.dtype != torch.bool for t in indices), "a mask's size is not known"
        return func(*args, **(kwargs or {}))


def _frames(avatar, cameras: int = 1):
    batch, background = far_batch(avatar, 4, 24, 24, cameras=cameras)
    return DeviceFrames(batch.theta, batch.cameras, batch.images_rgba), background


def _slow(optimizer):
    for group in optimizer.param_groups:
        group["lr"] *= 0.1
    return optimizer


def _recorded(avatar, cameras: int = 1, watch=None):
    """A step on two of four frames that takes their numbers alone, and its parts."""
    frames, background = _frames(avatar, cameras)
    recorder, optimizer = Recorder(watch), make_optimizer(avatar)
    step = RecordedStep(avatar, [optimizer], frames, 2, recorder=recorder)
    return step, optimizer, recorder, lambda chosen: step(chosen, background[chosen])


@pytest.mark.parametrize("cameras", [1, 4])
@pytest.mark.parametrize("changes", [{}, {"num_bases": 0}, {"weight_network": "linear"}], ids=str)
def test_steps_equal_the_fused_ones(emulated, make_avatar, cameras, changes):
    recorder, losses = Recorder(), []
    graphed, fused = stir(make_avatar(**changes)), stir(make_avatar(**changes))
    frames, background = _frames(graphed, cameras)
    optimizer = _slow(make_optimizer(graphed))
    step = RecordedStep(graphed, [optimizer], frames, 2, recorder=recorder)
    for number, chosen in enumerate(ORDER):
        if number == 4:  # a schedule's new rate reaches a step that was recorded before
            optimizer.param_groups[0]["lr"] *= 0.5
        losses.append(float(step(chosen, background[chosen])))
    assert (recorder.records, recorder.replays) == (1, 3)
    optimizer = _slow(make_optimizer(fused))
    eager = FusedStep(fused, [optimizer])
    for number, chosen in enumerate(ORDER):
        if number == 4:
            optimizer.param_groups[0]["lr"] *= 0.5
        camera = frames.cameras.select(chosen) if cameras > 1 else frames.cameras
        loss = eager(frames.theta[chosen], camera, frames.images_rgba[chosen], background[chosen])
        assert losses[number] == pytest.approx(float(loss), rel=1e-5)
    assert parting(graphed, fused) < 1e-4


def test_nothing_in_a_recorded_step_waits_for_the_device(emulated, make_avatar, monkeypatch):
    avatar = stir(make_avatar(scale_with_triangle=True))
    # These look at numbers on a CPU only, where looking costs nothing.
    monkeypatch.setattr(avatar, "checked", lambda theta: theta)
    monkeypatch.setattr(kernels.morphed, "check_cameras", lambda _, cameras: len(cameras.focal_px))
    monkeypatch.setattr(kernels.morphed, "check_vertices", lambda *_: None)
    _, _, recorder, take = _recorded(avatar, 4, NothingWaits())
    reads = []
    launcher = emulated.emulated
    monkeypatch.setattr(launcher, "read_later", lambda numbers: reads.append(1) or (lambda: None))
    for number, chosen in enumerate(ORDER):
        if number == 3:
            monkeypatch.setattr(launcher, "capturing", lambda: True)
            before = len(reads)
        take(chosen)
    assert recorder.replays == 3
    assert len(reads) == before


def test_a_watch_that_sees_nothing_would_be_no_test():
    with pytest.raises(AssertionError, match="waits"), NothingWaits():
        torch.ones(3).sum().item()
    with pytest.raises(AssertionError, match="waits"), NothingWaits():
        torch.ones(3).new_tensor([1.0])
    with pytest.raises(AssertionError, match="mask"), NothingWaits():
        torch.ones(3)[torch.ones(3) > 0]


def test_overflows_are_counted_and_the_step_is_recorded_with_more_room(
    emulated, make_avatar, monkeypatch
):
    monkeypatch.setattr("rgbavatar_ns.avatar.training.recorded_step._LOOK_EVERY", 5)
    avatar = stir(make_avatar())
    step, _, recorder, take = _recorded(avatar)
    for chosen in ORDER[:4]:
        take(chosen)
    key = (avatar.num_gaussians, 24, 24)
    capacities = emulated.capacities(torch.device("cpu"))
    assert capacities.per_image[key] > 5
    capacities.per_image[key] = 5  # as if the head came nearer than ever before
    before = avatar.blendshapes.position.clone()
    take(ORDER[4])
    assert torch.equal(before, avatar.blendshapes.position)
    assert step.skipped_steps == 1
    for chosen in ORDER * 2:
        take(chosen)
    assert capacities.per_image[key] > 5
    assert not torch.equal(before, avatar.blendshapes.position)
    assert recorder.records == 2


def test_every_way_goes_on_from_the_others_counts(emulated, make_avatar):
    """Adam's bias corrections hang on the number of steps, whoever has taken them."""
    avatar = stir(make_avatar())
    _, optimizer, _, take = _recorded(avatar)
    for chosen in ORDER[:5]:
        take(chosen)
    batch, colors = far_batch(avatar, 2, 24, 24)
    eager_step(avatar, optimizer, batch, colors)
    fused_step(avatar, optimizer, batch, colors)
    take(ORDER[5])
    assert {float(state["step"]) for state in optimizer.state.values()} == {8.0}
    states = AdamStates(avatar, [optimizer])
    counts = [*states.next_of_gaussians().values(), *states.next_of_network()]
    assert {parameter.step for parameter in counts} == {9}


def test_a_checkpoint_that_was_loaded_is_recorded_anew(emulated, make_avatar):
    _, optimizer, recorder, take = _recorded(stir(make_avatar()))
    for chosen in ORDER[:5]:
        take(chosen)
    optimizer.load_state_dict(optimizer.state_dict())
    for state in optimizer.state.values():
        state["exp_avg"] = state["exp_avg"].clone()
    take(ORDER[5])
    assert recorder.records == 2


@pytest.mark.parametrize("moved", ["parameter", "anchors", "identity", "frames"])
def test_what_lies_elsewhere_is_recorded_anew_and_the_old_place_is_kept(
    emulated, make_avatar, moved
):
    avatar = stir(make_avatar())
    step, _, recorder, take = _recorded(avatar)
    for chosen in ORDER[:4]:
        take(chosen)
    assert recorder.records == 1
    take(ORDER[4])
    assert recorder.records == 1
    if moved == "parameter":
        avatar.blendshapes.position.data = avatar.blendshapes.position.data.clone()
    elif moved == "anchors":
        avatar.anchors.register_buffer("barycentric", avatar.anchors.barycentric.clone())
    elif moved == "identity":
        avatar.identity.mul_(1.01)  # in its place: what the head remembers is another
    else:
        frames = step.frames
        step.frames = DeviceFrames(frames.theta, frames.cameras, frames.images_rgba.clone())
    take(ORDER[5])
    assert recorder.records == 2


def test_what_a_recording_reads_lives_as_long_as_it(emulated, make_avatar):
    avatar = stir(make_avatar())
    _, _, _, take = _recorded(avatar)
    for chosen in ORDER[:4]:
        take(chosen)
    vertices = weakref.ref(avatar.head.remembered(avatar.identity)[0].untyped_storage())
    avatar.head.remembered(avatar.identity + 1)  # another person's take their place
    assert vertices() is not None


def test_numbers_of_adam_that_lie_with_the_host_are_counted_by_it(make_avatar):
    avatar = make_avatar().to("meta")
    optimizer = torch.optim.Adam(avatar.parameters(), lr=0.1, fused=False)
    states = AdamStates(avatar, [optimizer])
    states.next_of_gaussians(), states.next_of_network()
    states.add_one_to_all()  # within a recording it would happen once
    assert {float(step) for step in states.steps()} == {0.0}
    states.recount_all()
    assert {float(step) for step in states.steps()} == {1.0}
    assert {state.step for state in states.next_of_gaussians().values()} == {2}


def test_looking_for_overflows_waits_for_nothing(emulated, make_avatar, monkeypatch):
    monkeypatch.setattr("rgbavatar_ns.avatar.training.recorded_step._LOOK_EVERY", 2)
    avatar = stir(make_avatar())
    step, _, _, take = _recorded(avatar)
    arrived, asked = [], []

    def read_later(renderer, numbers):
        asked.append(numbers.tolist())
        kept = asked[-1]
        return lambda: kept if arrived else None

    monkeypatch.setattr(type(step_renderer(step, take)), "read_later", read_later)
    small = {(avatar.num_gaussians, 24, 24): 5}
    capacities = emulated.capacities(torch.device("cpu"))
    capacities.per_image |= small
    for chosen in ORDER[:3]:
        take(chosen)
    assert asked == [[1, asked[0][1]]]
    assert step.skipped_steps == 0
    capacities.per_image |= small
    take(ORDER[3])  # another one, before the first is known
    arrived.append(True)
    take(ORDER[4])
    assert step.skipped_steps == 1
    for chosen in ORDER:
        take(chosen)
    assert step.skipped_steps == 2


def step_renderer(step, take):
    """The renderer of a step's last work."""
    take(ORDER[0])
    return step._renderer_of_last_step


def test_what_cannot_be_recorded_is_refused(make_avatar):
    avatar = stir(make_avatar())
    frames, _ = _frames(avatar)
    with pytest.raises(ValueError, match="need the host"):
        RecordedStep(avatar, [make_optimizer(avatar)], frames, 2)


def test_another_number_of_frames_is_refused(emulated, make_avatar):
    *_, take = _recorded(stir(make_avatar()))
    with pytest.raises(ValueError, match="3 frames"):
        take([0, 1, 2])


def _rendering(avatar, cameras=1):
    batch, background = far_batch(avatar, 2, 30, 20, cameras=cameras)
    recorder = Recorder()
    rendering = RecordedRendering(avatar, batch.theta, batch.cameras, recorder=recorder)
    return rendering, recorder, batch, background


@pytest.mark.parametrize("cameras", [1, 2])
def test_pictures_are_the_ordinary_ones(emulated, make_avatar, cameras):
    avatar = stir(make_avatar())
    rendering, recorder, batch, background = _rendering(avatar, cameras)
    for number in range(5):
        theta = batch.theta.roll(number, 0) * (1 - 0.1 * number)
        if number == 4:  # training goes on in place
            with torch.no_grad():
                avatar.blendshapes.position.mul_(0.5)
        found = rendering(theta, batch.cameras, background).image
        expected = avatar.render(theta, batch.cameras, background, backend="reference").image
        assert (found - expected).abs().max() < 1e-4
    assert (recorder.records, recorder.replays) == (1, 3)
    assert rendering(batch.theta).alpha.max() > 0.5


def test_more_cameras_than_theta_are_refused_before_the_first_picture(emulated, make_avatar):
    """The first pictures would be drawn, and the recorded ones not."""
    avatar = stir(make_avatar())
    batch, _ = far_batch(avatar, 2, 30, 20, cameras=2)
    with pytest.raises(ValueError, match="2 cameras for 1 theta"):
        RecordedRendering(avatar, batch.theta[:1], batch.cameras, recorder=Recorder())


def test_a_picture_without_room_is_drawn_again(emulated, make_avatar):
    avatar = stir(make_avatar())
    rendering, recorder, batch, _ = _rendering(avatar)
    for _ in range(3):
        expected = rendering(batch.theta).image.clone()
    capacities = emulated.capacities(torch.device("cpu"))
    capacities.per_image[(avatar.num_gaussians, 30, 20)] = 5
    assert torch.equal(rendering(batch.theta).image, expected)
    for _ in range(3):
        assert torch.equal(rendering(batch.theta).image, expected)
    assert recorder.records == 2


def test_other_sizes_and_backends_are_refused(emulated, make_avatar):
    avatar = stir(make_avatar())
    rendering, _, batch, _ = _rendering(avatar)
    with pytest.raises(ValueError, match="Another batch"):
        rendering(batch.theta[:1])
    with pytest.raises(ValueError, match="need the host"):
        RecordedRendering(avatar, batch.theta, batch.cameras, backend="cpu")
