import dataclasses
import math

import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.method import DrawnBatch, FilmedBatch
from rgbavatar_ns.avatar.methods.density import DensityControl
from rgbavatar_ns.avatar.methods.gaussianavatars import GaussianAvatars, GaussianAvatarsConfig
from rgbavatar_ns.avatar.methods.loss_terms import dssim_loss
from rgbavatar_ns.avatar.storage.bundle import save_bundle
from rgbavatar_ns.avatar.training.batches import TrainingBatch
from rgbavatar_ns.avatar.training.method_step import MethodStep, method_optimizers
from rgbavatar_ns.drawing.compositing import film_over
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, quat_wxyz_to_matrix
from rgbavatar_ns.kernels import GaussianSet
from tests.avatar.small_head import (
    front_camera,
    random_theta,
    randomize,
    small_head,
    small_identity,
)

DOUBLE = torch.float64
FACES = 128
AMOUNTS = {
    "position": 0.3,
    "rotation": 0.4,
    "log_scale": 0.3,
    "opacity": 1.0,
    "color": 1.0,
    "color_rest": 0.3,
}
BUSY = DensityControl(
    from_step=1, until_step=100, every=2, gradient_threshold=1e-6, reset_every=0, max_count=200
)


def make(
    random: bool = True, dtype: torch.dtype = torch.float32, degree: int = 3, **changes
) -> GaussianAvatars:
    config = GaussianAvatarsConfig(**changes)
    method = GaussianAvatars(small_head(dtype), small_identity(dtype), config)
    if random:
        randomize(method, amounts=AMOUNTS)
        method.degree_now.fill_(min(degree, config.sh_degree))
    return method


def covariances(gaussians: GaussianSet) -> torch.Tensor:
    turned = quat_wxyz_to_matrix(gaussians.quats_wxyz) * gaussians.scales[..., None, :]
    return turned @ turned.mT


def film(size: int = 32, frames: int = 4) -> list[TrainingBatch]:
    """Frames of another avatar of the same head, one a batch."""
    teacher, camera = make(), front_camera(size)
    with torch.no_grad():
        teacher.opacity_logit.add_(3)
    theta = random_theta(teacher.layout, frames)
    drawn = teacher.render(theta, camera)
    color = (drawn.image / drawn.alpha.clamp(min=1e-3)).clamp(0, 1)
    rgba = (torch.cat([color, drawn.alpha], -1) * 255).round().to(torch.uint8)
    return [TrainingBatch(theta[k : k + 1], camera, rgba[k : k + 1]) for k in range(frames)]


def compared(method: GaussianAvatars, batch: TrainingBatch) -> tuple[DrawnBatch, FilmedBatch]:
    """What a step compares, over black."""
    gaussians = method.gaussians(batch.theta, cameras=batch.cameras)
    image = method.render(batch.theta, batch.cameras, differentiable=True)
    black, rgba = torch.zeros(1, 3), batch.images_rgba
    drawn = DrawnBatch(batch.theta, batch.cameras, gaussians, image.image, image.alpha)
    target = film_over(rgba, black, image.image.detach())
    unfilmed = torch.zeros(rgba.shape[:3], dtype=torch.bool)
    return drawn, FilmedBatch(rgba, black, target, rgba[..., 3:] / 255, unfilmed)


def test_a_fresh_avatar_has_a_grey_gaussian_as_large_as_each_triangle_in_its_middle():
    method, theta = make(random=False), random_theta(small_head().layout, 2)
    gaussians = method.gaussians(theta)
    assert method.num_gaussians == FACES
    corners = method.head(theta, method.identity)[:, method.head.faces]
    torch.testing.assert_close(gaussians.means, corners.mean(2))
    first, second = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    height = torch.linalg.cross(first, second).norm(dim=-1) / first.norm(dim=-1)
    size = (first.norm(dim=-1) + height) / 2
    torch.testing.assert_close(gaussians.scales, size[..., None].expand(-1, -1, 3))
    torch.testing.assert_close(gaussians.opacities, torch.full((1, FACES), 0.1))
    assert bool((gaussians.colors == 0.5).all())


