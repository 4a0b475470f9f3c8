import dataclasses
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor

from rgbavatar_ns.avatar import LEARNING_RATES
from rgbavatar_ns.avatar.training import (
    FitHooks,
    LossCurve,
    TrainingBatch,
    TrainingOptions,
    TrainingStep,
    fit,
    make_optimizer,
)
from rgbavatar_ns.avatar.training.batches import ChosenFrames
from rgbavatar_ns.avatar.training.color_init import FirstColorsKind
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.drawing.compositing import composite, rgba_to_float
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from tests.avatar.small_head import front_camera, random_theta

SIZE, FRAMES = 24, 6


@pytest.fixture
def batch_at(make_avatar):
    """Batches of three frames of an avatar that nobody trained, as 8-bit straight-alpha images."""
    teacher = make_avatar(random=True, initial_scale_m=8e-3)
    theta, camera = random_theta(teacher.layout, FRAMES), front_camera(SIZE)
    rendered = teacher.render(theta, camera)
    straight = rendered.image / rendered.alpha.clamp(min=1e-3)
    rgba = torch.cat((straight.clamp(0, 1), rendered.alpha.clamp(0, 1)), -1)
    rgba = (rgba * 255).round().to(torch.uint8)

    def batch(step: int) -> TrainingBatch:
        pick = torch.randperm(FRAMES, generator=torch.Generator().manual_seed(step))[:3]
        return TrainingBatch(theta[pick], camera, rgba[pick])

    return batch


def losses_of(avatar, batch_at, steps: int, options: TrainingOptions | None = None) -> Tensor:
    curve = LossCurve(steps)
    fit(TrainingStep(avatar, options=options), batch_at, range(steps), curve)
    return curve.losses


def test_fit_lowers_the_loss(make_avatar, batch_at):
    losses = losses_of(make_avatar(), batch_at, 40)
    assert losses[-5:].mean() < 0.5 * losses[:1].mean()


def test_a_chin_that_nobody_filmed_stays_and_an_empty_one_is_lost(make_avatar, batch_at):
    """Of a film that ends above the chin; the rest of the face is not learnt worse."""
    cut, everything = SIZE - SIZE // 3, batch_at(0)
    person = everything.images_rgba[..., 3] > 127
    above = torch.arange(SIZE)[:, None] < cut

    def trained_on(below: tuple[int, ...]) -> tuple[float, float]:
        def batch(step: int) -> TrainingBatch:
            whole = batch_at(step)
            images = whole.images_rgba.clone()
            images[:, cut:] = torch.tensor(below, dtype=torch.uint8)
            return dataclasses.replace(whole, images_rgba=images)

        avatar = make_avatar()
        losses_of(avatar, batch, 40)
        with torch.no_grad():
            drawn = avatar.render(everything.theta, everything.cameras)
        truth = composite(rgba_to_float(everything.images_rgba), torch.zeros(3))
        error = (drawn.image - truth).abs().mean(-1)
        chin = drawn.alpha[..., 0][person & ~above]
        return float(chin.mean()), float(error[:, :cut].mean())

    (kept, error), (lost, error_beside_empty) = (
        trained_on(below) for below in (UNFILMED_RGBA, (0, 0, 0, 0))
    )
    assert kept > 0.6
    assert lost < 0.45
    assert error < error_beside_empty


def test_bases_help(make_avatar, batch_at):
    """The teacher moves with psi: three bases fit it better than none."""
    without = losses_of(make_avatar(num_bases=0), batch_at, 40)[-6:].mean()
    assert losses_of(make_avatar(), batch_at, 40)[-6:].mean() < 0.98 * without


def test_one_seed_gives_one_result(make_avatar, batch_at):
    results = []
    for seed in (5, 5, 6):
        avatar = make_avatar(seed=1)
        torch.manual_seed(len(results))
        losses_of(avatar, batch_at, 4, TrainingOptions(seed=seed))
        results.append(torch.cat([p.detach().flatten() for p in avatar.parameters()]))
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_training_in_pieces_equals_training_at_once(make_avatar, batch_at):
    whole, pieces = make_avatar(), make_avatar()
    fit(TrainingStep(whole), batch_at, range(6))
    optimizer = make_optimizer(pieces)
    fit(TrainingStep(pieces, optimizer), batch_at, range(2))
    fit(TrainingStep(pieces, optimizer), batch_at, range(2, 6))
    for name, parameter in whole.named_parameters():
        assert torch.equal(parameter, pieces.get_parameter(name)), name


def test_the_right_answer_has_no_loss_on_any_background(make_avatar):
    avatar = make_avatar(random=True)
    with torch.no_grad():  # Colours inside [0, 1], as images hold them.
        avatar.blendshapes.color_feature.clamp_(-1, 1)
        avatar.blendshapes.basis_color_feature.zero_()
    theta, camera = random_theta(avatar.layout, 2), front_camera(SIZE)
    rendered = avatar.render(theta, camera)
    rgba = torch.cat((rendered.image / rendered.alpha.clamp(min=1e-6), rendered.alpha), -1)
    batch, take = TrainingBatch(theta, camera, rgba), TrainingStep(avatar)
    for step in range(3):
        background = random_backgrounds(step, 2)
        assert take.eager_losses(batch, theta, background, step)["l1"].item() < 1e-6


