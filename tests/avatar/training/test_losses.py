import numpy as np
import pytest
import torch
from scipy import stats

from rgbavatar_ns.avatar.model import image_loss
from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss
from rgbavatar_ns.avatar.training.losses import image_losses, random_backgrounds
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from tests.avatar.fused_scene import assert_unfilmed_adds_nothing, eager_step, stir


def test_backgrounds_depend_on_step_and_seed_alone():
    torch.manual_seed(0)
    first = random_backgrounds(7, 10, seed=3)
    torch.manual_seed(1)
    np.random.default_rng(0)
    assert torch.equal(first, random_backgrounds(7, 10, seed=3))
    assert not torch.equal(first, random_backgrounds(8, 10, seed=3))
    assert not torch.equal(first, random_backgrounds(7, 10, seed=4))
    assert len(first.unique()) == 30


def test_backgrounds_are_uniform_over_steps():
    values = torch.cat([random_backgrounds(step, 4) for step in range(500)]).flatten()
    assert stats.kstest(values.double().numpy(), "uniform").pvalue > 1e-3


def test_perceptual_loss_sees_no_difference_where_nobody_filmed(monkeypatch):
    """A network that looks five pixels far: gradients end at the film's border, values too."""

    class Blurred(torch.nn.Module):
        def forward(self, first, second, normalize):
            blurred = torch.nn.functional.avg_pool2d(first - second, 5, 1, 2)
            return blurred.square().mean((1, 2, 3))

    monkeypatch.setattr(image_loss, "_build_lpips_network", lambda _: Blurred())
    generator = torch.Generator().manual_seed(0)
    rgba = torch.randint(0, 256, (1, 12, 9, 4), generator=generator, dtype=torch.uint8)
    rgba[:, 8:] = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8)
    image = torch.rand(1, 12, 9, 3, generator=generator).requires_grad_()
    found = image_losses(image, rgba, torch.zeros(1, 3), LPIPSLoss(), 1.0)
    (gradient,) = torch.autograd.grad(found["l1"] + found["lpips"], image)
    assert not gradient[:, 8:].any()
    assert gradient[:, :8].all()
    with torch.no_grad():
        image[:, 8:] = 0.5
    again = image_losses(image, rgba, torch.zeros(1, 3), LPIPSLoss(), 1.0)
    for name, value in found.items():
        assert value.item() == pytest.approx(again[name].item(), rel=1e-6)


def test_what_nobody_filmed_adds_nothing(make_avatar):
    assert_unfilmed_adds_nothing(eager_step, lambda: stir(make_avatar()))
