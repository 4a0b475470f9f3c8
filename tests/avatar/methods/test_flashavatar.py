import copy
import dataclasses

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.method import DrawnBatch, FilmedBatch
from rgbavatar_ns.avatar.methods.flashavatar import (
    LEARNING_RATES,
    FlashAvatar,
    FlashAvatarConfig,
)
from rgbavatar_ns.avatar.methods.neighbours import neighbour_distance
from rgbavatar_ns.avatar.training.batches import TrainingBatch
from rgbavatar_ns.avatar.training.method_step import MethodStep
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, quat_wxyz_to_matrix
from rgbavatar_ns.kernels import rasterize
from tests.avatar.small_head import (
    front_camera,
    random_theta,
    small_head,
    small_head_arrays,
    small_identity,
)

SMALL = FlashAvatarConfig(
    uv_resolution=10, hidden_width=8, hidden_layers=2, octaves=2, network_precision="float32"
)


def build(dtype=torch.float32, seed: int = 0, head: HeadModel | None = None, **changes):
    """A small avatar whose Gaussians and colours are all at random."""
    config = dataclasses.replace(SMALL, **changes)
    avatar = FlashAvatar(head or small_head(), small_identity(), config, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, amount in (
            ("color", 1.0),
            ("color_rest", 0.3),
            ("rotation_wxyz", 0.4),
            ("log_scale", 0.3),
        ):
            value = getattr(avatar, name)
            value += amount * torch.randn(value.shape, generator=generator)
        for parameter in avatar.offset_network.output.parameters():
            parameter *= 0.1
    return avatar.to(dtype)


def with_mouth(**groups) -> HeadModel:
    """The small head, some of whose vertices are teeth."""
    arrays = small_head_arrays()
    groups = {name: np.asarray(index) for name, index in groups.items()}
    return HeadModel(dataclasses.replace(arrays, vertex_groups=arrays.vertex_groups | groups))


def batch_of(avatar, count: int = 2, size: int = 32) -> TrainingBatch:
    generator = torch.Generator().manual_seed(3)
    images = torch.randint(0, 255, (count, size, size, 4), generator=generator, dtype=torch.uint8)
    return TrainingBatch(random_theta(avatar.layout, count), front_camera(size), images)


def covariances(gaussians) -> torch.Tensor:
    turned = quat_wxyz_to_matrix(gaussians.quats_wxyz) * gaussians.scales[..., None, :]
    return turned @ turned.mT


def test_head_motion_moves_means_covariances_and_colours_rigidly():
    avatar = build(torch.float64)
    avatar.degree_now.fill_(3)
    theta = random_theta(avatar.layout, 2, dtype=torch.float64)
    still = theta.clone()
    still[:, avatar.layout.slice("rotation")] = 0
    still[:, avatar.layout.slice("translation")] = 0
    rotation = axis_angle_to_matrix(theta[:, avatar.layout.slice("rotation")])
    joint = avatar.head.joint_transforms(theta, avatar.identity)[:, 0]
    joint_shift = joint[:, :3, 3]
    moved = avatar.gaussians(theta)
    rest = avatar.gaussians(still)
    torch.testing.assert_close(moved.means, rest.means @ rotation.mT + joint_shift[:, None])
    expected = rotation[:, None] @ covariances(rest) @ rotation[:, None].mT
    torch.testing.assert_close(covariances(moved), expected)
    # A camera that is carried along sees the same colours.
    camera = front_camera(dtype=torch.float64).select([0, 0])
    back = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    back[:, :3, :3] = rotation.mT
    back[:, :3, 3] = -(rotation.mT @ joint_shift[..., None])[..., 0]
    along = dataclasses.replace(camera, world_to_camera=camera.world_to_camera @ back)
    seen = avatar.gaussians(theta, cameras=along).colors
    torch.testing.assert_close(seen, avatar.gaussians(still, cameras=camera).colors)
    assert not torch.allclose(seen, avatar.gaussians(theta, cameras=camera).colors)


def test_without_offsets_gaussians_stay_upon_their_places_of_the_mesh():
    avatar = build()
    for parameter in avatar.offset_network.output.parameters():
        torch.nn.init.zeros_(parameter)
    theta = random_theta(avatar.layout, 2)
    vertices = avatar.head(theta, avatar.identity)
    corners = vertices[:, avatar.head.faces[avatar.anchors.triangle_index]]
    expected = (corners * avatar.anchors.barycentric[:, :, None]).sum(2)
    gaussians = avatar.gaussians(theta)
    torch.testing.assert_close(gaussians.means, expected)
    torch.testing.assert_close(gaussians.scales, avatar.log_scale.exp().expand(2, -1, -1))


def test_the_networks_numbers_are_applied_as_the_release_does():
    avatar = build(torch.float64)
    theta = torch.zeros(1, avatar.layout.size, dtype=torch.float64)
    numbers = avatar.offsets(theta)[0]
    gaussians = avatar.gaussians(theta)
    torch.testing.assert_close(gaussians.means[0], avatar.place_at_rest + numbers[:, :3])
    scales = (avatar.log_scale * numbers[:, 7:].exp()).exp()
    torch.testing.assert_close(gaussians.scales[0], scales)
    turn = torch.cat([numbers[:, 3:4].exp(), numbers[:, 4:7]], 1)
    first, second = (quat_wxyz_to_matrix(q) for q in (avatar.rotation_wxyz, turn))
    torch.testing.assert_close(quat_wxyz_to_matrix(gaussians.quats_wxyz[0]), first @ second)


def test_the_network_knows_expression_and_joints_but_not_where_the_head_is():
    avatar = build()
    theta = random_theta(avatar.layout, 1)
    before = avatar.offsets(theta)
    for name in avatar.layout.names:
        other = theta.clone()
        other[:, avatar.layout.slice(name)] += 0.3
        same = torch.equal(avatar.offsets(other), before)
        assert same == (name in ("rotation", "translation")), name


def test_what_is_below_the_neck_carries_nothing():
    torso = with_mouth(torso=np.arange(30))
    avatar = build(head=torso)
    below = (avatar.head.faces[avatar.anchors.triangle_index] < 30).any(1)
    assert 0 < avatar.num_gaussians < build().num_gaussians
    assert not below.any()
    with pytest.raises(UserError, match="uv_resolution"):
        build(head=with_mouth(torso=np.arange(81)))


def test_scales_begin_at_the_distance_of_the_three_nearest():
    places = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9]])
    assert float(neighbour_distance(places)[0]) == pytest.approx(((1 + 4 + 9) / 3) ** 0.5)
    assert neighbour_distance(torch.zeros(5, 3)).tolist() == pytest.approx([1e-7**0.5] * 5)
    assert neighbour_distance(places[:2]).tolist() == [1, 1]
    assert float(neighbour_distance(places[:1])) > 0
    fresh = FlashAvatar(small_head(), small_identity(), SMALL)
    expected = neighbour_distance(fresh.place_at_rest)[:, None].expand(-1, 3)
    torch.testing.assert_close(fresh.log_scale.exp(), expected)
    theta = torch.zeros(1, fresh.layout.size)
    gaussians = fresh.gaussians(theta)
    torch.testing.assert_close(gaussians.opacities, torch.full_like(gaussians.opacities, 0.1))
    torch.testing.assert_close(gaussians.colors, torch.full_like(gaussians.colors, 0.5))


