import dataclasses
import re

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar.method import DrawnBatch, FilmedBatch
from rgbavatar_ns.avatar.methods.flashavatar import FlashAvatar
from rgbavatar_ns.avatar.methods.loss_terms import dssim_loss
from rgbavatar_ns.avatar.methods.monogaussianavatar import (
    MonoGaussianAvatar,
    MonoGaussianAvatarConfig,
    radius_m,
)
from rgbavatar_ns.avatar.training.batches import TrainingBatch
from rgbavatar_ns.avatar.training.method_step import MethodStep, method_optimizers
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from tests.avatar.small_head import front_camera, random_theta, small_head, small_identity

SMALL = MonoGaussianAvatarConfig(
    steps_per_epoch=5,
    max_points=60,
    deformer_width=8,
    attribute_width=8,
    offset_width=6,
    octaves=2,
    network_precision="float32",
)


def build(dtype=torch.float32, seed: int = 0, random: bool = False, **changes):
    """A small avatar; `random` moves what is 0 at first: blendshapes and skinning."""
    config = dataclasses.replace(SMALL, **changes)
    avatar = MonoGaussianAvatar(small_head(), small_identity(), config, seed=seed)
    if random:
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for layer, amount in ((avatar.blendshapes, 0.02), (avatar.skinning.output, 0.05)):
                for parameter in layer.parameters():
                    parameter += amount * torch.randn(parameter.shape, generator=generator)
    return avatar.to(dtype)


def batch_of(avatar, count: int = 2, size: int = 32) -> TrainingBatch:
    generator = torch.Generator().manual_seed(3)
    images = torch.randint(0, 255, (count, size, size, 4), generator=generator, dtype=torch.uint8)
    images[..., 3] = 255
    return TrainingBatch(random_theta(avatar.layout, count), front_camera(size), images)


def bind(avatar, bone: int) -> None:
    """Let one bone carry all points."""
    with torch.no_grad():
        avatar.skinning.output.weight.zero_()
        avatar.skinning.output.bias.copy_(2.0 * (torch.arange(6) == bone))


def case(avatar, theta, image, target, unfilmed=None):
    size = image.shape[1]
    rgba = torch.ones(1, size, size, 4)
    unfilmed = torch.zeros(1, size, size, dtype=torch.bool) if unfilmed is None else unfilmed
    drawn = DrawnBatch(theta, front_camera(size), avatar.gaussians(theta), image, image[..., :1])
    return drawn, FilmedBatch(rgba, torch.zeros(1, 3), target, rgba[..., 3:], unfilmed)


def test_points_begin_on_a_sphere_and_rest_there_with_theta_zero():
    avatar = build(max_points=100_000)
    assert avatar.num_gaussians == 400
    rest = avatar.head(torch.zeros(avatar.layout.size), avatar.identity)
    middle = (rest.amin(0) + rest.amax(0)) / 2
    radius = torch.linalg.vector_norm(avatar.position - middle, dim=1)
    torch.testing.assert_close(radius, torch.full_like(radius, 0.125))
    gaussians = avatar.gaussians(torch.zeros(2, avatar.layout.size))
    torch.testing.assert_close(gaussians.means, avatar.position.expand(2, -1, -1))
    torch.testing.assert_close(avatar.deformed().skinning_weights, torch.full((400, 6), 1 / 6))


def test_places_differ_from_the_first_step_on():
    """Or one opacity suits all, and all vanish; torch's own initial values give .0003."""
    avatar = MonoGaussianAvatar(small_head(), small_identity())
    gaussians = avatar.gaussians(torch.zeros(1, avatar.layout.size))
    assert float(gaussians.opacities.std()) > 0.01
    assert float(gaussians.colors.std(1).mean()) > 0.01


def test_its_networks_numbers_are_none_that_processors_are_slow_with():
    avatar = MonoGaussianAvatar(small_head(), small_identity())
    gaussians = avatar.gaussians(random_theta(avatar.layout, 1))
    (gaussians.colors.sum() + gaussians.means.square().sum()).backward()
    smallest = torch.finfo(torch.float32).tiny
    for network in (avatar.deformer, avatar.attributes):
        gradient = torch.cat([p.grad.flatten() for p in network.parameters() if p.grad is not None])
        assert not ((gradient != 0) & (gradient.abs() < smallest)).any()


