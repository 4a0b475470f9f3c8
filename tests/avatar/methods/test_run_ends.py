"""A run ends with what its last step trained: what changes the set waits for the next step."""

import copy
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

import pytest
import torch

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.methods.density import DensityControl
from rgbavatar_ns.avatar.methods.gaussianavatars import GaussianAvatars, GaussianAvatarsConfig
from rgbavatar_ns.avatar.methods.gaussianblendshapes import (
    GaussianBlendshapes,
    GaussianBlendshapesConfig,
)
from rgbavatar_ns.avatar.methods.monogaussianavatar import (
    MonoGaussianAvatar,
    MonoGaussianAvatarConfig,
)
from rgbavatar_ns.avatar.methods.splattingavatar import SplattingAvatar, SplattingAvatarConfig
from rgbavatar_ns.avatar.training.batches import TrainingBatch
from rgbavatar_ns.avatar.training.method_step import MethodStep
from tests.avatar.small_head import front_camera, random_theta, small_head, small_identity
from tests.avatar.training.test_color_init import random_pictures

DUE = 3
"""Steps after which control is due."""
NEVER = DensityControl(from_step=10**6, until_step=10**6, reset_every=0)
GROWS = replace(NEVER, from_step=0, every=DUE, gradient_threshold=1e-9)
FADES = replace(NEVER, reset_every=DUE, reset_opacity=0.01)
Build = Callable[[], AvatarMethod]


def gaussianavatars(density: DensityControl) -> AvatarMethod:
    return GaussianAvatars(small_head(), small_identity(), GaussianAvatarsConfig(density=density))


def splattingavatar(density: DensityControl, walk_every: int = 10**6) -> AvatarMethod:
    config = SplattingAvatarConfig(initial_count=150, density=density, walk_every=walk_every)
    return SplattingAvatar(small_head(), small_identity(), config)


def gaussianblendshapes(density: DensityControl) -> AvatarMethod:
    config = GaussianBlendshapesConfig(num_points=60, density=density)
    return GaussianBlendshapes(small_head(), small_identity(), config)


def monogaussianavatar(steps_per_epoch: int) -> AvatarMethod:
    config = MonoGaussianAvatarConfig(
        steps_per_epoch=steps_per_epoch,
        max_points=450,
        prune_opacity=0.5,
        attribute_width=16,
        deformer_width=16,
        offset_width=8,
    )
    return MonoGaussianAvatar(small_head(), small_identity(), config)


CASES: dict[str, tuple[Build, Build]] = {
    f"{make.__name__}-{what}": (partial(make, density), partial(make, NEVER))
    for make in (gaussianavatars, splattingavatar, gaussianblendshapes)
    for what, density in (("grows", GROWS), ("fades", FADES))
} | {
    "splattingavatar-walks": (
        partial(splattingavatar, NEVER, DUE),
        partial(splattingavatar, NEVER),
    ),
    "monogaussianavatar-epoch": (
        partial(monogaussianavatar, DUE),
        partial(monogaussianavatar, 10**6),
    ),
}
"""By a name: a method of which control is due after `DUE` steps, and one without control."""


def take(step: MethodStep, numbers: Iterable[int]) -> None:
    camera, layout = front_camera(32), step.method.layout
    for number in numbers:
        theta = random_theta(layout, 2, seed=number)
        step(TrainingBatch(theta, camera, random_pictures(2, 32)), number)


def states(step: MethodStep) -> dict[str, torch.Tensor]:
    """Copies of what a checkpoint would keep of the method."""
    return {name: value.clone() for name, value in step.method.state_dict().items()}


def assert_same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


@pytest.mark.parametrize("name", CASES)
def test_a_run_ends_with_what_its_last_step_trained(name: str):
    controlled, free = (MethodStep(make(), seed=2) for make in CASES[name])
    for step in (controlled, free):
        take(step, range(DUE))
    assert_same(states(controlled), states(free))
    for step in (controlled, free):
        take(step, [DUE])
    now, without = states(controlled), states(free)
    assert any(
        value.shape != without[key].shape or not torch.equal(value, without[key])
        for key, value in now.items()
    )
    if name.endswith("fades"):
        for key in (key for key in now if key.endswith("opacity_logit") and "bases" not in key):
            assert now[key].sigmoid().max() < 0.02 < without[key].sigmoid().max()
    if name.endswith("grows"):
        assert controlled.method.num_gaussians > free.method.num_gaussians


@pytest.mark.parametrize("name", CASES)
def test_a_run_that_ended_where_control_is_due_goes_on_as_one_that_did_not_end(name: str):
    make = CASES[name][0]
    whole, first, second = (MethodStep(make(), seed=2) for _ in range(3))
    take(whole, range(2 * DUE + 1))
    take(first, range(DUE))
    kept, of_optimizers = states(first), [copy.deepcopy(o.state_dict()) for o in first.optimizers]
    second.method.fit_to(kept)
    second.method.load_state_dict(kept)
    for optimizer, state in zip(second.optimizers, of_optimizers):
        optimizer.load_state_dict(state)
    take(second, range(DUE, 2 * DUE + 1))
    assert_same(states(whole), states(second))


def test_an_epoch_that_was_ended_when_it_was_saved_is_not_ended_again():
    """As 0.2 saved it."""
    avatar = monogaussianavatar(DUE)
    step = MethodStep(avatar, seed=2)
    take(step, range(DUE))
    assert avatar.before_next_step(step.optimizers, DUE - 1, 2)
    before = states(step)
    assert not avatar.before_next_step(step.optimizers, DUE - 1, 2)
    assert_same(before, states(step))
