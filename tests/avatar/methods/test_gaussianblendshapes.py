import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.method import DrawnBatch, FilmedBatch
from rgbavatar_ns.avatar.methods.density import DensityControl
from rgbavatar_ns.avatar.methods.gaussianblendshapes import (
    GaussianBlendshapes,
    GaussianBlendshapesConfig,
)
from rgbavatar_ns.avatar.methods.neighbours import neighbour_distance
from rgbavatar_ns.avatar.storage.stored_avatar import StoredAvatar
from rgbavatar_ns.avatar.training import TrainingBatch
from rgbavatar_ns.avatar.training.method_step import MethodStep
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, quat_wxyz_to_matrix
from rgbavatar_ns.kernels import GaussianSet
from tests.avatar.small_head import (
    SIDE,
    front_camera,
    random_theta,
    small_head_arrays,
    small_identity,
)

DOUBLE = torch.float64
SIZE, POINTS = 24, 60
NOTHING = DensityControl(from_step=10**6, reset_every=0)
SMALL = GaussianBlendshapesConfig(num_points=POINTS, density=NOTHING)
AMOUNTS = {
    "position": 3e-3,
    "rotation_wxyz": 0.4,
    "log_scale": 0.3,
    "opacity_logit": 2.0,
    "color": 1.0,
    "color_rest": 0.3,
    "basis_position": 3e-3,
    "basis_rotation_wxyz": 0.3,
    "basis_log_scale": 0.3,
    "basis_opacity_logit": 1.0,
    "basis_color": 0.5,
}


def arrays(**changes):
    """The small head with eyelids and two rows of teeth, a patch of its sheet each."""
    base = small_head_arrays()
    patch = np.array([[row * SIDE + column for column in (3, 4, 5)] for row in range(SIDE)])
    groups = {"lower_teeth": patch[2:4].ravel(), "upper_teeth": patch[5:7].ravel()}
    eyelids = 0.01 * np.random.default_rng(3).normal(size=(len(base.v_template), 3, 2))
    values = {"eyelid_dirs": np.float32(eyelids), "vertex_groups": groups} | changes
    return replace(base, **values)


def make(config=SMALL, *, random: bool = False, dtype=torch.float32, seed: int = 0, **changes):
    head = HeadModel(arrays(**changes)).to(dtype)
    avatar = GaussianBlendshapes(head, small_identity(dtype), config, seed=seed).to(dtype)
    if random:
        generator = torch.Generator().manual_seed(5)
        with torch.no_grad():
            for name, parameters in avatar.parameter_groups().items():
                for parameter in parameters:
                    noise = torch.randn(parameter.shape, generator=generator, dtype=DOUBLE)
                    parameter.add_((AMOUNTS[name] * noise).to(dtype))
    return avatar


def covariances(gaussians: GaussianSet) -> torch.Tensor:
    spread = quat_wxyz_to_matrix(gaussians.quats_wxyz) * gaussians.scales[..., None, :]
    return spread @ spread.mT


def batch(frames: int = 2, size: int = SIZE) -> TrainingBatch:
    """Pictures of another avatar of this method."""
    teacher = make(random=True, seed=9)
    theta, camera = random_theta(teacher.layout, frames), front_camera(size)
    drawn = teacher.render(theta, camera)
    straight = drawn.image / drawn.alpha.clamp(min=1e-3)
    rgba = torch.cat([straight.clamp(0, 1), drawn.alpha.clamp(0, 1)], -1)
    return TrainingBatch(theta, camera, (255 * rgba).round().to(torch.uint8))