@pytest.mark.parametrize("joint", range(5))
def test_a_joint_carries_the_points_that_are_bound_to_it(joint):
    avatar = build(torch.float64)
    bind(avatar, joint + 1)
    theta = random_theta(avatar.layout, 2, dtype=torch.float64)
    transform = avatar.head.joint_transforms(theta, avatar.identity)[:, joint]
    expected = avatar.position @ transform[:, :3, :3].mT + transform[:, None, :3, 3]
    torch.testing.assert_close(avatar.gaussians(theta).means, expected)


def test_the_sixth_bone_follows_the_translation_alone():
    avatar = build(torch.float64)
    bind(avatar, 0)
    theta = random_theta(avatar.layout, 1, dtype=torch.float64)
    shift = theta[:, avatar.layout.slice("translation")]
    torch.testing.assert_close(avatar.gaussians(theta).means[0], avatar.position + shift)


def test_moving_sideways_moves_the_points_and_nothing_else():
    avatar = build(torch.float64, random=True)
    theta = random_theta(avatar.layout, 1, dtype=torch.float64)
    moved = theta.clone()
    moved[:, avatar.layout.slice("translation")] += torch.tensor([0.01, 0.02, 0.03])
    before, after = avatar.gaussians(theta), avatar.gaussians(moved)
    shift = torch.tensor([0.01, 0.02, 0.03]).double()
    torch.testing.assert_close(after.means, before.means + shift, rtol=0, atol=1e-7)
    for name in ("quats_wxyz", "scales", "opacities", "colors"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name))


def test_blendshapes_that_are_the_heads_move_points_as_its_vertices():
    """A point at a vertex, with that vertex's directions and weights, goes where it goes."""
    avatar = build(torch.float64)
    head = small_head(torch.float64)
    theta = random_theta(avatar.layout, 2, dtype=torch.float64)
    identity = avatar.identity
    points = dataclasses.replace(
        avatar.deformed(),
        place_at_rest=head(torch.zeros_like(theta[0]), identity),
        expression_dirs=avatar._expressions / 40,
        pose_dirs=avatar._correctives / 40,
        skinning_weights=avatar._skinning,
    )
    avatar.head = head
    torch.testing.assert_close(
        avatar._posed(points, theta), head(theta, identity), atol=1e-7, rtol=0
    )
    turns = axis_angle_to_matrix(theta[:, avatar.layout.slice("jaw")])
    assert float((turns - torch.eye(3)).abs().max()) > 0.01


def test_the_terms_tie_the_deformer_to_the_nearest_vertices():
    avatar = build(max_points=2)
    rest = avatar.head(torch.zeros(avatar.layout.size), avatar.identity)
    with torch.no_grad():
        avatar.position.copy_(rest[[5, 40]] + 1e-4)
    bind(avatar, 3)
    theta = torch.zeros(1, avatar.layout.size)
    picture = torch.zeros(1, 16, 16, 3)
    drawn, _ = case(avatar, theta, picture, picture)
    found = avatar.penalty(drawn, 0)
    arrays = avatar.head.arrays
    weights = np.zeros((2, 6))
    weights[:, 3] = 1
    truth = np.pad(arrays.skinning_weights[[5, 40]], ((0, 0), (1, 0)))
    assert float(found["skinning"]) == pytest.approx(np.square(weights - truth).mean(), rel=1e-4)
    # Blendshapes are 0 at first; in units of a fourth of a metre, times ten (loss.py).
    pose = 100 * np.square(40 * arrays.posedirs[[5, 40]]).mean()
    assert float(found["pose"]) == pytest.approx(pose, rel=1e-4)
    expressions = arrays.shapedirs[[5, 40]][..., arrays.num_identity :]
    expected = 100 * np.square(40 * expressions).mean()
    assert float(found["expression"]) == pytest.approx(expected, rel=1e-4)
    for epoch, share in ((19, 1), (20, 0.5), (30, 0.25), (50, 0.125), (70, 0.0625)):
        later = avatar.penalty(drawn, 5 * epoch)
        for name, value in found.items():
            assert float(later[name]) == pytest.approx(share * float(value))


