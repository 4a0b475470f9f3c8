"""Theta of unseen frames, fitted for avatars of other methods (RGBAvatar's: tests/refinement)."""

import pytest
import torch

from rgbavatar_ns.avatar.methods.gaussianblendshapes import (
    GaussianBlendshapes,
    GaussianBlendshapesConfig,
)
from rgbavatar_ns.avatar.model.image_loss import l1_loss
from rgbavatar_ns.avatar.refinement import RefinementConfig
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.avatar.training.theta_fit import fit_theta, frame_gradients
from rgbavatar_ns.drawing.compositing import composite, rgba_to_float
from tests.avatar.small_head import front_camera, random_theta, small_head, small_identity

CONFIG = GaussianBlendshapesConfig(num_points=150, initial_opacity=0.8)


def rival(dtype: torch.dtype = torch.float32) -> GaussianBlendshapes:
    """With colours that vary over the head and bases that have learnt something."""
    avatar = GaussianBlendshapes(small_head(dtype), small_identity(dtype), CONFIG)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        avatar.face.color.copy_(1.5 * torch.sin(60 * avatar.face.position)[:, None])
        for parameter in avatar.parameter_groups()["basis_color"]:
            noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            parameter.copy_(0.3 * noise)
        avatar.shown_degree.fill_(1)
    return avatar.to(dtype)


def film_of(avatar: GaussianBlendshapes, theta: torch.Tensor, size: int) -> torch.Tensor:
    drawn = avatar.render(theta, front_camera(size, avatar.identity.dtype))
    straight = drawn.image / drawn.alpha.clamp(min=1e-3)
    rgba = torch.cat([straight, drawn.alpha], -1).clamp(0, 1)
    return (255 * rgba).round().to(torch.uint8)


def test_each_frame_has_the_gradient_of_its_own_loss_by_differences():
    avatar, camera = rival(torch.float64), front_camera(32, torch.float64)
    truth = random_theta(avatar.layout, 3, dtype=torch.float64)
    images, background = film_of(avatar, truth, 32), random_backgrounds(0, 3).double()
    theta = truth + 0.05 * random_theta(avatar.layout, 3, seed=7, dtype=torch.float64)
    found = frame_gradients(avatar, theta, camera, images, background)
    assert all(parameter.grad is None for parameter in avatar.parameters())

    def losses(given: torch.Tensor) -> torch.Tensor:
        drawn = avatar.render(given, camera, background).image
        target = composite(rgba_to_float(images, torch.float64), background)
        return torch.stack([l1_loss(a[None], b[None]) for a, b in zip(drawn, target)])

    step, generator, error, size = 1e-7, torch.Generator().manual_seed(3), [], []
    for _ in range(8):
        along = torch.randn(theta.shape, generator=generator, dtype=torch.float64)
        expected = (losses(theta + step * along) - losses(theta - step * along)) / (2 * step)
        error.append(((found * along).sum(1) - expected).abs())
        size.append(expected.abs())
    # A direction may cross the cut of alpha at 1/255, where the loss jumps.
    assert torch.stack(error).median(0).values.max() < 1e-4 * torch.stack(size).max()


def test_a_frozen_avatar_finds_the_theta_of_its_own_pictures():
    avatar = rival()
    before = {name: value.clone() for name, value in avatar.state_dict().items()}
    truth = random_theta(avatar.layout, 4)
    images, turn = film_of(avatar, truth, 40), avatar.layout.slice("rotation")
    tracked = truth.clone()
    tracked[:, turn] += 0.02 * torch.tensor([[1.0, -1.0, 0.0], [0.0, 1.0, 1.0]]).repeat(2, 1)
    config = RefinementConfig(rotation_sigma_rad=0.02, prior_weight=0.0)
    found = fit_theta(avatar, tracked, front_camera(40), images, 40, config=config)
    error = [float((theta - truth)[:, turn].norm()) for theta in (tracked, found)]
    assert error[1] < 0.5 * error[0]
    assert all(torch.equal(avatar.state_dict()[name], value) for name, value in before.items())
    with pytest.raises(ValueError, match="images"):
        fit_theta(avatar, tracked, front_camera(41), images, 1)


def test_chunks_of_any_size_fit_the_same_theta():
    avatar, camera = rival(torch.float64), front_camera(24, torch.float64)
    truth = random_theta(avatar.layout, 3, dtype=torch.float64)
    images = film_of(avatar, truth, 24)
    tracked = truth + 0.05 * random_theta(avatar.layout, 3, seed=7, dtype=torch.float64)
    rows = torch.arange(3)
    whole, *parts = (
        torch.cat(
            [
                fit_theta(avatar, tracked[chunk], camera, images[chunk], 4, reference=tracked)
                for chunk in rows.split(size)
            ]
        )
        for size in (3, 2, 1)
    )
    assert (whole - tracked).abs().max() > 1e-4
    for part in parts:
        torch.testing.assert_close(part, whole, atol=1e-9, rtol=0)