def test_the_whole_head_moves_gaussians_and_what_they_show_rigidly():
    avatar = make(random=True, dtype=DOUBLE)
    avatar.shown_degree.fill_(3)
    theta = random_theta(avatar.layout, 2, dtype=DOUBLE)
    # Where bones differ, the blend's quaternion is only near that of the nearest rotation.
    for name in ("rotation", "neck", "jaw", "left_eye", "right_eye"):
        theta[:, avatar.layout.slice(name)] = 0
    moved = theta.clone()
    axis_angle = torch.tensor([0.3, -0.8, 0.4], dtype=DOUBLE)
    moved[:, avatar.layout.slice("rotation")] = axis_angle
    moved[:, avatar.layout.slice("translation")] += torch.tensor([0.1, 0.2, -0.1], dtype=DOUBLE)
    turn = axis_angle_to_matrix(axis_angle)
    meshes = [avatar.head(t, avatar.identity) for t in (theta, moved)]
    shift = (meshes[1] - meshes[0] @ turn.T).mean(1, keepdim=True)
    camera = front_camera(dtype=DOUBLE)
    pose = camera.world_to_camera.repeat(2, 1, 1)
    after = pose.clone()
    after[:, :3, :3] = pose[:, :3, :3] @ turn.T
    after[:, :3, 3:] = pose[:, :3, 3:] - after[:, :3, :3] @ shift.mT
    camera = replace(
        camera,
        world_to_camera=pose,
        focal_px=camera.focal_px.repeat(2, 1),
        principal_point_px=camera.principal_point_px.repeat(2, 1),
    )
    first = avatar.gaussians(theta, cameras=camera)
    second = avatar.gaussians(moved, cameras=replace(camera, world_to_camera=after))
    torch.testing.assert_close(second.means, first.means @ turn.T + shift)
    torch.testing.assert_close(covariances(second), turn @ covariances(first) @ turn.T)
    torch.testing.assert_close(second.colors, first.colors)
    assert (avatar.gaussians(moved, cameras=camera).colors - first.colors).abs().max() > 0.01


def test_unlearned_gaussians_stay_where_they_lie_on_the_mesh():
    """Expressions, eyelids, correctives and bones; all points have one blend of these here."""
    shares = np.tile(np.float32([0, 0.4, 0.3, 0.1, 0.2]), (SIDE**2, 1))
    avatar = make(dtype=DOUBLE, skinning_weights=shares, vertex_groups={})
    rest = avatar.head(torch.zeros(avatar.layout.size, dtype=DOUBLE), avatar.identity)
    theta = random_theta(avatar.layout, 3, seed=4, dtype=DOUBLE)
    start = avatar.gaussians(torch.zeros(1, avatar.layout.size, dtype=DOUBLE)).means[0]
    # Where each lies at rest, by trying all triangles.
    corners = rest[avatar.head.faces]
    system = torch.cat([corners.mT, corners.new_ones(len(corners), 1, 3)], 1)
    wanted = torch.cat([start, start.new_ones(len(start), 1)], 1).mT
    solved = torch.linalg.lstsq(system, wanted.expand(len(corners), 4, -1)).solution
    misfit = (system @ solved - wanted).norm(dim=1)
    misfit[(solved < -1e-6).any(1)] = torch.inf
    best = misfit.argmin(0)
    assert misfit.amin(0).max() < 1e-7
    weights = solved.mT[best, torch.arange(len(start))]
    mesh = avatar.head(theta, avatar.identity)[:, avatar.head.faces[best]]
    means = avatar.gaussians(theta).means
    torch.testing.assert_close(means, (mesh * weights[..., None]).sum(2), atol=1e-7, rtol=0)
    assert (means - start).norm(dim=-1).amax(1).min() > 5e-3


def test_gaussians_begin_grey_and_as_large_as_their_distance():
    avatar = make()
    start = avatar.face.position.detach()
    torch.testing.assert_close(avatar.face.log_scale[:, 1].exp(), neighbour_distance(start))
    found = avatar.gaussians(torch.zeros(1, avatar.layout.size), cameras=front_camera())
    assert found.colors.unique().tolist() == [0.5]
    torch.testing.assert_close(found.opacities, torch.full_like(found.opacities, 0.1))


