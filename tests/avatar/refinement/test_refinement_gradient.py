"""The gradient of theta: through autograd against finite differences, and without it."""

import pytest
import torch

from rgbavatar_ns.avatar.model.image_loss import l1_loss
from rgbavatar_ns.avatar.training import make_optimizer
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.drawing.compositing import composite, rgba_to_float
from rgbavatar_ns.kernels import available_backends
from tests.avatar.fused_scene import AT_THE_CUT, VARIANTS, double, far_batch, in_double, stir

compiled = pytest.mark.skipif("cpu" not in available_backends(), reason="not compiled")


def _eager_loss(avatar, theta, batch, background, backend="auto"):
    drawn = avatar.render(theta, batch.cameras, background, backend=backend, differentiable=True)
    target = composite(rgba_to_float(batch.images_rgba, theta.dtype), background)
    return l1_loss(drawn.image, target)


def _eager_gradient(avatar, batch, background, backend="auto"):
    theta = batch.theta.clone().requires_grad_()
    return torch.autograd.grad(_eager_loss(avatar, theta, batch, background, backend), theta)[0]


def test_gradient_of_theta_against_finite_differences(make_avatar):
    """Along random directions, in float64, with a network that answers to theta."""
    avatar = double(stir(make_avatar(scale_with_triangle=True)))
    batch, background = far_batch(avatar, 2)
    batch, background = in_double(batch), background.double()
    gradient = _eager_gradient(avatar, batch, background, "reference")
    generator = torch.Generator().manual_seed(3)
    step = 1e-8  # so small that hardly a pair of pixel and Gaussian crosses the cut of 1/255
    found, expected = [], []
    for _ in range(12):
        along = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        found.append(float((gradient * along).sum()))
        with torch.no_grad():
            ahead, behind = (
                _eager_loss(avatar, batch.theta + shift, batch, background, "reference")
                for shift in (step * along, -step * along)
            )
        expected.append(float(ahead - behind) / (2 * step))
    found, expected = torch.tensor(found), torch.tensor(expected)
    # One direction may meet the cut, where the loss jumps by up to 1/255 of a pixel.
    error = (found - expected).abs().sort().values[:-1]
    assert error.max() < 1e-5 * expected.abs().max()


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
def test_gradient_of_theta_without_autograd(make_avatar, variant):
    avatar = stir(make_avatar(**VARIANTS[variant]))
    batch, background = far_batch(avatar, 3, cameras=3)
    expected = _eager_gradient(avatar, batch, background)
    theta = batch.theta.clone().requires_grad_()
    step = FusedStep(avatar, [make_optimizer(avatar)])
    assert step(theta, batch.cameras, batch.images_rgba, background) is not None
    assert theta.grad is not None
    assert (theta.grad - expected).norm() < AT_THE_CUT * expected.norm()


@compiled
def test_gradients_of_a_frozen_avatar_change_nothing_else(make_avatar):
    """Without parameters to step, the same gradients come and the avatar stays to the bit."""
    avatar = stir(make_avatar())
    batch, background = far_batch(avatar, 3)
    before = {name: value.clone() for name, value in avatar.state_dict().items()}
    gradients = []
    step = FusedStep(avatar, [make_optimizer(avatar)])
    for frozen in (True, False):
        renderer = avatar.renderer(batch.theta, batch.cameras)
        assert renderer is not None
        renderer.forward_loss(batch.images_rgba, background)
        if frozen:
            gradients.append(renderer.backward_adam(None, with_vertices=True))
            after = avatar.state_dict()
            assert all(torch.equal(after[name], value) for name, value in before.items())
        else:
            gradients.append(step.update_gaussians(renderer, with_vertices=True))
    assert torch.equal(gradients[0].weights, gradients[1].weights)
    assert torch.equal(gradients[0].vertices, gradients[1].vertices)


@compiled
def test_vertices_that_carry_no_gaussian_have_no_gradient(make_avatar):
    avatar = stir(make_avatar())
    batch, background = far_batch(avatar, 2)
    renderer = avatar.renderer(batch.theta, batch.cameras)
    assert renderer is not None
    renderer.forward_loss(batch.images_rgba, background)
    gradient = renderer.backward_adam(None, with_vertices=True).vertices
    assert gradient is not None
    carrying = torch.zeros(gradient.shape[1], dtype=torch.bool)
    carrying[avatar.head.faces[avatar.anchors.triangle_index].flatten()] = True
    assert bool(gradient[:, carrying].any())
    assert not bool(gradient[:, ~carrying].any())