def test_degrees_are_raised_when_the_release_does():
    avatar = build(raise_degree_every=500)
    counted = []
    for step in range(2100):
        counted.append(int(avatar.degree_now))
        avatar.after_step(None, [], step, 0)
    # Its steps are counted from 1, and its step 500 is the first with degree 1.
    assert [counted.index(degree) + 1 for degree in range(4)] == [1, 500, 1000, 1500]
    assert max(counted) == 3


def test_every_parameter_has_a_gradient_and_finite_differences_agree():
    avatar = build(torch.float64)
    avatar.degree_now.fill_(3)
    theta = random_theta(avatar.layout, 2, dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)

    def outcome() -> torch.Tensor:
        generator.manual_seed(1)
        parts = vars(avatar.gaussians(theta, cameras=front_camera(8, torch.float64))).values()
        weights = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in parts]
        return torch.stack([(p * w).sum() for p, w in zip(parts, weights)]).sum()

    outcome().backward()
    groups = avatar.parameter_groups()
    assert groups.keys() == LEARNING_RATES.keys() == avatar.learning_rates().keys()
    assert sum(map(len, groups.values())) == len(list(avatar.parameters()))
    for parameters in groups.values():
        parameter, step = parameters[0], 1e-6
        gradient = parameter.grad
        assert gradient is not None
        place = int(gradient.abs().argmax())
        flat = parameter.detach().view(-1)
        values = []
        for sign in (1, -1):
            flat[place] += sign * step
            values.append(float(outcome().detach()))
            flat[place] -= sign * step
        measured = (values[0] - values[1]) / (2 * step)
        assert measured == pytest.approx(float(gradient.flatten()[place]), rel=1e-5)


