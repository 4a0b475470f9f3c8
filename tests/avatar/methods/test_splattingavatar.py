import dataclasses
import math

import pytest
import torch

from rgbavatar_ns.avatar.method import DrawnBatch, FilmedBatch
from rgbavatar_ns.avatar.methods.density import DensityControl
from rgbavatar_ns.avatar.methods.gaussianavatars import GaussianAvatars
from rgbavatar_ns.avatar.methods.splattingavatar import (
    SplattingAvatar,
    SplattingAvatarConfig,
    barycentric_change,
    random_places,
)
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
COUNT = 150
AMOUNTS = {
    "place": 0.1,
    "offset": 3e-3,
    "rotation": 0.4,
    "log_scale": 0.3,
    "opacity": 1.0,
    "color": 1.0,
}
BUSY = DensityControl(
    from_step=1, until_step=100, every=2, gradient_threshold=1e-6, reset_every=0, max_count=220
)


def make(
    random: bool = True, dtype: torch.dtype = torch.float32, seed: int = 0, **changes
) -> SplattingAvatar:
    config = dataclasses.replace(SplattingAvatarConfig(initial_count=COUNT), **changes)
    method = SplattingAvatar(small_head(dtype), small_identity(dtype), config, seed=seed)
    if random:
        randomize(method, amounts=AMOUNTS)
    return method


def covariances(gaussians: GaussianSet) -> torch.Tensor:
    turned = quat_wxyz_to_matrix(gaussians.quats_wxyz) * gaussians.scales[..., None, :]
    return turned @ turned.mT


def film(size: int = 32, frames: int = 4) -> list[TrainingBatch]:
    """Frames of another avatar of the same head, one a batch."""
    teacher, camera = make(seed=3), front_camera(size)
    with torch.no_grad():
        teacher.opacity_logit.add_(3)
    theta = random_theta(teacher.layout, frames)
    drawn = teacher.render(theta, camera)
    color = (drawn.image / drawn.alpha.clamp(min=1e-3)).clamp(0, 1)
    rgba = (torch.cat([color, drawn.alpha], -1) * 255).round().to(torch.uint8)
    return [TrainingBatch(theta[k : k + 1], camera, rgba[k : k + 1]) for k in range(frames)]


def compared(method: SplattingAvatar, batch: TrainingBatch) -> tuple[DrawnBatch, FilmedBatch]:
    """What a step compares, over black."""
    gaussians = method.gaussians(batch.theta, cameras=batch.cameras)
    image = method.render(batch.theta, batch.cameras, differentiable=True)
    black, rgba = torch.zeros(1, 3), batch.images_rgba
    drawn = DrawnBatch(batch.theta, batch.cameras, gaussians, image.image, image.alpha)
    target = film_over(rgba, black, image.image.detach())
    unfilmed = torch.zeros(rgba.shape[:3], dtype=torch.bool)
    return drawn, FilmedBatch(rgba, black, target, rgba[..., 3:] / 255, unfilmed)


def total(losses: dict[str, torch.Tensor]) -> torch.Tensor:
    return torch.stack(list(losses.values())).sum()


def on_mesh(method: SplattingAvatar, vertices: torch.Tensor) -> torch.Tensor:
    """Where the places are on a mesh, walks that are still to come included."""
    corners = vertices[:, method.head.faces[method.face_index]]
    u, v = method.place.detach().unbind(1)
    places = method.barycentric + torch.stack([u, v, -u - v], 1)
    return (corners * places[..., None]).sum(2)


def test_a_fresh_avatar_lies_upon_the_mesh_as_wide_as_it_is_sparse():
    method, theta = make(random=False), random_theta(small_head().layout, 2)
    gaussians = method.gaussians(theta)
    vertices = method.head(theta, method.identity)
    torch.testing.assert_close(gaussians.means, on_mesh(method, vertices))
    torch.testing.assert_close(gaussians.opacities, torch.full((1, COUNT), 0.1))
    assert bool((gaussians.colors == 0.5).all())
    rest = method.gaussians(torch.zeros(1, method.layout.size))
    distance = torch.cdist(rest.means[0].double(), rest.means[0].double())
    nearest = distance.sort(1).values[:, 1:4].square().mean(1).sqrt().float()
    torch.testing.assert_close(rest.scales[0], nearest[:, None].expand(-1, 3))


