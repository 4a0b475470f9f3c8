"""The step that trains any method by the protocol of `AvatarMethod`."""

import copy
from dataclasses import replace

import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.method import WatchedStep
from rgbavatar_ns.avatar.training import TrainingBatch, TrainingOptions, TrainingStep
from rgbavatar_ns.avatar.training.batches import ChosenFrames
from rgbavatar_ns.avatar.training.method_step import MethodStep
from tests.avatar.small_head import front_camera, random_theta
from tests.avatar.training.test_color_init import random_pictures

PLAIN = TrainingOptions(seed=3, fast=False, surface_prior=False, first_colors=None)


class Watching(Avatar):
    """RGBAvatar that asks for the gradient by its projected means, and halves a learning rate."""

    watched: WatchedStep | None = None

    def watches(self, step: int) -> bool:
        return step == 1

    def rate_factors(self, step: int) -> dict[str, float]:
        return {"color": 0.5**step}

    def after_step(self, watched, optimizers, step, seed):
        self.watched = watched
        return {"step": float(step)}


def batch_of(avatar: Avatar, count: int = 2) -> TrainingBatch:
    camera, theta = front_camera(48), random_theta(avatar.layout, count)
    return TrainingBatch(theta, camera, random_pictures(count, 48))


def watching(make_avatar) -> Watching:
    avatar = make_avatar(random=True)
    avatar.__class__ = Watching
    return avatar


def test_rgbavatar_by_the_protocol_is_trained_as_by_its_own_eager_step(make_avatar):
    first, second = make_avatar(random=True), make_avatar(random=True)
    batch = batch_of(first)
    own, protocol = TrainingStep(first, options=PLAIN), MethodStep(second, seed=3)
    for step in range(3):
        losses, others = own(batch, step), protocol(batch, step)
        torch.testing.assert_close(losses["l1"], others["l1"])
    for name, value in first.state_dict().items():
        if not name.startswith("theta_"):  # the range of theta, which only its own step widens
            torch.testing.assert_close(second.state_dict()[name], value, msg=name)


def test_the_gradient_by_the_projected_means_comes_where_it_is_asked_for(make_avatar):
    avatar = watching(make_avatar)
    batch, told = batch_of(avatar), []
    step = MethodStep(avatar, logged=lambda number, figures: told.append((number, figures)))
    step(batch, 0)
    assert avatar.watched is None
    step(batch, 1)
    assert avatar.watched is not None
    gradient = avatar.watched.screen_gradient_px
    assert gradient.shape == (2, avatar.num_gaussians, 2)
    assert gradient.any()
    assert told == [(0, {"step": 0.0}), (1, {"step": 1.0})]


def test_rates_are_multiplied_and_a_resumed_run_multiplies_the_same(make_avatar):
    avatar = watching(make_avatar)
    resumed = copy.deepcopy(avatar)
    batch, whole = batch_of(avatar), MethodStep(avatar)
    for number in range(4):
        whole(batch, number)
    first = MethodStep(resumed)
    for number in range(2):
        first(batch, number)
    second = MethodStep(resumed)
    for optimizer, of_before in zip(second.optimizers, first.optimizers):
        optimizer.load_state_dict(of_before.state_dict())
    for number in range(2, 4):
        second(batch, number)
    rates = [o.param_groups[0]["lr"] for o in second.optimizers]
    assert rates == [o.param_groups[0]["lr"] for o in whole.optimizers]
    assert 0.0125 * 0.5**3 in rates
    for name, value in avatar.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], value), name


def test_what_it_cannot_take_is_told(make_avatar):
    avatar = make_avatar()
    step, batch = MethodStep(avatar), batch_of(avatar)
    with pytest.raises(ValueError, match=r"Steps are eager: .* Pass a TrainingBatch"):
        step(ChosenFrames([0], torch.zeros(1, 3)), 0)
    with pytest.raises(ValueError, match=r"The images are \(2, 24, 48, 4\)"):
        step(replace(batch, images_rgba=batch.images_rgba[:, :24]), 0)