def test_rigid_head_motion_moves_gaussians_rigidly():
    method = make(dtype=DOUBLE)
    layout = method.layout
    still = random_theta(layout, 1, dtype=DOUBLE)
    still[:, layout.slice("rotation")] = 0
    still[:, layout.slice("translation")] = 0
    turn, shift = torch.tensor([[0.3, -0.7, 0.2]], dtype=DOUBLE), torch.tensor([0.1, 0.02, -0.3])
    moved = still.clone()
    moved[:, layout.slice("rotation")] = turn
    moved[:, layout.slice("translation")] = shift.to(DOUBLE)
    rotation = axis_angle_to_matrix(turn)[0]
    before, after = method.gaussians(still), method.gaussians(moved)
    root = method.head.joints(method.identity)[0]
    # Expressions move the root too: the vertices say how the head went.
    vertices = [method.head(theta, method.identity)[0] for theta in (still, moved)]
    way = vertices[1][0] - rotation @ vertices[0][0]
    assert (way - shift - root + rotation @ root).norm() < 0.05
    torch.testing.assert_close(after.means, before.means @ rotation.mT + way)
    expected = rotation @ covariances(before) @ rotation.mT
    torch.testing.assert_close(covariances(after), expected)


def test_an_expression_moves_gaussians_with_their_triangles():
    """By affine maps that take each triangle's first corner, edge and plane along."""
    method = make(random=False, dtype=DOUBLE)
    with torch.no_grad():
        method.position.copy_(torch.tensor([0.2, 0.0, 0.1]))
    theta = random_theta(method.layout, 3, dtype=DOUBLE)
    corners = method.head(theta, method.identity)[:, method.head.faces]
    first, second = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    normal = torch.nn.functional.normalize(torch.linalg.cross(first, second), dim=-1)
    along = torch.nn.functional.normalize(first, dim=-1)
    away = method.gaussians(theta).means - corners.mean(2)
    size = method.gaussians(theta).scales[..., 0]
    torch.testing.assert_close((away * along).sum(-1), 0.2 * size)
    torch.testing.assert_close((away * normal).sum(-1), 0 * size)
    torch.testing.assert_close(away.norm(dim=-1), math.hypot(0.2, 0.1) * size)


def test_colours_follow_the_view_where_cameras_are_given():
    method, theta, camera = make(), random_theta(small_head().layout, 2), front_camera()
    plain, seen = method.gaussians(theta), method.gaussians(theta, cameras=camera)
    assert plain.colors.shape == (1, FACES, 3)
    assert seen.colors.shape == (2, FACES, 3)
    assert (seen.colors[0] - plain.colors[0]).abs().max() > 0.05
    method.degree_now.fill_(0)
    assert torch.equal(method.gaussians(theta, cameras=camera).colors, plain.colors)


def test_degrees_come_one_by_one():
    method = make(random=False, raise_degree_every=10)
    reached = []
    for step in range(40):
        method.after_step(None, [], step, 0)
        reached.append(int(method.degree_now))
    # The release's step 10, the first with one more, is our step 9.
    assert [reached.index(degree) + 1 for degree in (1, 2, 3)] == [9, 19, 29]


def test_gradients_reach_every_group_and_agree_with_finite_differences():
    method = make(dtype=DOUBLE)
    with torch.no_grad():
        method.opacity_logit.add_(2)
    theta, camera = random_theta(method.layout, 2, dtype=DOUBLE), front_camera(20, DOUBLE)
    weights = torch.rand(2, 20, 20, 3, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)

    def loss() -> torch.Tensor:
        image = method.render(theta, camera, differentiable=True)
        gaussians = method.gaussians(theta, cameras=camera)
        drawn = DrawnBatch(theta, camera, gaussians, image.image, image.alpha)
        return (weights * image.image).sum() + sum(method.penalty(drawn, 0).values())

    loss().backward()
    for name, (parameter,) in method.parameter_groups().items():
        gradient = parameter.grad
        assert gradient is not None, name
        place = int(gradient.abs().argmax())
        flat, step = parameter.data.view(-1), 1e-6
        flat[place] += step
        above = loss()
        flat[place] -= 2 * step
        below = loss()
        flat[place] += step
        found = (above - below).item() / (2 * step)
        assert found == pytest.approx(gradient.view(-1)[place].item(), rel=1e-4), name