def test_rigid_head_motion_moves_gaussians_rigidly():
    method = make(dtype=DOUBLE)
    layout = method.layout
    still = random_theta(layout, 1, dtype=DOUBLE)
    still[:, layout.slice("rotation")] = 0
    moved, turn = still.clone(), torch.tensor([[0.3, -0.7, 0.2]], dtype=DOUBLE)
    moved[:, layout.slice("rotation")] = turn
    moved[:, layout.slice("translation")] += 0.1
    rotation = axis_angle_to_matrix(turn)[0]
    before, after = method.gaussians(still), method.gaussians(moved)
    vertices = [method.head(theta, method.identity)[0] for theta in (still, moved)]
    way = vertices[1][0] - rotation @ vertices[0][0]
    torch.testing.assert_close(after.means, before.means @ rotation.mT + way)
    torch.testing.assert_close(covariances(after), rotation @ covariances(before) @ rotation.mT)


def test_an_expression_moves_gaussians_with_their_places_and_along_normals():
    method = make(dtype=DOUBLE)
    theta = random_theta(method.layout, 3, dtype=DOUBLE)
    vertices = method.head(theta, method.identity)
    away = method.gaussians(theta).means - on_mesh(method, vertices)
    torch.testing.assert_close(away.norm(dim=-1), method.offset_m.abs().expand(3, -1))
    corners = vertices[:, method.head.faces[method.face_index]]
    first, second = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    normal = torch.nn.functional.normalize(torch.linalg.cross(first, second), dim=-1)
    outward = (away * normal).sum(-1) / method.offset_m
    assert outward.min() > 0.6


def test_a_scale_is_its_power_in_quarters_of_a_metre_as_its_triangle_grows():
    method = make(random=False, dtype=DOUBLE)
    with torch.no_grad():
        method.log_scale.fill_(math.log(0.01))
    theta = random_theta(method.layout, 1, dtype=DOUBLE)
    areas = []
    for pose in (theta, torch.zeros_like(theta)):
        corners = method.head(pose, method.identity)[0, method.head.faces[method.face_index]]
        sides = corners[:, 1:] - corners[:, :1]
        areas.append(torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1) / 2 * 16 + 1e-4)
    expected = 0.04 ** (areas[0] / areas[1]) / 4
    torch.testing.assert_close(method.gaussians(theta).scales[0, :, 1], expected)
    plain = make(random=False, area_changes_scale=False)
    scales = plain.gaussians(theta.float()).scales
    torch.testing.assert_close(scales, plain.log_scale.exp()[None])


@pytest.mark.parametrize("by_area", [True, False])
def test_places_are_uniform_within_triangles_and_drawn_by_area_or_by_number(by_area):
    # The second triangle is nine times as large as the first.
    small = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    count = 20_000
    index, places = random_places(torch.stack([small, 3 * small]), count, 0, by_area=by_area)
    share, spread = float((index == 1).float().mean()), math.sqrt(0.25 / count)
    assert share == pytest.approx(0.9 if by_area else 0.5, abs=5 * spread)
    torch.testing.assert_close(places.sum(1), torch.ones(count))
    assert places.min() >= 0
    # Of uniform places each coordinate has mean 1/3 and variance 1/18.
    torch.testing.assert_close(places.mean(0), torch.full((3,), 1 / 3), atol=0.01, rtol=0)
    torch.testing.assert_close(places.var(0), torch.full((3,), 1 / 18), atol=0.002, rtol=0)


def test_barycentric_changes_lead_along_ways_in_the_plane():
    generator = torch.Generator().manual_seed(0)
    corners = torch.randn(5, 3, 3, generator=generator, dtype=DOUBLE)
    way = torch.randn(5, 2, 3, generator=generator, dtype=DOUBLE)
    change = barycentric_change(corners, way)
    torch.testing.assert_close(change.sum(-1), torch.zeros(5, 2, dtype=DOUBLE))
    sides = corners[:, 1:] - corners[:, :1]
    normal = torch.nn.functional.normalize(torch.linalg.cross(sides[:, 0], sides[:, 1]), dim=-1)
    within = way - (way @ normal[..., None]) * normal[:, None]
    torch.testing.assert_close(change @ corners, within)
    assert not barycentric_change(corners[:, :1].expand(-1, 3, -1), way).any()