def test_an_expression_turns_what_lies_on_the_turned_mesh():
    """An expression that turns the sheet by 20 degrees about x turns Gaussians so, others not."""
    base = arrays()
    directions = base.shapedirs.copy()
    turn = axis_angle_to_matrix(torch.tensor([math.radians(20), 0, 0])).numpy()
    directions[..., base.num_identity] = base.v_template @ turn.T - base.v_template
    directions[..., : base.num_identity] = 0
    avatar = make(shapedirs=directions)
    theta = torch.zeros(1, avatar.layout.size)
    theta[0, 0] = 1
    quats = avatar.gaussians(theta).quats_wxyz[0]
    found = quat_wxyz_to_matrix(quats[:POINTS])
    torch.testing.assert_close(
        found, torch.from_numpy(turn).expand(POINTS, 3, 3), atol=1e-4, rtol=0
    )
    still = torch.eye(3).expand(len(quats) - POINTS, 3, 3)
    torch.testing.assert_close(quat_wxyz_to_matrix(quats[POINTS:]), still)


def test_teeth_move_rigidly_with_head_or_jaw_and_with_no_expression():
    avatar = make()
    rest = torch.zeros(1, avatar.layout.size)
    theta = rest.clone()
    start = avatar.gaussians(rest).means[0, POINTS:]
    upper, lower = start.chunk(2)
    assert upper[:, 1].min() > lower[:, 1].max()
    theta[:, avatar.layout.slice("expression")] = 1
    torch.testing.assert_close(avatar.gaussians(theta).means[0, POINTS:], start)
    theta[:, avatar.layout.slice("jaw")] = torch.tensor([0.3, 0, 0])
    upper_after, lower_after = avatar.gaussians(theta).means[0, POINTS:].chunk(2)
    torch.testing.assert_close(upper_after, upper)
    torch.testing.assert_close(torch.pdist(lower_after), torch.pdist(lower))
    assert (lower_after - lower).norm(dim=1).min() > 1e-3