def test_losses_are_the_papers():
    method, batch = make(), film(16)[0]
    drawn, filmed = compared(method, batch)
    losses = method.image_losses(drawn, filmed, 0)
    assert set(losses) == {"l1", "dssim"}
    difference = (drawn.image - filmed.target).abs().mean()
    torch.testing.assert_close(losses["l1"], 0.8 * difference)
    torch.testing.assert_close(losses["dssim"], 0.2 * dssim_loss(drawn.image, filmed.target))


def test_what_nobody_filmed_leaves_no_gradient():
    method, batch = make(), film(24)[0]
    drawn, filmed = compared(method, batch)
    image = drawn.image.detach().requires_grad_()
    unfilmed = torch.zeros_like(filmed.unfilmed)
    unfilmed[:, 12:] = True
    target = torch.where(unfilmed[..., None], image.detach(), filmed.target)
    filmed = dataclasses.replace(filmed, target=target, unfilmed=unfilmed)
    drawn = dataclasses.replace(drawn, image=image)
    torch.stack(list(method.image_losses(drawn, filmed, 0).values())).sum().backward()
    assert image.grad is not None
    assert not image.grad[:, 12:].any()
    assert image.grad[:, :12].abs().max() > 0


def test_hinges_as_worked_by_hand_over_what_is_in_view():
    method, camera = make(random=False), front_camera()
    theta = torch.zeros(1, method.layout.size)
    with torch.no_grad():
        method.log_scale.fill_(math.log(0.5))
        method.position[FACES // 2] = torch.tensor([0.0, -5.0, 0.0])
        method.log_scale[5, :2] = torch.tensor([math.log(3.6), math.log(4.6)])
    drawn = method.gaussians(theta, cameras=camera)
    batch = DrawnBatch(theta, camera, drawn, torch.zeros(1, 32, 32, 3), torch.zeros(1, 32, 32, 1))
    found = method.penalty(batch, 0)
    # Of 128 Gaussians, all in view, one is 4 too far, one 3 and 4 too large.
    assert found["position"].item() == pytest.approx(0.01 * 4 / FACES)
    assert found["scale"].item() == pytest.approx(5 / FACES)
    away = dataclasses.replace(
        camera, principal_point_px=camera.principal_point_px + torch.tensor([200.0, 0.0])
    )
    unseen = method.penalty(dataclasses.replace(batch, cameras=away), 0)
    assert all(value == 0 for value in unseen.values())


def test_rates_are_the_releases_and_that_of_places_falls():
    method = make(random=False, density=dataclasses.replace(BUSY, extent_m=0.5))
    rates = method.learning_rates()
    assert rates["position"] == pytest.approx(2.5e-3)
    assert rates["color_rest"] == pytest.approx(0.0025 / 20)
    assert set(rates) == set(method.parameter_groups())
    factor = [method.rate_factors(step)["position"] for step in (0, 299_999, 599_999, 10**6)]
    assert factor == pytest.approx([1, 0.1, 0.01, 0.01], rel=1e-4)


def test_density_control_fires_and_training_goes_on():
    method, batches, told = make(density=BUSY), film(), []
    step = MethodStep(method, logged=lambda number, figures: told.append((number, dict(figures))))
    for number in range(7):
        losses = step(batches[number % 4], number)
        assert all(bool(torch.isfinite(loss)) for loss in losses.values())
    assert [number for number, _ in told] == [1, 3, 5]
    assert told[0][1]["cloned"] + told[0][1]["split"] > 0
    assert method.num_gaussians == told[-1][1]["count"] > FACES
    for optimizer in step.optimizers:
        for parameter, state in optimizer.state.items():
            assert len(parameter) == method.num_gaussians
            assert state["exp_avg"].shape == parameter.shape
    assert len(method.statistics.times_seen) == method.num_gaussians


def test_each_triangle_keeps_a_gaussian():
    method = make(density=dataclasses.replace(BUSY, gradient_threshold=1e3, keep_one_per_face=True))
    with torch.no_grad():
        method.opacity_logit.fill_(-20.0)
    figures = method.before_next_step(method_optimizers(method), 1, 0)
    assert figures["kept_for_faces"] == FACES == method.num_gaussians
    free = dataclasses.replace(method.config.density, keep_one_per_face=False)
    other = make(density=free)
    with torch.no_grad():
        other.opacity_logit.fill_(-20.0)
        other.opacity_logit[:10] = 1.0
    other.before_next_step(method_optimizers(other), 1, 0)
    assert other.face_index.tolist() == list(range(10))


def test_children_of_a_split_lie_around_their_parent_in_its_triangle():
    method = make()
    with torch.no_grad():
        method.log_scale.fill_(math.log(1e-4))
    chosen = torch.tensor([7, 40])
    places = method._children(chosen, torch.randn(2, 2, 3))["position"]
    away = places - method.position[chosen][:, None]
    assert 0 < away.abs().max() < 1e-3


def test_stored_and_loaded_it_draws_the_same_after_its_number_has_changed(tmp_path):
    method, batches = make(density=BUSY), film()
    step = MethodStep(method)
    for number in range(4):
        step(batches[number % 4], number)
    assert method.num_gaussians != FACES
    method.save(tmp_path / "avatar")
    loaded = GaussianAvatars.load(tmp_path / "avatar")
    assert loaded.config == method.config
    theta, camera = random_theta(method.layout, 2, seed=5), front_camera()
    first, second = (m.render(theta, camera).image for m in (method, loaded))
    assert torch.equal(first, second)
    with pytest.raises(UserError, match=r"gaussianavatars-style.*rgbavatar is needed"):
        Avatar.load(tmp_path / "avatar")


@pytest.mark.parametrize("index", [-1, FACES])
def test_places_outside_of_the_head_are_told(index, tmp_path):
    method = make()
    method.face_index[3] = index
    method.save(tmp_path / "avatar")
    with pytest.raises(UserError, match="outside of the head's triangles"):
        GaussianAvatars.load(tmp_path / "avatar")


def test_coefficients_of_another_degree_are_told(tmp_path):
    state, own = make().to_state(), make().own_state_dict()
    state["config"]["sh_degree"] = 1
    save_bundle(state, own, tmp_path / "avatar", make().layout, None)
    with pytest.raises(UserError, match="color_rest"):
        GaussianAvatars.load(tmp_path / "avatar")


def trained(seed: int, steps: int) -> tuple[GaussianAvatars, list[float]]:
    """A fresh avatar after so many steps, and L1 and DSSIM of each."""
    method = make(random=False, density=dataclasses.replace(BUSY, every=5, until_step=12))
    step, batches, totals = MethodStep(method, seed=seed), film(), []
    for number in range(steps):
        losses = step(batches[number % 4], number)
        totals.append(float(losses["l1"] + losses["dssim"]))
    return method, totals


def test_training_is_a_function_of_seed_and_steps():
    first, second, third = (trained(seed, 12)[0] for seed in (1, 1, 2))
    assert first.num_gaussians > FACES
    assert all(map(torch.equal, first.buffers(), second.buffers()))
    assert all(map(torch.equal, first.parameters(), second.parameters()))
    assert not torch.equal(first.position[:100], third.position[:100])


def test_training_lowers_the_loss():
    _, losses = trained(0, 150)
    assert sum(losses[-8:]) < 0.6 * sum(losses[:8])
