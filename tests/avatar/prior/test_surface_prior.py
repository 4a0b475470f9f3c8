"""What no frame shows goes to the surface; what frames show stays where training put it."""

import pytest
import torch

from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.training import TrainingBatch, TrainingOptions, TrainingStep, fit

from .test_mesh_field import embedded_avatar
from .test_outline import drawn_thicker, front_camera, turned

STEPS = range(179, 800, 20)


@pytest.fixture
def filmed():
    """An avatar whose parameters are noise, filmed from the front."""
    avatar = embedded_avatar()
    theta = turned(avatar, [-8.0, 0.0, 8.0])
    images = drawn_thicker(avatar, theta, 0.0)
    return avatar, theta, images


def shaken(avatar) -> None:
    random = torch.Generator().manual_seed(1)
    shapes = avatar.blendshapes
    for tensor, size in (
        (shapes.position, 4e-3),
        (shapes.color_feature, 1.0),
        (shapes.basis_position, 1e-3),
        (shapes.basis_color_feature, 0.3),
    ):
        tensor.data.add_(size * torch.randn(tensor.shape, generator=random))


def test_the_unseen_goes_to_the_surface_and_the_seen_stays(filmed):
    avatar, theta, images = filmed
    prior, shapes = SurfacePrior(avatar.num_gaussians), avatar.blendshapes
    prior.begin(avatar, theta, front_camera(), images)
    shaken(avatar)
    before = shapes.position.detach().clone()
    for step in STEPS:
        assert prior.due(step)
        prior.after_step(avatar, theta, front_camera(), images, step)
    unseen = prior.seen_px < prior.seen_px.quantile(0.1)
    rest = torch.zeros_like(before)
    rest[:, 2] = prior.offset_m
    left = (shapes.position - rest)[unseen].norm(dim=-1) / (before - rest)[unseen].norm(dim=-1)
    assert float(left.median()) < 0.5
    assert float(shapes.basis_position[:, unseen].abs().median()) < 5e-4
    # Colours there are smooth: near their surroundings' mean.
    assert float(shapes.color_feature[unseen].std(0).max()) < 1.0
    clear = prior.seen_px > prior.seen_px.quantile(0.8)
    moved = (shapes.position - before)[clear].norm(dim=-1)
    gone = (before - rest)[clear].norm(dim=-1)
    assert float((moved / gone).median()) < 0.3


def test_a_run_that_it_did_not_see_begin_is_left_alone(filmed):
    avatar, theta, images = filmed
    prior = SurfacePrior(avatar.num_gaussians)
    assert not any(prior.due(step) for step in STEPS)
    take = TrainingStep(avatar, prior=prior)
    take(TrainingBatch(theta, front_camera(), images), 5)
    assert not prior.has_begun


def test_without_the_option_nothing_is_measured(filmed):
    avatar, theta, images = filmed
    prior = SurfacePrior(avatar.num_gaussians)
    take = TrainingStep(avatar, options=TrainingOptions(surface_prior=False), prior=prior)
    take(TrainingBatch(theta, front_camera(), images), 0)
    assert not prior.has_begun


def test_its_memory_goes_on_from_its_state(filmed):
    avatar, theta, images = filmed
    prior, copy = (SurfacePrior(avatar.num_gaussians) for _ in range(2))
    prior.begin(avatar, theta, front_camera(), images)
    prior.after_step(avatar, theta, front_camera(), images, 79)
    copy.load_state_dict(prior.state_dict())
    assert copy.has_begun
    for name, value in prior.state_dict().items():
        assert torch.equal(value, copy.state_dict()[name])


@pytest.mark.slow
def test_a_head_filmed_from_the_front_has_a_back():
    def coverage(surface_prior: bool) -> float:
        avatar = embedded_avatar(uv_resolution=64)
        theta = turned(avatar, [-8.0, -4.0, 0.0, 4.0, 8.0])
        images = drawn_thicker(avatar, theta, 0.005)
        batch = TrainingBatch(theta, front_camera(), images)
        take = TrainingStep(avatar, options=TrainingOptions(surface_prior=surface_prior))
        fit(take, lambda step: batch, range(240))
        behind = turned(avatar, [180.0])
        alpha = avatar.render(behind, front_camera()).alpha[0, ..., 0]
        inside = drawn_thicker(avatar, behind, -0.003)[0, ..., 3] == 255
        return float((alpha[inside] > 0.9).float().mean())

    assert coverage(True) > 0.97
