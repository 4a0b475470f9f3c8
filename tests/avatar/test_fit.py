import pytest
import torch

from rgbavatar_ns.avatar import LEARNING_RATES
from rgbavatar_ns.avatar.training.color_init import ColorInitSchedule
from rgbavatar_ns.avatar.training.loop import (
    TrainingBatch,
    TrainingOptions,
    fit,
    make_optimizer,
    training_loss,
)
from rgbavatar_ns.errors import UserError

from .small_head import front_camera, random_theta

SIZE, FRAMES = 24, 6


@pytest.fixture
def batch_at(make_avatar):
    """Batches of three frames of an avatar that nobody trained, as 8-bit straight-alpha images."""
    teacher = make_avatar(random=True, initial_scale_m=8e-3)
    theta, camera = random_theta(teacher.layout, FRAMES), front_camera(SIZE)
    with torch.no_grad():
        rendered = teacher.render(theta, camera)
    straight = rendered.image / rendered.alpha.clamp(min=1e-3)
    rgba = torch.cat((straight.clamp(0, 1), rendered.alpha.clamp(0, 1)), -1)
    rgba = (rgba * 255).round().to(torch.uint8)

    def batch(step: int) -> TrainingBatch:
        pick = torch.randperm(FRAMES, generator=torch.Generator().manual_seed(step))[:3]
        return TrainingBatch(theta[pick], camera, rgba[pick])

    return batch


def test_fit_lowers_the_loss(make_avatar, batch_at):
    losses = fit(make_avatar(), batch_at, 40)
    assert losses[-5:].mean() < 0.5 * losses[:1].mean()


def test_bases_help(make_avatar, batch_at):
    """The teacher moves with psi: three bases fit it better than none."""
    without = fit(make_avatar(num_bases=0), batch_at, 40)[-6:].mean()
    assert fit(make_avatar(), batch_at, 40)[-6:].mean() < 0.98 * without


def test_one_seed_gives_one_result(make_avatar, batch_at):
    results = []
    for seed in (5, 5, 6):
        avatar = make_avatar(seed=1)
        torch.manual_seed(len(results))
        fit(avatar, batch_at, 4, TrainingOptions(seed=seed))
        results.append(torch.cat([p.detach().flatten() for p in avatar.parameters()]))
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_training_in_pieces_equals_training_at_once(make_avatar, batch_at):
    whole, pieces = make_avatar(), make_avatar()
    fit(whole, batch_at, 6)
    optimizer = make_optimizer(pieces)
    fit(pieces, batch_at, 2, optimizer=optimizer)
    fit(pieces, batch_at, 4, optimizer=optimizer, first_step=2)
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
    batch = TrainingBatch(theta, camera, rgba.detach())
    for step in range(3):
        assert training_loss(avatar, batch, step, TrainingOptions()).item() < 1e-6


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
    losses = {}
    for name, schedule in (("off", None), ("on", ColorInitSchedule())):
        avatar = make_avatar(initial_scale_m=8e-3)
        losses[name] = fit(avatar, batch_at, 3, TrainingOptions(color_init=schedule))[-1]
        assert bool(avatar.color_initialized.any()) is (name == "on")
    assert losses["on"] < losses["off"]


def test_every_step_is_reported(make_avatar, batch_at):
    seen = []
    losses = fit(make_avatar(), batch_at, 3, first_step=7, on_step=lambda *x: seen.append(x))
    assert [step for step, _ in seen] == [7, 8, 9]
    assert torch.equal(torch.stack([loss for _, loss in seen]), losses)
    assert fit(make_avatar(), batch_at, 0).shape == (0,)


def test_an_lpips_loss_that_cannot_be_had_is_refused(make_avatar, batch_at, monkeypatch):
    def unavailable(self):
        raise UserError("LPIPS (vgg) is unavailable: offline.", "Go online.")

    monkeypatch.setattr("rgbavatar_ns.avatar.training.losses.LPIPSLoss.network", unavailable)
    with pytest.raises(UserError, match="unavailable"):
        fit(make_avatar(), batch_at, 1, TrainingOptions(lpips_weight=0.05))
    # Before its first step it is not needed.
    fit(make_avatar(), batch_at, 1, TrainingOptions(lpips_weight=0.05, lpips_start_step=2))
