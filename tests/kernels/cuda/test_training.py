"""Training by the emulated CUDA backend: the fused step against the eager one, and overflows."""

import pytest
import torch

from rgbavatar_ns.avatar.training import make_optimizer
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from tests.avatar.fused_scene import (
    VARIANTS,
    assert_gradients_agree,
    eager_step,
    far_batch,
    first_moments,
    fused_step,
    relative_differences,
    stir,
    values_by_group,
)
from tests.kernels.cuda import emulator

pytestmark = pytest.mark.skipif(emulator.compiler() is None, reason="no g++ to emulate CUDA with")


@pytest.fixture
def emulated(monkeypatch):
    return emulator.install(monkeypatch)


def _eager(build, batch, background):
    avatar = build()
    optimizer = make_optimizer(avatar)
    return float(eager_step(avatar, optimizer, batch, background, "reference")), avatar, optimizer


def _compare(emulated, build, batch, background) -> None:
    avatar = build()
    optimizer = make_optimizer(avatar)
    loss = fused_step(avatar, optimizer, batch, background)
    assert "train" in emulated.emulated.launched
    expected_loss, expected, expected_optimizer = _eager(build, batch, background)
    assert float(loss) == pytest.approx(expected_loss, rel=1e-5)
    assert_gradients_agree(avatar, optimizer, expected, expected_optimizer)


@pytest.mark.parametrize("variant", VARIANTS)
def test_gradients_of_every_variant(emulated, make_avatar, variant):
    def build():
        return stir(make_avatar(**VARIANTS[variant]))

    _compare(emulated, build, *far_batch(build(), 3))


@pytest.mark.parametrize("count", [1, 10, 17])
def test_gradients_of_every_batch(emulated, make_avatar, count):
    """Below and above what a thread holds in registers."""

    def build():
        return stir(make_avatar())

    _compare(emulated, build, *far_batch(build(), count, 20, 20, cameras=count))


def test_parameters_after_some_steps(emulated, make_avatar):
    """Adam's own arithmetic: bias corrections, moments, bases and base, network."""
    ends = []
    for step in (fused_step, eager_step):
        avatar = stir(make_avatar())
        batch, background = far_batch(avatar, 2, 24, 24)
        optimizer = make_optimizer(avatar)
        for group in optimizer.param_groups:
            group["lr"] *= 0.1
        for _ in range(8):
            step(avatar, optimizer, batch, background)
        ends.append(values_by_group(avatar))
    assert max(relative_differences(*ends).values()) < 1e-3


def test_gradient_of_theta(emulated, make_avatar):
    """Through vertices, frames and length ratios."""
    avatar = stir(make_avatar(scale_with_triangle=True))
    batch, background = far_batch(avatar, 3, cameras=3)
    gradients = []
    for run in (fused_step, eager_step):
        theta = batch.theta.clone().requires_grad_()
        own = stir(make_avatar(scale_with_triangle=True))
        moved = type(batch)(theta, batch.cameras, batch.images_rgba)
        run(own, make_optimizer(own), moved, background)
        assert theta.grad is not None
        gradients.append(theta.grad)
    assert (gradients[0] - gradients[1]).norm() < 2e-3 * gradients[1].norm()


def test_any_order_of_threads_gives_the_same_bits(emulated, make_avatar):
    """Sums are added in an order of their own, whichever thread comes first."""
    found = []
    for seed in (0, 1, 2):
        emulated.emulated.seed = seed
        avatar = stir(make_avatar())
        optimizer = make_optimizer(avatar)
        loss = fused_step(avatar, optimizer, *far_batch(avatar, 3))
        found.append((loss, first_moments(avatar, optimizer)))
    for loss, moments in found[1:]:
        assert torch.equal(loss, found[0][0])
        for name, value in moments.items():
            if name != "weight_network":
                assert torch.equal(value, found[0][1][name]), name


def _crowd(emulated, avatar, room: int):
    """Pretend that no picture of this kind ever needed more than `room` entries."""
    batch, background = far_batch(avatar, 2)
    capacities = emulated.capacities(torch.device("cpu"))
    capacities.per_image[(avatar.num_gaussians, 40, 40)] = room
    return capacities, batch, background


def test_a_step_that_overflows_changes_nothing_and_is_counted_and_the_next_has_room(
    emulated, make_avatar
):
    avatar = stir(make_avatar())
    capacities, batch, background = _crowd(emulated, avatar, 5)
    step = FusedStep(avatar, [make_optimizer(avatar)])
    before = [
        p.detach().clone() for ps in list(avatar.parameter_groups().values())[:-1] for p in ps
    ]

    def changed() -> bool:
        parameters = [p for ps in list(avatar.parameter_groups().values())[:-1] for p in ps]
        return any(not torch.equal(p, b) for p, b in zip(parameters, before))

    assert list(avatar.parameter_groups())[-1] == "weight_network"
    emulated.emulated.pending = True  # the report is still on its way
    step(batch.theta, batch.cameras, batch.images_rgba, background)
    assert not changed()
    assert capacities.skipped_steps == 0
    emulated.emulated.pending = False
    step(batch.theta, batch.cameras, batch.images_rgba, background)
    assert changed()
    assert capacities.skipped_steps == 1
    assert capacities.per_image[(avatar.num_gaussians, 40, 40)] > 5


def test_drawing_never_overflows(emulated, make_avatar):
    avatar = stir(make_avatar())
    expected = avatar.render(*_posed(avatar), backend="reference").image
    _crowd(emulated, avatar, 5)
    found = avatar.render(*_posed(avatar)).image
    assert (found - expected).abs().max() < 1e-4


def _posed(avatar):
    batch, _ = far_batch(avatar, 2)
    return batch.theta, batch.cameras