def test_gradients_reach_every_group_and_agree_with_finite_differences():
    method = make(dtype=DOUBLE, spike_from_m=1e-3, spike_ratio=1.5)
    with torch.no_grad():
        method.opacity_logit.add_(2)
    theta, camera = random_theta(method.layout, 2, dtype=DOUBLE), front_camera(20, DOUBLE)
    weights = torch.rand(2, 20, 20, 3, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)

    def loss() -> torch.Tensor:
        image = method.render(theta, camera, differentiable=True)
        gaussians = method.gaussians(theta, cameras=camera)
        drawn = DrawnBatch(theta, camera, gaussians, image.image, image.alpha)
        return (weights * image.image).sum() + 1e3 * total(method.penalty(drawn, 0))

    loss().backward()
    for name, (parameter,) in method.parameter_groups().items():
        gradient = parameter.grad
        assert gradient is not None, name
        place = int(gradient.abs().argmax())
        flat, step = parameter.data.view(-1), 1e-7
        flat[place] += step
        above = loss()
        flat[place] -= 2 * step
        below = loss()
        flat[place] += step
        found = (above - below).item() / (2 * step)
        assert found == pytest.approx(gradient.view(-1)[place].item(), rel=1e-4), name


def test_losses_are_the_releases():
    method, batch = make(), film(16)[0]
    drawn, filmed = compared(method, batch)
    losses = method.image_losses(drawn, filmed, 0)
    difference = drawn.image - filmed.target
    assert set(losses) == {"l1", "mse"}
    torch.testing.assert_close(losses["l1"], difference.abs().mean())
    torch.testing.assert_close(losses["mse"], 10 * difference.square().mean())
    other = make(dssim_weight=0.2)
    torch.testing.assert_close(
        other.image_losses(drawn, filmed, 0)["l1"], 0.8 * difference.abs().mean()
    )
    assert "dssim" in other.image_losses(drawn, filmed, 0)