def test_the_loss_is_l1_and_a_quarter_of_dssim_and_lpips_where_asked(monkeypatch):
    avatar = build(lpips_weight=0.1)
    monkeypatch.setattr(avatar, "_lpips", lambda a, b: (a - b).abs().mean())
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 1, 24, 24, 3, generator=generator)
    unfilmed = torch.zeros(1, 24, 24, dtype=torch.bool)
    unfilmed[:, :12] = True
    target = torch.where(unfilmed[..., None], image, target)
    image.requires_grad_()
    theta = torch.zeros(1, avatar.layout.size)
    losses = avatar.image_losses(*case(avatar, theta, image, target, unfilmed), 0)
    l1 = float((image - target).abs().mean().detach())
    assert float(losses["l1"].detach()) == pytest.approx(l1)
    assert float(losses["lpips"].detach()) == pytest.approx(0.1 * l1, rel=1e-5)
    dssim = float(dssim_loss(image, target).detach())
    assert float(losses["dssim"].detach()) == pytest.approx(0.25 * dssim, rel=1e-5)
    (gradient,) = torch.autograd.grad(torch.stack(list(losses.values())).sum(), image)
    assert not gradient[unfilmed].any()
    assert gradient[~unfilmed].any()


def test_every_group_has_a_gradient_and_finite_differences_agree(monkeypatch):
    avatar = build(torch.float64, random=True)
    theta = random_theta(avatar.layout, 2, dtype=torch.float64)
    picture = torch.zeros(2, 16, 16, 3, dtype=torch.float64)
    generator = torch.Generator()

    def outcome() -> torch.Tensor:
        generator.manual_seed(1)
        gaussians = avatar.gaussians(theta)
        values = list(vars(gaussians).values())
        weights = [torch.randn(v.shape, generator=generator, dtype=v.dtype) for v in values]
        drawn = DrawnBatch(theta, front_camera(), gaussians, picture, picture[..., :1])
        parts = [(value * weight).sum() for value, weight in zip(values, weights)]
        return torch.stack(parts + list(avatar.penalty(drawn, 0).values())).sum()

    outcome().backward()
    groups = avatar.parameter_groups()
    assert groups.keys() == avatar.learning_rates().keys()
    assert sum(map(len, groups.values())) == len(list(avatar.parameters()))
    for name, parameters in groups.items():
        assert any(p.grad is not None and p.grad.any() for p in parameters), name
    # As in the release no gradient goes through how far a point has moved: hold that still.
    gaussians, deformed = avatar.gaussians(theta), avatar.deformed()
    shift = theta[:, avatar.layout.slice("translation")][:, None]
    moved = 4 * (gaussians.means - shift - deformed.place_at_rest).detach()
    still = avatar.offsets(moved).detach()
    monkeypatch.setattr(avatar.offsets, "forward", lambda moved: still)
    for parameter in (avatar.blendshapes.weight, avatar.attributes.output.weight):
        assert parameter.grad is not None
        gradient, step = parameter.grad.flatten(), 1e-6
        flat, place = parameter.detach().view(-1), int(gradient.abs().argmax())
        values = []
        for sign in (1, -1):
            flat[place] += sign * step
            values.append(float(outcome().detach()))
            flat[place] -= sign * step
        measured = (values[0] - values[1]) / (2 * step)
        assert measured == pytest.approx(float(gradient[place]), rel=1e-5)


def test_points_and_radius_follow_the_releases_epochs():
    avatar = build(max_points=100_000)
    counts = [avatar.points_of(epoch) for epoch in (0, 4, 5, 29, 30, 59, 60, 500)]
    assert counts == [400, 400, 800, 10_000, 20_000, 80_000, 100_000, 100_000]
    assert build().points_of(60) == 60
    assert radius_m(0) == pytest.approx(0.15 * 0.75**2 / 4)
    assert radius_m(5) == pytest.approx(0.75 * radius_m(4))
    assert radius_m(35) == radius_m(30)
    assert radius_m(60) == pytest.approx(0.9 * radius_m(50))
    assert radius_m(64) == radius_m(60)
    assert radius_m(70) == pytest.approx(0.75**2 * radius_m(60))