def loss_case(avatar, image, target, unfilmed=None):
    size = image.shape[1]
    theta, camera = torch.zeros(1, avatar.layout.size), front_camera(size)
    gaussians = avatar.gaussians(theta)
    unfilmed = torch.zeros(1, size, size, dtype=torch.bool) if unfilmed is None else unfilmed
    rgba = torch.ones(1, size, size, 4)
    drawn = DrawnBatch(theta, camera, gaussians, image, image[..., :1])
    return drawn, FilmedBatch(rgba, torch.zeros(1, 3), target, rgba[..., 3:], unfilmed)


def test_the_loss_is_huber_and_forty_times_that_of_the_mouth():
    # The sheet's whole front is the mouth: at this focal length it is inside of the picture.
    avatar = build(head=with_mouth(upper_teeth=np.arange(81)))
    size = 32
    image, target = torch.zeros(1, size, size, 3), torch.zeros(1, size, size, 3)
    target[0, 16, 16] = torch.tensor([0.05, 0.5, 0.0])
    target[0, 0, 0] = 0.05
    huber = [0.05**2 / 2, 0.1 * (0.5 - 0.05)]
    losses = avatar.image_losses(*loss_case(avatar, image, target), 0)
    count = 3 * size * size
    assert float(losses["huber"]) == pytest.approx((sum(huber) + 3 * huber[0]) / count)
    assert float(losses["mouth"]) == pytest.approx(40 * sum(huber) / count)
    assert losses.keys() == {"huber", "mouth"}
    assert build().image_losses(*loss_case(build(), image, target), 0).keys() == {"huber"}


def test_lpips_counts_from_its_step_on_where_it_is_asked_for(monkeypatch):
    avatar = build(lpips_weight=0.05, lpips_from_step=7)
    image, target = torch.full((1, 16, 16, 3), 0.25), torch.ones(1, 16, 16, 3)
    unfilmed = torch.zeros(1, 16, 16, dtype=torch.bool)
    unfilmed[:, :8] = True
    target[unfilmed] = image[unfilmed]
    monkeypatch.setattr(avatar, "_lpips", lambda a, b: (a - b).abs().mean())
    case = loss_case(avatar, image, target, unfilmed)
    assert "lpips" not in avatar.image_losses(*case, 6)
    assert float(avatar.image_losses(*case, 7)["lpips"]) == pytest.approx(0.05 * 0.75 / 2)


def test_training_lowers_the_loss_and_is_determined_by_seed_and_steps():
    avatars = [build(raise_degree_every=5) for _ in range(2)]
    runs = []
    for avatar in avatars:
        step, batch = MethodStep(avatar, seed=1), batch_of(avatar)
        runs.append([float(sum(step(batch, s).values())) for s in range(30)])
    assert runs[0] == runs[1]
    assert np.mean(runs[0][-5:]) < np.mean(runs[0][:5])
    assert int(avatars[0].degree_now) == 3
    for name, value in avatars[0].state_dict().items():
        torch.testing.assert_close(value, avatars[1].state_dict()[name], rtol=0, atol=0)


def test_half_as_long_numbers_train_alike():
    losses = []
    for precision in ("float32", "bfloat16"):
        avatar = build(hidden_width=32, network_precision=precision)
        assert avatar.offset_network.precision == precision
        step, batch = MethodStep(avatar, seed=1), batch_of(avatar)
        losses.append([float(sum(step(batch, s).values())) for s in range(30)])
    assert losses[0] != losses[1]
    np.testing.assert_allclose(losses[1], losses[0], rtol=0.02)


def test_a_bundle_gives_the_same_picture(tmp_path):
    avatar = build(sh_degree=2, raise_degree_every=2)
    step, batch = MethodStep(avatar), batch_of(avatar)
    for number in range(4):
        step(batch, number)
    avatar.save(tmp_path / "fa")
    loaded = FlashAvatar.load(tmp_path / "fa")
    assert int(loaded.degree_now) == 2
    picture = loaded.render(batch.theta, batch.cameras).image
    torch.testing.assert_close(picture, avatar.render(batch.theta, batch.cameras).image)
    with pytest.raises(UserError, match="flashavatar-style"):
        Avatar.load(tmp_path / "fa")


def test_without_cameras_colours_are_those_of_all_views_in_the_mean():
    avatar = build()
    avatar.degree_now.fill_(3)
    theta = torch.zeros(1, avatar.layout.size)
    plain = copy.deepcopy(avatar)
    plain.degree_now.fill_(0)
    camera = front_camera()
    torch.testing.assert_close(
        avatar.gaussians(theta).colors, plain.gaussians(theta, cameras=camera).colors
    )
    seen = rasterize(avatar.gaussians(theta, cameras=camera), camera).image
    assert not torch.allclose(seen, plain.render(theta, camera).image)
