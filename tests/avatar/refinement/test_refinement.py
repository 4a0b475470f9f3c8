"""Corrections to tracked theta: their steps, bounds and gauge, and what they find."""

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar.model.image_loss import l1_loss
from rgbavatar_ns.avatar.refinement import FrameRefinement, RefinementConfig, TrackingRefinement
from rgbavatar_ns.avatar.refinement.calibration import fit_ridge
from rgbavatar_ns.avatar.training.theta_fit import fit_theta, frame_gradients
from rgbavatar_ns.drawing.compositing import composite, rgba_to_float
from rgbavatar_ns.head import ThetaField, ThetaLayout
from tests.avatar.fused_scene import far_batch, stir
from tests.avatar.small_head import front_camera, random_theta

LAYOUT = ThetaLayout(
    (
        ThetaField("expression", 3, "linear"),
        ThetaField("rotation", 3, "axis_angle"),
        ThetaField("jaw", 3, "axis_angle"),
        ThetaField("translation", 3, "translation"),
    )
)
CONFIG = RefinementConfig(
    rotation_sigma_rad=0.02,
    joint_sigma_rad=0.03,
    translation_sigma_m=0.004,
    expression_sigma=0.05,
    learning_rate=0.21,
    prior_weight=0.0,
)


def _tracked(frames: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(frames, LAYOUT.size, generator=torch.Generator().manual_seed(seed))


def _refinement(frames: int = 6, **options) -> TrackingRefinement:
    return TrackingRefinement(_tracked(frames), LAYOUT, CONFIG, **options)


def test_first_step_by_hand():
    """Adam's first step is the rate times the gradient over its size, which a field shares.

    The rate is .21 / (1 + 1/20) = .2 standard deviations; of the jaw's gradient (3, 4, 0) the
    root mean square is 5 / sqrt(3).
    """
    refinement = _refinement(centered=False)
    gradient = torch.zeros(2, LAYOUT.size)
    gradient[0, LAYOUT.slice("jaw")] = torch.tensor([3.0, 4.0, 0.0])
    gradient[1, LAYOUT.slice("translation")] = torch.tensor([0.0, -1e-2, 0.0])
    refinement.step(torch.tensor([4, 1]), gradient)
    moved = refinement.theta() - refinement.tracked
    size = 0.2 * np.sqrt(3)
    expected = torch.zeros_like(moved)
    expected[4, LAYOUT.slice("jaw")] = -0.03 * size * torch.tensor([0.6, 0.8, 0.0])
    expected[1, LAYOUT.slice("translation")] = 0.004 * size * torch.tensor([0.0, 1.0, 0.0])
    torch.testing.assert_close(moved, expected, rtol=1e-4, atol=1e-7)
    assert refinement.visits.tolist() == [0, 1, 0, 0, 1, 0]


def test_frames_do_not_disturb_one_another():
    """What happens to a frame is the same whether others are corrected between or not."""
    both, alone = _refinement(centered=False), _refinement(centered=False)
    generator = torch.Generator().manual_seed(1)
    for _ in range(5):
        gradient = torch.randn(2, LAYOUT.size, generator=generator)
        both.step(torch.tensor([2]), gradient[:1])
        both.step(torch.tensor([5]), gradient[1:])
        alone.step(torch.tensor([2]), gradient[:1])
    assert torch.equal(both.theta()[2], alone.theta()[2])
    assert not bool(alone.correction[5].any())


def test_the_mean_correction_is_zero():
    refinement = _refinement()
    for step in range(7):
        gradient = torch.ones(3, LAYOUT.size)
        refinement.step(torch.tensor([step % 6, (step + 1) % 6, (step + 2) % 6]), gradient)
    assert bool(refinement.correction.any())
    assert refinement.correction.mean(0).abs().max() < 1e-6


def test_what_the_tracker_leaves_constant_stays_and_linear_fields_keep_their_range():
    tracked = _tracked(6)
    tracked[:, LAYOUT.slice("jaw").start + 1] = 0.3
    refinement = TrackingRefinement(tracked, LAYOUT, CONFIG, centered=False)
    refinement.correction += 100.0
    refinement.step(torch.arange(6), -torch.ones(6, LAYOUT.size))
    moved = refinement.theta() - tracked
    assert not bool(moved[:, LAYOUT.slice("jaw").start + 1].any())
    assert (moved[:, LAYOUT.slice("rotation")] > 0.02).all()
    expression = LAYOUT.slice("expression")
    top = tracked[:, expression].amax(0).expand(6, -1)
    torch.testing.assert_close(refinement.theta()[:, expression], top)


def test_the_prior_pulls_back():
    refinement = TrackingRefinement(
        _tracked(4), LAYOUT, RefinementConfig(learning_rate=0.02, prior_weight=0.1), centered=False
    )
    refinement.correction += 0.5
    for _ in range(200):
        refinement.step(torch.arange(4), torch.zeros(4, LAYOUT.size))
    assert refinement.correction.abs().max() < 0.1


def test_state_goes_on_to_the_bit():
    first, second = _refinement(), _refinement()
    generator = torch.Generator().manual_seed(2)
    for step in range(6):
        if step == 3:
            second.load_state_dict(first.state_dict())
        gradient = torch.randn(2, LAYOUT.size, generator=generator)
        rows = torch.tensor([step % 6, (step + 2) % 6])
        first.step(rows, gradient)
        if step >= 3:
            second.step(rows, gradient)
    assert torch.equal(first.theta(), second.theta())


def test_ridge_against_numpy_and_nothing_from_noise():
    """A law is found, as least squares with a ridge finds it; chance gives the zero map."""
    rng = np.random.default_rng(0)
    inputs = rng.standard_normal((100, 4))
    law = rng.standard_normal((4, 2))
    outputs = inputs @ law + 1e-3 * rng.standard_normal((100, 2))
    noise = rng.standard_normal((100, 3))
    found = fit_ridge(torch.from_numpy(inputs), torch.from_numpy(np.hstack([outputs, noise])))
    ridge = 0.3  # the smallest that is tried: .003 a frame
    normal = inputs.T @ inputs + ridge * np.eye(4)
    np.testing.assert_allclose(found[:, :2], np.linalg.solve(normal, inputs.T @ outputs), rtol=1e-9)
    assert (found[:, 2:] == 0).all()


def test_what_predicts_no_better_than_chance_is_left_alone():
    """In sixty frames some of forty inputs seem to tell of an output that has nothing to do with
    them."""
    rng = np.random.default_rng(3)
    inputs, outputs = (torch.from_numpy(rng.standard_normal((60, n))) for n in (40, 200))
    left_alone = (fit_ridge(inputs, outputs) == 0).all(0)
    assert left_alone.double().mean() > 0.9


def test_calibration_knows_what_every_frame_has_wrong():
    """Truth is .9 of what is tracked: new frames are corrected as the known ones were."""
    refinement = TrackingRefinement(_tracked(80), LAYOUT, CONFIG)
    refinement.correction.copy_(-0.1 * refinement.tracked / refinement._sigma)
    refinement.correction.sub_(refinement.correction.mean(0))
    new = _tracked(20, seed=9)
    wrong = new - refinement.calibrated(new)
    expected = 0.1 * (new - refinement.tracked.mean(0))
    assert (wrong - expected).square().mean() < 0.01 * expected.square().mean()


def test_what_hardly_moved_tells_nothing_once_it_moves():
    """Else a blink that the film has not would be a thousand of its widths away."""
    tracked, noise = _tracked(80), torch.Generator().manual_seed(3)
    still = LAYOUT.slice("expression").start
    tracked[:, still] = 1e-5 * torch.rand(80, generator=noise)
    refinement = TrackingRefinement(tracked, LAYOUT, CONFIG)
    errors = -0.1 * tracked / refinement._sigma
    refinement.correction.copy_(errors + 0.1 * torch.randn(errors.shape, generator=noise))
    refinement.correction.sub_(refinement.correction.mean(0))
    new = _tracked(20, seed=9)
    new[:, still] = 0
    before = refinement.calibrated(new)
    new[:, still] = 0.7
    moved = (refinement.calibrated(new) - before) / refinement._sigma
    moved[:, still] = 0
    assert moved.abs().max() < 0.2


def test_calibration_learns_nothing_from_what_bounds_cut_off():
    """An expression at rest that is pushed further down stays, and so do new frames at rest."""
    tracked = _tracked(80)
    column = LAYOUT.slice("expression").start
    tracked[:, column] = (torch.arange(80) % 3 == 0).float()
    refinement = TrackingRefinement(tracked, LAYOUT, CONFIG)
    refinement.correction[:, column] = torch.where(tracked[:, column] > 0, 0.0, -2.0)
    assert torch.equal(refinement.theta(), tracked)
    assert torch.equal(refinement.calibrated(tracked), tracked)


def test_without_corrections_calibration_changes_nothing():
    new = _tracked(3, seed=9)
    assert torch.equal(_refinement().calibrated(new), new)


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_each_frame_has_the_gradient_of_its_own_loss(make_avatar, backend):
    """As from autograd for that frame alone, whatever else is in the batch."""
    avatar = stir(make_avatar())
    batch, background = far_batch(avatar, 3, cameras=3)
    found = frame_gradients(
        avatar, batch.theta, batch.cameras, batch.images_rgba, background, backend
    )
    assert all(parameter.grad is None for parameter in avatar.parameters())
    for i in range(3):
        theta = batch.theta[[i]].requires_grad_()
        camera = batch.cameras.select([i])
        image = avatar.render(
            theta, camera, background[[i]], backend="reference", differentiable=True
        ).image
        target = composite(rgba_to_float(batch.images_rgba[[i]]), background[[i]])
        l1_loss(image, target).backward()
        # A pair of pixel and Gaussian at the cut of 1/255 may belong to one way alone.
        assert theta.grad is not None
        assert (found[i] - theta.grad[0]).norm() < 2e-3 * theta.grad.norm()


def test_a_batchs_first_frames_learn_by_the_gradients_of_their_own_losses():
    tracked, position = _tracked(6), torch.tensor([4, 1, 2])
    refinement = FrameRefinement(tracked, range(6), LAYOUT, CONFIG)
    target = torch.linspace(0, 1, LAYOUT.size)

    def take(step: int) -> None:
        theta = refinement.begin(tracked[position], position)
        (theta - target).square().sum(1).mean().backward()
        refinement.learn(step, theta, position[:2])

    take(CONFIG.start_step - 1)
    assert not refinement.frames.visits.any()
    take(CONFIG.start_step)
    assert refinement.frames.visits.tolist() == [0, 1, 0, 0, 1, 0]
    alone = TrackingRefinement(tracked, LAYOUT, CONFIG)
    alone.step(position[:2], 2 * (tracked[position[:2]] - target))
    torch.testing.assert_close(refinement.frames.theta(), alone.theta())


def test_refined_tracking_needs_to_know_which_frames_a_batch_has():
    refinement = FrameRefinement(_tracked(6), range(6), LAYOUT, CONFIG)
    with pytest.raises(ValueError, match="the frames' positions"):
        refinement.begin(_tracked(2), None)


def test_a_frozen_avatar_finds_the_theta_of_its_own_pictures(make_avatar):
    avatar = stir(make_avatar())
    before = {name: value.clone() for name, value in avatar.state_dict().items()}
    truth = random_theta(avatar.layout, 6)
    camera = front_camera(40)
    with torch.no_grad():
        drawn = avatar.render(truth, camera)
    straight = drawn.image / drawn.alpha.clamp(min=1e-3)
    rgba = torch.cat([straight, drawn.alpha], -1).clamp(0, 1)
    images = (255 * rgba).round().to(torch.uint8)
    turn = avatar.layout.slice("rotation")
    tracked = truth.clone()
    tracked[:, turn] += 0.02 * torch.tensor([[1.0, -1.0, 0.0], [0.0, 1.0, 1.0]]).repeat(3, 1)
    config = RefinementConfig(rotation_sigma_rad=0.02, prior_weight=0.0)
    found = fit_theta(avatar, tracked, camera, images, 40, config=config)
    error = [float((theta - truth)[:, turn].norm()) for theta in (tracked, found)]
    assert error[1] < 0.5 * error[0]
    assert all(torch.equal(avatar.state_dict()[name], value) for name, value in before.items())