def test_residuals_count_as_much_as_the_mask_lets_through():
    """Three expressions move all points by 10, 2 and 0 mm: masks 1, (2 - .2) / (10 - .2) and 0."""
    base = arrays()
    directions = np.zeros_like(base.shapedirs)
    first = base.num_identity
    directions[:, 2, first], directions[:, 0, first + 1] = 0.01, 0.002
    config = replace(SMALL, sh_degree=1, num_bases=3)
    avatar = make(config, dtype=DOUBLE, shapedirs=directions)
    bases, N = avatar.face.bases, POINTS
    torch.testing.assert_close(
        bases.mask, torch.tensor([1, 1.8 / 9.8], dtype=DOUBLE).expand(N, 2), atol=1e-6, rtol=0
    )
    for parameter in bases.parameters():
        torch.nn.init.constant_(parameter, 0.1)
    avatar.shown_degree.fill_(1)
    theta = torch.zeros(2, avatar.layout.size, dtype=DOUBLE)
    theta[1, :4] = torch.tensor([0.5, 2.0, 7.0, 0.0])
    still, found = (avatar.gaussians(t[None], cameras=front_camera(dtype=DOUBLE)) for t in theta)
    weight = 0.1 * (0.5 + 2.0 * 1.8 / 9.8)
    moved = torch.tensor([2 * 0.002, 0, 0.5 * 0.01], dtype=DOUBLE) + weight
    face = np.s_[:, :N]
    torch.testing.assert_close(
        found.means[face] - still.means[face], moved.expand(1, N, 3), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(found.scales[face], still.scales[face] * math.exp(weight))
    logit = math.log(0.1 / 0.9) + weight
    torch.testing.assert_close(
        found.opacities[face], torch.full((1, N), 1 / (1 + math.exp(-logit)), dtype=DOUBLE)
    )
    quat = torch.tensor([1 + weight, weight, weight, weight], dtype=DOUBLE)
    torch.testing.assert_close(found.quats_wxyz[face], quat.expand(1, N, 4), atol=1e-6, rtol=0)
    camera = torch.tensor([0, 0, 0.5], dtype=DOUBLE)
    x, y, z = torch.nn.functional.normalize(found.means[0, :N] - camera, dim=-1).unbind(-1)
    shown = 0.5 + weight * (0.28209479 + 0.48860251 * (z - y - x))
    torch.testing.assert_close(found.colors[0, :N], shown[:, None].expand(N, 3), atol=1e-6, rtol=0)


def test_bases_beyond_the_configured_number_learn_nothing_but_move():
    avatar = make(replace(SMALL, num_bases=1))
    assert avatar.face.bases.chosen.unique().tolist() == [0]
    theta = torch.zeros(2, avatar.layout.size)
    theta[1, 3] = 1
    moved = avatar.gaussians(theta).means
    assert (moved[1] - moved[0]).norm(dim=-1).max() > 1e-3


def test_colours_are_without_direction_where_no_camera_is_named():
    avatar = make(random=True)
    avatar.shown_degree.fill_(3)
    theta = random_theta(avatar.layout, 2)
    mean = avatar.gaussians(theta).colors
    avatar.shown_degree.fill_(0)
    torch.testing.assert_close(avatar.gaussians(theta, cameras=front_camera()).colors, mean)


def filmed_and_drawn(color: float, target: float, alpha: float, matte: float):
    avatar = make()
    theta, shape = torch.zeros(1, avatar.layout.size), (1, 16, 16)
    unfilmed = torch.zeros(shape, dtype=torch.bool)
    image = torch.full((*shape, 3), color).requires_grad_()
    opacity = torch.full((*shape, 1), alpha).requires_grad_()
    drawn = DrawnBatch(theta, front_camera(16), avatar.gaussians(theta), image, opacity)
    filmed = FilmedBatch(
        torch.zeros(*shape, 4),
        torch.zeros(1, 3),
        torch.full((*shape, 3), target),
        torch.full((*shape, 1), matte),
        unfilmed,
    )
    return avatar, drawn, filmed


def test_the_loss_is_that_of_the_table_by_hand():
    avatar, drawn, filmed = filmed_and_drawn(0.5, 0.25, 0.7, 1.0)
    losses = avatar.image_losses(drawn, filmed, 0)
    # Of constant pictures SSIM compares means alone.
    ssim = (2 * 0.5 * 0.25 + 1e-4) / (0.5**2 + 0.25**2 + 1e-4)
    wanted = {"l1": 0.8 * 0.25, "dssim": 0.2 * (1 - ssim), "coverage": 10 * 0.3**2}
    assert {name: loss.item() for name, loss in losses.items()} == pytest.approx(wanted, rel=1e-3)


def test_pictures_below_a_window_of_dssim_are_trained_on_without_it():
    step = MethodStep(make(replace(SMALL, dssim_weight=0.0)))
    assert step(batch(size=8), 0).keys() == {"l1", "coverage", "mouth"}


def test_what_nobody_filmed_has_no_gradient():
    avatar, drawn, filmed = filmed_and_drawn(0.5, 0.25, 0.7, 1.0)
    filmed.unfilmed[:, :, 8:] = True
    filmed.target[:, :, 8:] = 0.5
    torch.stack(list(avatar.image_losses(drawn, filmed, 0).values())).sum().backward()
    for part in (drawn.image.grad, drawn.alpha.grad):
        assert part is not None
        assert (part[:, :, 8:] == 0).all()
        assert (part[:, :, :8] != 0).all()


def test_teeth_outside_of_the_mouths_cylinder_cost_a_hundred_times_the_squared_distance():
    avatar = make()
    _, drawn, _ = filmed_and_drawn(0.0, 0.0, 0.0, 0.0)
    assert avatar.penalty(drawn, 0)["mouth"].item() == pytest.approx(0, abs=1e-9)
    teeth, half = avatar.teeth, avatar.teeth.rows.count // 2
    # 20 mm above the teeth in one row, 30 mm to the left of the cylinder in the other.
    high = avatar.mouth_centre[1] + avatar.mouth_half_height_m
    with torch.no_grad():
        teeth.position[0] = avatar.mouth_centre
        teeth.position[0, 1] = high + 0.02
        teeth.position[half] = avatar.mouth_centre
        teeth.position[half, 0] += avatar.mouth_radius_m + 0.03
    wanted = 100 * (0.02**2 + 0.03**2) / half
    assert avatar.penalty(drawn, 0)["mouth"].item() == pytest.approx(wanted, rel=1e-4)


def test_a_head_without_teeth_has_no_term_of_the_mouth():
    avatar = make(vertex_groups={})
    assert avatar.num_gaussians == POINTS
    assert avatar.penalty(filmed_and_drawn(0.0, 0.0, 0.0, 0.0)[1], 0) == {}


def test_the_degree_grows_every_thousand_steps_and_positions_slow_down():
    avatar = make()
    degrees = []
    for step in range(4500):
        avatar.after_step(None, [], step, 0)
        degrees.append(int(avatar.shown_degree))
    assert [degrees.index(degree) for degree in (1, 2, 3)] == [999, 1999, 2999]
    assert max(degrees) == 3
    assert avatar.rate_factors(15_000)["position"] == pytest.approx(0.1)
    assert avatar.rate_factors(60_000)["position"] == pytest.approx(0.01)


def test_gradients_of_every_group_agree_with_differences():
    avatar = make(random=True, dtype=DOUBLE)
    avatar.shown_degree.fill_(3)
    theta, camera = random_theta(avatar.layout, 2, dtype=DOUBLE), front_camera(dtype=DOUBLE)
    groups, rates = avatar.parameter_groups(), avatar.learning_rates()
    assert groups.keys() == rates.keys()
    assert sum(map(len, groups.values())) == len(list(avatar.parameters()))

    def value(given: torch.Tensor) -> torch.Tensor:
        parts = vars(avatar.gaussians(given, cameras=camera)).values()
        return sum(((k + 1) * part).sin().mean() for k, part in enumerate(parts))

    theta.requires_grad_()
    value(theta).backward()
    generator = torch.Generator().manual_seed(2)
    tensors = {name: parameters[0] for name, parameters in groups.items()} | {"theta": theta}
    tensors |= {
        f"teeth {name}": avatar.teeth.get_parameter(name) for name in ("position", "color_rest")
    }
    for name, tensor in tensors.items():
        assert tensor.grad is not None, name
        direction = torch.randn(tensor.shape, generator=generator, dtype=DOUBLE)
        with torch.no_grad():
            sides = []
            for sign in (1, -2):
                tensor += sign * 1e-6 * direction
                sides.append(value(theta))
            tensor += 1e-6 * direction
        slope = float(sides[0] - sides[1]) / 2e-6
        assert float((tensor.grad * direction).sum()) == pytest.approx(slope, rel=1e-4), name
        assert abs(slope) > 0, name


DENSE = DensityControl(from_step=0, every=2, reset_every=0, gradient_threshold=1e-9)


@pytest.mark.parametrize("grows", ["face", "teeth"])
def test_density_control_of_face_and_teeth_has_its_own_threshold(grows):
    face, teeth = (1e-9, 1e3) if grows == "face" else (1e3, 1e-9)
    config = replace(
        SMALL, density=replace(DENSE, gradient_threshold=face), teeth_gradient_threshold=teeth
    )
    avatar = make(config)
    told: list[dict[str, float]] = []
    step = MethodStep(avatar, logged=lambda _, figures: told.append(dict(figures)))
    before = [part.rows.count for part in (avatar.face, avatar.teeth)]
    frames = batch()
    for number in range(5):
        losses = step(frames, number)
    after = [part.rows.count for part in (avatar.face, avatar.teeth)]
    assert [a > b for a, b in zip(after, before)] == [grows == "face", grows == "teeth"]
    assert told[-1] == {"face_gaussians": after[0], "teeth_gaussians": after[1]}
    assert avatar.num_gaussians == sum(after)
    assert all(bool(loss.isfinite()) for loss in losses.values())
    for optimizer in step.optimizers:
        for parameter, state in optimizer.state.items():
            assert state["exp_avg"].shape == parameter.shape
    # A clone takes along what the head model does to its original.
    theta = random_theta(avatar.layout, 1, seed=8)
    assert avatar.gaussians(theta).means.shape == (1, sum(after), 3)


def test_keeping_gaussians_of_triangles_is_refused_before_training():
    with pytest.raises(UserError, match=r"lie on no triangle\. Leave it out"):
        replace(SMALL, density=replace(DENSE, keep_one_per_face=True))


def test_the_teeths_threshold_has_the_faces_range():
    with pytest.raises(UserError, match="--teeth-gradient-threshold is 0"):
        replace(SMALL, teeth_gradient_threshold=0.0)
    assert replace(SMALL, teeth_gradient_threshold=1e-9).teeth_gradient_threshold == 1e-9


def test_a_bundle_gives_the_same_picture_after_the_number_changed(tmp_path):
    config = replace(SMALL, density=DENSE, sh_degree_every=2)
    avatar, frames = make(config), batch()
    step = MethodStep(avatar)
    for number in range(4):
        step(frames, number)
    assert avatar.num_gaussians > POINTS + 2 * (POINTS // 10)
    avatar.save(tmp_path / "bundle")
    loaded = GaussianBlendshapes.load(tmp_path / "bundle")
    assert loaded.config == config
    assert int(loaded.shown_degree) == 2
    first, second = (a.render(frames.theta, frames.cameras).image for a in (avatar, loaded))
    assert torch.equal(first, second)
    with pytest.raises(UserError, match="gaussianblendshapes-style, and rgbavatar"):
        Avatar.load(tmp_path / "bundle")


def test_files_of_another_degree_or_with_missing_rows_are_refused(tmp_path):
    avatar = make(random=True)
    state, parameters = avatar.to_state(), avatar.own_state_dict()
    other = make(replace(SMALL, sh_degree=1))
    layout = avatar.layout.to_json()
    wrong = StoredAvatar(tmp_path, other.to_state(), parameters, layout)
    with pytest.raises(UserError, match="color_rest"):
        GaussianBlendshapes.of_stored(wrong)
    parameters["face.bases.chosen"] = parameters["face.bases.chosen"] + 99
    with pytest.raises(UserError, match="an expression that the head does not have"):
        GaussianBlendshapes.of_stored(StoredAvatar(tmp_path, state, parameters, layout))
    del parameters["face.color"]
    with pytest.raises(UserError, match="no Gaussians' color"):
        GaussianBlendshapes.of_stored(StoredAvatar(tmp_path, state, parameters, layout))


def trained(steps: int, seed: int = 0) -> tuple[GaussianBlendshapes, list[float]]:
    avatar, frames = make(replace(SMALL, density=replace(DENSE, until_step=6)), seed=seed), batch()
    step, losses = MethodStep(avatar, seed=seed), []
    for number in range(steps):
        found = step(frames, number)
        losses.append(float(sum(found.values())))
    return avatar, losses


def test_training_lowers_the_loss_and_is_the_same_for_a_seed():
    avatar, losses = trained(40)
    again, same = trained(40)
    assert np.mean(losses[-5:]) < 0.6 * losses[0]
    assert losses == same
    assert all(map(torch.equal, avatar.parameters(), again.parameters()))
    other = make(seed=1)
    assert not torch.equal(other.face.position, make().face.position)