def test_each_epoch_unseen_points_are_replaced_by_moved_copies_and_training_goes_on():
    avatar = build(max_points=450, steps_per_epoch=3)
    told = []
    optimizers = method_optimizers(avatar)
    step = MethodStep(avatar, optimizers, logged=lambda s, figures: told.append((s, figures)))
    batch = batch_of(avatar)
    for number in range(2):
        step(batch, number)
    assert bool(avatar.seen.all())
    assert not told
    # Faint points: no step of this epoch showed rows 0 and 1.
    avatar.seen[:2] = False
    keep = avatar.position.detach()[2:].clone()
    avatar.config = dataclasses.replace(avatar.config, prune_opacity=1.0)
    step(batch, 2)
    assert not told
    figures = avatar.before_next_step(optimizers, 2, 0)
    assert figures == {"points": 400, "pruned": 2, "copied": 2}
    assert int(avatar.epoch) == 1
    assert not avatar.seen.any()
    torch.testing.assert_close(avatar.position[:398], keep, rtol=0, atol=1e-3)
    apart = torch.cdist(avatar.position[398:], avatar.position[:398]).amin(1)
    assert float(apart.max()) <= radius_m(0) * 3**0.5 / 2 + 1e-6
    moments = next(o.state[avatar.position] for o in optimizers if avatar.position in o.state)
    assert moments["exp_avg"].shape == (400, 3)
    assert moments["exp_avg"][:398].any()
    assert not moments["exp_avg"][398:].any()
    avatar.config = dataclasses.replace(avatar.config, prune_opacity=0.1)
    for number in range(3, 16):
        step(batch, number)
    assert avatar.num_gaussians == 450
    assert [number for number, _ in told] == [5, 8, 11, 14]
    assert told[-1][1]["copied"] == 50


def test_where_every_point_is_faint_the_user_is_told():
    avatar = build(prune_opacity=1.0)
    with pytest.raises(UserError, match="transparent") as told:
        avatar.before_next_step([], 4, 0)
    remedy, options = told.value.remedy, {field.name for field in dataclasses.fields(avatar.config)}
    assert {"prune_opacity", "steps_per_epoch"} <= options & set(re.findall(r"\w+", remedy))
    assert "rgbavatar check" in remedy


def test_rates_are_halved_at_epochs_80_and_100():
    avatar = build()
    factors = [avatar.rate_factors(5 * epoch)["deformer"] for epoch in (0, 79, 80, 99, 100, 600)]
    assert factors == [1, 1, 0.5, 0.5, 0.25, 0.25]


def test_training_lowers_the_loss_and_is_determined_by_seed_and_steps():
    avatars = [build(max_points=200, steps_per_epoch=8) for _ in range(2)]
    runs = []
    for avatar in avatars:
        optimizers = method_optimizers(avatar)
        for optimizer in optimizers:
            optimizer.param_groups[0]["lr"] *= 10
        step, batch = MethodStep(avatar, optimizers, seed=1), batch_of(avatar)
        runs.append([float(sum(step(batch, s).values())) for s in range(40)])
    assert runs[0] == runs[1]
    assert np.mean(runs[0][-5:]) < np.mean(runs[0][:5])
    for name, value in avatars[0].state_dict().items():
        torch.testing.assert_close(value, avatars[1].state_dict()[name], rtol=0, atol=0)


def test_only_networks_of_attributes_multiply_half_as_long_numbers():
    avatars = [build(attribute_width=32, network_precision=p) for p in ("float32", "bfloat16")]
    exact, narrow = (avatar.gaussians(random_theta(avatar.layout, 2)) for avatar in avatars)
    assert torch.equal(exact.means, narrow.means), "whom the deformer carries"
    for name in ("scales", "opacities", "colors"):
        one, other = (getattr(gaussians, name) for gaussians in (exact, narrow))
        assert not torch.equal(one, other)
        torch.testing.assert_close(other, one, rtol=0.05, atol=0.01)


def test_a_bundle_gives_the_same_picture_though_points_were_added(tmp_path):
    avatar = build(max_points=500, steps_per_epoch=1, random=True)
    step, batch = MethodStep(avatar), batch_of(avatar)
    for number in range(7):
        step(batch, number)
    assert avatar.num_gaussians == 500
    avatar.save(tmp_path / "mono")
    loaded = MonoGaussianAvatar.load(tmp_path / "mono")
    assert int(loaded.epoch) == 6
    picture = loaded.render(batch.theta, batch.cameras).image
    torch.testing.assert_close(picture, avatar.render(batch.theta, batch.cameras).image)
    with pytest.raises(UserError, match="monogaussianavatar-style"):
        FlashAvatar.load(tmp_path / "mono")