def test_optimizer_has_the_papers_rates(make_avatar):
    avatar = make_avatar()
    groups = {group["name"]: group for group in make_optimizer(avatar).param_groups}
    assert {name: group["lr"] for name, group in groups.items()} == LEARNING_RATES
    assert all(group["eps"] == 1e-15 for group in groups.values())
    slower = make_optimizer(avatar, {"color": 0.001})
    rates = {group["name"]: group["lr"] for group in slower.param_groups}
    assert rates == LEARNING_RATES | {"color": 0.001}


def test_color_initialisation_starts_nearer(make_avatar, batch_at):
    """Two steps in, initialised colours are nearer than grey ones moved by gradients."""
    losses = []
    kinds: list[FirstColorsKind | None] = ["matted", "paper", None]
    for kind in kinds:
        avatar = make_avatar(initial_scale_m=8e-3)
        losses.append(losses_of(avatar, batch_at, 3, TrainingOptions(first_colors=kind))[-1])
        assert bool(avatar.color_initialized.any()) is (kind is not None)
    assert max(losses[:2]) < losses[2]


def test_hooks_surround_every_step_and_may_end_the_training(make_avatar, batch_at):
    class Told(FitHooks):
        def __init__(self):
            self.calls = []

        def goes_on(self, step):
            self.calls.append(("goes on?", step))
            return step < 9

        @contextmanager
        def around_step(self, step):
            self.calls.append(("before", step))
            yield
            self.calls.append(("taken", step))

        def after_step(self, step, losses, seconds):
            assert set(losses) == {"l1"}
            assert not losses["l1"].requires_grad
            assert seconds > 0
            self.calls.append(("after", step))

    def batch(step):
        told.calls.append(("batch", step))
        return batch_at(step)

    told = Told()
    fit(TrainingStep(make_avatar()), batch, range(7, 100), told)
    each = ["goes on?", "before", "batch", "taken", "after"]
    assert told.calls == [(e, s) for s in (7, 8) for e in each] + [("goes on?", 9)]


def test_the_way_is_chosen_once_and_explained(make_avatar):
    def way(**options):
        step = TrainingStep(make_avatar(), options=TrainingOptions(**options))
        return step.kind, step.reason

    assert way() == ("fused", "the rasterizer's backend needs the host")
    assert way(lpips_weight=0.1, lpips_start_step=9)[1].endswith("at step 9")
    for reason, options in {
        "switched off": {"fast": False},
        "one by one": {"batch_parallel": False},
        "orthogonal": {"orthogonality": "loss"},
        "clipped": {"max_norm": {"color": 1.0}},
        "LPIPS": {"lpips_weight": 0.1},
        "backend": {"backend": "reference"},
    }.items():
        kind, told = way(**options)
        assert kind == "eager"
        assert reason in told
    eager = TrainingStep(make_avatar(), torch.optim.SGD(make_avatar().parameters()))
    assert eager.reason.startswith("no optimiser holds")
    with pytest.raises(ValueError, match="Steps are fused"):
        TrainingStep(make_avatar())(ChosenFrames([0], torch.zeros(1, 3)), 0)


def test_a_clipped_group_steps_by_the_clipped_gradient(make_avatar, batch_at):
    """By SGD, whose step is the gradient's."""
    moved = []
    for norm in ({}, {"color": 1e-3}):
        avatar = make_avatar()
        before = avatar.blendshapes.color_feature.detach().clone()
        options = TrainingOptions(max_norm=norm, first_colors=None)
        step = TrainingStep(avatar, torch.optim.SGD(avatar.parameters(), lr=1.0), options)
        step(batch_at(0), 0)
        moved.append(before - avatar.blendshapes.color_feature.detach())
    assert moved[0].norm() > 2e-3
    torch.testing.assert_close(moved[1], moved[0] * (1e-3 / moved[0].norm()), rtol=1e-3, atol=1e-9)


def test_an_lpips_loss_that_cannot_be_had_is_refused(make_avatar, batch_at, monkeypatch):
    def unavailable(self):
        raise UserError("LPIPS (vgg) is unavailable: offline.", "Go online.")

    monkeypatch.setattr("rgbavatar_ns.avatar.model.image_loss.LPIPSLoss.network", unavailable)
    with pytest.raises(UserError, match="unavailable"):
        losses_of(make_avatar(), batch_at, 1, TrainingOptions(lpips_weight=0.05))
    # Before its first step it is not needed.
    later = TrainingOptions(lpips_weight=0.05, lpips_start_step=2)
    losses_of(make_avatar(), batch_at, 1, later)
