"""Steps to compare: avatars whose every gradient lives, and targets far from what they show."""

import dataclasses
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.training import TrainingBatch, make_optimizer
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.avatar.training.losses import image_losses
from rgbavatar_ns.drawing.compositing import composite, rgba_to_float
from rgbavatar_ns.kernels import PinholeCameras, RenderedBatch, rasterize
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from tests.kernels.scenes import to

from .small_head import front_camera, random_theta, randomize

AMOUNTS = {
    "position": 2e-3,
    "rotation": 0.4,
    "log_scale": 0.2,
    "opacity": 0.7,
    "color": 0.15,
    "basis_position": 1e-3,
    "basis_rotation": 0.2,
    "basis_color": 0.1,
    "weight_network": 0.02,
}


ROUNDING = 3e-5
AT_THE_CUT, MOST_AT_THE_CUT = 2e-3, 5
VARIANTS = {
    "paper": {},
    "no bases": {"num_bases": 0},
    "many bases": {"num_bases": 21},
    "linear network": {"weight_network": "linear"},
    "no pose": {"pose_input": False},
    "raw": {"tangent_variant": "raw"},
    "orthonormal": {"tangent_variant": "orthonormal"},
    "scaled": {"scale_with_triangle": True},
    "raw and scaled": {"tangent_variant": "raw", "scale_with_triangle": True},
}
"""Of avatars: each changes one thing that the step must know."""


def stir(avatar: Avatar, seed: int = 0) -> Avatar:
    """Move every parameter a little; colours stay between .3 and .7."""
    randomize(avatar, seed, AMOUNTS, most=2.0)
    return avatar


@torch.no_grad()
def spoil(avatar: Avatar, name: str, value: float) -> None:
    """Put a number that is none into what four Gaussians hold."""
    rows = getattr(avatar.blendshapes, name)
    (rows[1] if name.startswith("basis") else rows)[5:9] = value


@torch.no_grad()
def drawn_by_the_reference(avatar: Avatar, theta: Tensor, cameras: PinholeCameras) -> RenderedBatch:
    """Morphed, carried and activated by torch, then drawn by the readable backend."""
    return rasterize(avatar.gaussians(theta), cameras, backend="reference")


def far_batch(
    avatar: Avatar, count: int, width: int = 40, height: int = 40, cameras: int = 1
) -> tuple[TrainingBatch, Tensor]:
    """Frames whose pixels are much darker or much brighter than the avatar, and backgrounds.

    The L1 loss has a kink where image and target meet: there the gradient's sign is decided by
    rounding. Here all differences are above .1, so that two ways to compute must agree.
    """
    generator = torch.Generator().manual_seed(5)
    theta = random_theta(avatar.layout, count)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    bright = (torch.sin(0.7 * rows + 0.3 * columns) > 0)[None, :, :, None]
    images = torch.full((count, height, width, 4), 210, dtype=torch.uint8)
    images[..., :3] = 255 * bright.to(torch.uint8)
    images[..., 3] += (20 * torch.rand(count, height, width, generator=generator)).to(torch.uint8)
    background = 0.4 + 0.2 * torch.rand(count, 3, generator=generator)
    camera = front_camera(max(width, height)).select([0] * cameras)
    if cameras > 1:  # each moved a little
        camera.world_to_camera[:, :3, 3] += 0.01 * torch.randn(cameras, 3, generator=generator)
    centre = torch.tensor([[width / 2, height / 2]]).repeat(cameras, 1)
    camera = dataclasses.replace(camera, principal_point_px=centre, width=width, height=height)
    return TrainingBatch(theta, camera, images), background


def with_unfilmed_strip(batch: TrainingBatch) -> tuple[TrainingBatch, Tensor]:
    """Rows and columns of the images that nobody filmed, and where they are [H, W]."""
    images = torch.as_tensor(batch.images_rgba).clone()
    height, width = images.shape[1:3]
    unfilmed = torch.zeros(height, width, dtype=torch.bool)
    unfilmed[2 * height // 3 :], unfilmed[:, : width // 5] = True, True
    images[:, unfilmed] = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8)
    return dataclasses.replace(batch, images_rgba=images), unfilmed


def step_of_filmed(
    avatar: Avatar,
    optimizer: torch.optim.Optimizer,
    batch: TrainingBatch,
    background: Tensor,
    unfilmed: Tensor,
) -> Tensor:
    """By hand: the differences of filmed pixels alone are summed, over the number of all."""
    optimizer.zero_grad(set_to_none=True)
    image = avatar.render(batch.theta, batch.cameras, background, differentiable=True).image
    film = composite(rgba_to_float(torch.as_tensor(batch.images_rgba)), background)
    loss = (image - film)[:, ~unfilmed].abs().sum() / image.numel()
    loss.backward()
    optimizer.step()
    return loss.detach()