def test_lpips_counts_where_it_is_asked_for_and_nowhere_that_nobody_filmed(monkeypatch):
    def lpips(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return (image.mean((1, 2)) - target.mean((1, 2))).square().sum()

    method, batch = make(dssim_weight=0.2, lpips_weight=0.01), film(24)[0]
    monkeypatch.setattr(method, "_lpips", lpips)
    drawn, filmed = compared(method, batch)
    image = drawn.image.detach().requires_grad_()
    unfilmed = torch.zeros_like(filmed.unfilmed)
    unfilmed[:, 12:] = True
    target = torch.where(unfilmed[..., None], image.detach(), filmed.target)
    filmed = dataclasses.replace(filmed, target=target, unfilmed=unfilmed)
    losses = method.image_losses(dataclasses.replace(drawn, image=image), filmed, 0)
    assert set(losses) == {"l1", "mse", "dssim", "lpips"}
    torch.testing.assert_close(losses["lpips"], 0.01 * lpips(image, target))
    total(losses).backward()
    assert image.grad is not None
    assert not image.grad[:, 12:].any()
    assert image.grad[:, :12].abs().max() > 0


def test_the_term_of_spikes_as_worked_by_hand():
    method = make(random=False)
    theta = torch.zeros(1, method.layout.size)
    with torch.no_grad():
        method.log_scale.fill_(math.log(1e-3))
        # Two spikes; the third is thick enough, the fourth too small.
        for row, (long, short) in enumerate(
            [(0.004, 1e-4), (0.006, 3e-4), (0.006, 8e-4), (0.0018, 1e-4)]
        ):
            method.log_scale[row, 0], method.log_scale[row, 1] = math.log(long), math.log(short)
    drawn, _ = compared(method, dataclasses.replace(film(16)[0], theta=theta))
    found = method.penalty(drawn, 0)
    assert found["spikes"].item() == pytest.approx(4 * (0.004 + 0.006) / 2, rel=1e-4)
    assert make(spike_weight=0.0).penalty(drawn, 0) == {}


def test_rates_are_the_releases_in_metres_and_those_of_places_fall():
    method = make(random=False)
    rates = method.learning_rates()
    assert (rates["place"], rates["offset"]) == pytest.approx((1.6e-4, 4e-5))
    assert set(rates) == set(method.parameter_groups())
    factor = [method.rate_factors(step) for step in (14_999, 29_999, 10**6)]
    assert [f["place"] for f in factor] == pytest.approx([0.1, 0.01, 0.01], rel=1e-3)
    assert all(f["offset"] == f["place"] and len(f) == 2 for f in factor)


def test_a_walk_leaves_places_where_they_were_but_in_the_triangles_that_they_reached():
    method, batches = make(walk_every=4), film()
    step = MethodStep(method)
    for number in range(3):
        step(batches[number], number)
    with torch.no_grad():
        inside = method.barycentric + method._change()
        kept = (inside >= 0).all(1)
    rest = method.head(torch.zeros(1, method.layout.size), method.identity)
    before, triangle = on_mesh(method, rest), method.face_index.clone()
    method._walk(step.optimizers)
    after = on_mesh(method, rest)
    assert 0 < int((~kept).sum()) < COUNT
    torch.testing.assert_close(after[:, kept], before[:, kept])
    assert torch.equal(method.face_index[kept], triangle[kept])
    assert (method.face_index != triangle).any()
    assert method.barycentric.min() >= 0
    assert not method.place.any()
    (optimizer,) = (o for o in step.optimizers if method.place in o.state)
    assert not optimizer.state[method.place]["exp_avg"].any()
    step(batches[3], 3)
    assert method.place.any()
    method.before_next_step(step.optimizers, 3, 0)
    assert not method.place.any()


def test_children_of_a_split_lie_around_their_parent_upon_the_surface():
    method = make()
    with torch.no_grad():
        method.log_scale.fill_(math.log(1e-5))
    chosen = torch.tensor([7, 40, 99])
    found = method._children(chosen, torch.randn(3, 2, 3))
    rest = method.head(torch.zeros(1, method.layout.size), method.identity)
    corners = rest[0, method.head.faces[found["face_index"]]]
    places = (corners * found["barycentric"][..., None]).sum(2)
    method._walk(method_optimizers(method))
    parents = on_mesh(method, rest)[0, chosen]
    away = (places - parents[:, None]).norm(dim=-1)
    assert 0 < away.max() < 1e-4
    assert not found["place"].any()


def test_density_control_fires_and_training_goes_on():
    method, batches, told = make(density=BUSY, walk_every=3), film(), []
    step = MethodStep(method, logged=lambda number, figures: told.append((number, dict(figures))))
    for number in range(7):
        losses = step(batches[number % 4], number)
        assert all(bool(torch.isfinite(loss)) for loss in losses.values())
    assert [number for number, _ in told] == [1, 3, 5]
    assert sum(figures["split"] for _, figures in told) > 0
    assert method.num_gaussians == told[-1][1]["count"] > COUNT
    for optimizer in step.optimizers:
        for parameter, state in optimizer.state.items():
            assert state["exp_avg"].shape == parameter.shape
            assert len(parameter) == method.num_gaussians


def test_stored_and_loaded_it_draws_the_same_after_its_number_has_changed(tmp_path):
    method, batches = make(density=BUSY, walk_every=3), film()
    step = MethodStep(method)
    for number in range(4):
        step(batches[number % 4], number)
    assert method.num_gaussians != COUNT
    method.save(tmp_path / "avatar")
    loaded = SplattingAvatar.load(tmp_path / "avatar")
    assert loaded.config == method.config
    theta, camera = random_theta(method.layout, 2, seed=5), front_camera()
    first, second = (m.render(theta, camera).image for m in (method, loaded))
    assert torch.equal(first, second)
    with pytest.raises(UserError, match=r"splattingavatar-style.*gaussianavatars-style is needed"):
        GaussianAvatars.load(tmp_path / "avatar")


def test_places_outside_of_the_head_are_told(tmp_path):
    method = make()
    method.face_index[3] = len(method.head.faces)
    method.save(tmp_path / "avatar")
    with pytest.raises(UserError, match="outside of the head's triangles"):
        SplattingAvatar.load(tmp_path / "avatar")


def trained(seed: int, steps: int) -> tuple[SplattingAvatar, list[float]]:
    """A fresh avatar after so many steps, and the loss of each."""
    density = dataclasses.replace(BUSY, every=5, until_step=12)
    method = make(random=False, seed=seed, density=density, walk_every=4)
    step, batches = MethodStep(method, seed=seed), film()
    return method, [float(total(step(batches[n % 4], n))) for n in range(steps)]


def test_training_is_a_function_of_seed_and_steps():
    first, second, third = (trained(seed, 12)[0] for seed in (1, 1, 2))
    assert first.num_gaussians > COUNT
    assert all(map(torch.equal, first.buffers(), second.buffers()))
    assert all(map(torch.equal, first.parameters(), second.parameters()))
    assert not torch.equal(first.barycentric[:100], third.barycentric[:100])


def test_training_lowers_the_loss():
    _, losses = trained(0, 150)
    assert sum(losses[-8:]) < 0.6 * sum(losses[:8])