def assert_unfilmed_adds_nothing(
    step: Callable[..., Tensor], make: Callable[[], Avatar], count: int = 3
) -> None:
    """Loss and gradients as of the filmed pixels; with nothing filmed, no loss and no gradient."""
    avatar, expected = make(), make()
    whole, background = far_batch(avatar, count, 37, 29)
    batch, unfilmed = with_unfilmed_strip(whole)
    optimizer, expected_optimizer = make_optimizer(avatar), make_optimizer(expected)
    loss = step(avatar, optimizer, batch, background)
    right = step_of_filmed(expected, expected_optimizer, whole, background, unfilmed)
    assert float(loss) == pytest.approx(float(right), rel=1e-5)
    assert_gradients_agree(avatar, optimizer, expected, expected_optimizer)
    batch.images_rgba[:] = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8)
    idle = make()
    optimizer = make_optimizer(idle)
    assert float(step(idle, optimizer, batch, background)) == 0
    assert not any(bool(one.any()) for one in first_moments(idle, optimizer).values())


def fused_step(
    avatar: Avatar, optimizer: torch.optim.Optimizer, batch: TrainingBatch, background: Tensor
) -> Tensor:
    """Without autograd."""
    images = batch.images_rgba
    return FusedStep(avatar, [optimizer])(batch.theta, batch.cameras, images, background)


def eager_step(
    avatar: Avatar,
    optimizer: torch.optim.Optimizer,
    batch: TrainingBatch,
    background: Tensor,
    backend: str = "auto",
) -> Tensor:
    """The readable way, through autograd."""
    optimizer.zero_grad(set_to_none=True)
    image = avatar.render(
        batch.theta, batch.cameras, background, backend=backend, differentiable=True
    ).image
    loss = image_losses(image, batch.images_rgba, background)["l1"]
    loss.backward()
    optimizer.step()
    return loss.detach()


def first_moments(avatar: Avatar, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Adam's first moment of each group as one vector: the gradient, but for a factor."""
    return {
        name: torch.cat([optimizer.state[p]["exp_avg"].flatten() for p in parameters]).cpu()
        for name, parameters in avatar.parameter_groups().items()
    }


def values_by_group(avatar: Avatar) -> dict[str, Tensor]:
    """Each group's parameters as one vector."""
    return {
        name: torch.cat([p.detach().flatten() for p in parameters])
        for name, parameters in avatar.parameter_groups().items()
    }


def relative_differences(first: dict[str, Tensor], second: dict[str, Tensor]) -> dict[str, float]:
    """Each group's relative L2 difference; the second is the right one."""
    assert first.keys() == second.keys()
    return {
        name: float((first[name].double() - value.double()).norm() / value.double().norm())
        for name, value in second.items()
    }


def parting(avatar: Avatar, expected: Avatar) -> float:
    """The largest relative difference of a group's parameters."""
    return max(relative_differences(values_by_group(avatar), values_by_group(expected)).values())


def assert_gradients_agree(avatar, optimizer, expected, expected_optimizer) -> None:
    """Each group's first moments within rounding; the second avatar's are right.

    A (pixel, Gaussian) pair counts where alpha is at least 1/255. A pair that lies at that cut up
    to rounding belongs to one way and not to the other; in a hundred thousand there may be one.
    So a few Gaussians (its own and those behind it) may differ by more, yet not by much.
    """
    found, right = first_moments(avatar, optimizer), first_moments(expected, expected_optimizer)
    whole = relative_differences(found, right)
    assert max(whole.values()) < AT_THE_CUT, whole
    if max(whole.values()) < ROUNDING:
        return
    count = avatar.num_gaussians
    for name, value in right.items():
        if name == "weight_network":
            continue
        bases = avatar.config.num_bases if name.startswith("basis") else 1
        error = (found[name].double() - value.double()).view(bases, count, -1)
        squares = error.square().sum((0, 2)).sort().values[:-MOST_AT_THE_CUT]
        assert squares.sum().sqrt() < ROUNDING * value.double().norm(), (name, whole)


def double(avatar: Avatar) -> Avatar:
    """A copy in float64, for the reference."""
    copy = Avatar.from_state(avatar.to_state())
    copy.load_state_dict(avatar.state_dict())
    return copy.to(torch.float64)


def in_double(batch: TrainingBatch) -> TrainingBatch:
    """The batch for it."""
    cameras = to(batch.cameras, torch.float64)
    return dataclasses.replace(batch, theta=batch.theta.double(), cameras=cameras)
