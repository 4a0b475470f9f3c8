"""Training by the emulated CUDA backend: steps, the order of threads and overflows."""

import copy
import math
from dataclasses import fields, replace

import pytest
import torch

from rgbavatar_ns.avatar.training import make_optimizer
from rgbavatar_ns.avatar.training.color_init import FirstColors, FirstColorsKind, is_seen_well
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.kernels import DeviceRenderer
from rgbavatar_ns.kernels.morphed import morphed_renderer
from rgbavatar_ns.kernels.types import SIGHT_UNIT, MorphedGaussians
from tests.avatar.fused_scene import (
    assert_unfilmed_adds_nothing,
    drawn_by_the_reference,
    eager_step,
    far_batch,
    first_moments,
    fused_step,
    relative_differences,
    spoil,
    stir,
    values_by_group,
)
from tests.avatar.small_head import front_camera, random_theta

KINDS: tuple[FirstColorsKind, ...] = ("matted", "paper")


def test_parameters_after_some_steps(emulated, make_avatar):
    """Adam's own arithmetic: bias corrections, moments, bases and base, network."""
    ends = []
    for step in (fused_step, eager_step):
        avatar = stir(make_avatar())
        batch, background = far_batch(avatar, 2, 24, 24)
        optimizer = make_optimizer(avatar)
        for group in optimizer.param_groups:
            group["lr"] *= 0.1
        for _ in range(8):
            step(avatar, optimizer, batch, background)
        ends.append(values_by_group(avatar))
    assert max(relative_differences(*ends).values()) < 1e-3


def test_what_nobody_filmed_adds_nothing(emulated, make_avatar):
    assert_unfilmed_adds_nothing(fused_step, lambda: stir(make_avatar()), 2)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["position", "log_scale", "opacity_logit", "basis_rotation_wxyz"])
def test_what_is_not_finite_shows_as_the_reference_has_it(emulated, make_avatar, name, value):
    avatar = stir(make_avatar())
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    spoil(avatar, name, value)
    renderer = avatar.renderer(theta, camera)
    assert isinstance(renderer, DeviceRenderer)
    exact = drawn_by_the_reference(avatar, theta, camera)
    torch.testing.assert_close(renderer.draw().image, exact.image, atol=1e-4, rtol=0)


def test_gradient_of_theta(emulated, make_avatar):
    """Through vertices, frames and length ratios."""
    avatar = stir(make_avatar(scale_with_triangle=True))
    batch, background = far_batch(avatar, 3, cameras=3)
    gradients = []
    for run in (fused_step, eager_step):
        theta = batch.theta.clone().requires_grad_()
        own = stir(make_avatar(scale_with_triangle=True))
        moved = type(batch)(theta, batch.cameras, batch.images_rgba)
        run(own, make_optimizer(own), moved, background)
        assert theta.grad is not None
        gradients.append(theta.grad)
    assert (gradients[0] - gradients[1]).norm() < 2e-3 * gradients[1].norm()


def test_any_order_of_threads_gives_the_same_bits(emulated, make_avatar):
    """Sums are added in an order of their own, whichever thread comes first."""
    found = []
    for seed in (0, 1, 2):
        emulated.emulated.seed = seed
        avatar = stir(make_avatar())
        optimizer = make_optimizer(avatar)
        loss = fused_step(avatar, optimizer, *far_batch(avatar, 3))
        found.append((loss, first_moments(avatar, optimizer)))
    for loss, moments in found[1:]:
        assert torch.equal(loss, found[0][0])
        for name, value in moments.items():
            if name != "weight_network":
                assert torch.equal(value, found[0][1][name]), name


def test_first_colors_are_summed_as_by_a_pass_of_its_own(emulated, make_avatar):
    """Of the pictures that count, in whichever sets they are, for those that wait."""
    avatar = stir(make_avatar())
    batch, background = far_batch(avatar, 3, cameras=3)
    avatar.color_initialized[::3] = True
    # The bank's third picture, a view that nobody filmed, is drawn first.
    order = torch.tensor([2, 0, 1])
    for kind in KINDS:
        colors = FirstColors(avatar, kind)
        renderer = avatar.renderer(batch.theta[order], batch.cameras.select(order.tolist()))
        assert isinstance(renderer, DeviceRenderer)
        found = []
        for seed in (0, 1):
            emulated.emulated.seed = seed
            sight = colors.sight(2)
            assert sight is not None
            renderer.forward_loss_of(batch.images_rgba, order, background[order], sight)
            found.append(sight.sums.clone())
        filmed = batch.theta[:2], batch.cameras.select([0, 1]), batch.images_rgba[:2]
        expected = colors.seen_in(*filmed, background[:2], backend="reference").double()
        expected[::3] = 0
        assert int(is_seen_well(expected).sum()) > 30
        assert torch.equal(*found)
        difference = found[0].double() * SIGHT_UNIT - expected
        assert difference.abs().max() < 1e-4 * expected.abs().max()


def _crowd(emulated, avatar, room: int):
    """Pretend that no picture of this kind ever needed more than `room` entries."""
    batch, background = far_batch(avatar, 2)
    capacities = emulated.capacities(torch.device("cpu"))
    capacities.per_image[(avatar.num_gaussians, 40, 40)] = room
    return capacities, batch, background


def test_a_step_that_overflows_changes_nothing_and_is_counted_and_the_next_has_room(
    emulated, make_avatar
):
    avatar = stir(make_avatar())
    capacities, batch, background = _crowd(emulated, avatar, 5)
    step = FusedStep(avatar, [make_optimizer(avatar)])
    before = copy.deepcopy(avatar.blendshapes.state_dict())

    def changed() -> bool:
        now = avatar.blendshapes.state_dict()
        return any(not torch.equal(value, before[name]) for name, value in now.items())

    emulated.emulated.pending = True  # the report is still on its way
    step(batch.theta, batch.cameras, batch.images_rgba, background)
    assert not changed()
    assert capacities.skipped_steps == 0
    emulated.emulated.pending = False
    step(batch.theta, batch.cameras, batch.images_rgba, background)
    assert changed()
    assert capacities.skipped_steps == 1
    assert capacities.per_image[(avatar.num_gaussians, 40, 40)] > 5


def test_drawing_never_overflows(emulated, make_avatar):
    avatar = stir(make_avatar())
    _, batch, _ = _crowd(emulated, avatar, 5)
    found, expected = (
        avatar.render(batch.theta, batch.cameras, backend=backend).image
        for backend in ("auto", "reference")
    )
    assert (found - expected).abs().max() < 1e-4


@pytest.mark.parametrize("backend", ["cpu", "cuda"])
def test_without_gaussians_nothing_has_a_gradient(emulated, make_avatar, backend):
    """On a GPU there is nothing to launch: the kernel would read the first of none."""
    avatar = stir(make_avatar())
    names = [field.name for field in fields(MorphedGaussians)]
    tensors = {name: getattr(avatar.blendshapes, name, None) for name in names}
    some = MorphedGaussians(**tensors | avatar.anchors.triangles(with_rest_length=False))
    of_each = [
        name for name in names if not name.startswith(("triangle_v", "edges", "rest", "var"))
    ]
    shorter = {
        name: getattr(some, name)[(slice(None),) * name.startswith("basis_") + (slice(0),)]
        for name in of_each
    }
    none = replace(some, **shorter)
    assert len(none.position) == 0
    batch, background = far_batch(avatar, 2)
    weights = avatar.weights(batch.theta).detach()
    vertices = avatar.carrier_vertices(batch.theta)
    renderer = morphed_renderer(none, weights, vertices, batch.cameras, backend)
    assert renderer is not None
    loss = renderer.forward_loss(batch.images_rgba, background)
    assert bool(loss > 0)
    gradient = renderer.backward_adam(None, with_vertices=True)
    assert "blend_backward" not in emulated.emulated.launched
    assert gradient.vertices is not None
    assert gradient.weights.shape == weights.shape
    assert gradient.vertices.shape == vertices.shape
    assert not bool(gradient.weights.any())
    assert not bool(gradient.vertices.any())


def test_pixels_that_lie_oddly_in_memory_are_moved(emulated, make_avatar):
    """A GPU reads a pixel's four bytes at once, from where four divides."""
    avatar = stir(make_avatar())
    batch, background = far_batch(avatar, 2)
    images = torch.as_tensor(batch.images_rgba)
    odd = torch.empty(images.numel() + 1, dtype=torch.uint8)[1:].view(images.shape).copy_(images)
    assert odd.data_ptr() % 4 != 0
    places, launch = [], emulated.emulated.launch

    def watched(kernel, *arguments, **values):
        if kernel == "train":
            places.append(values["images"].data_ptr() % 4)
        launch(kernel, *arguments, **values)

    emulated.emulated.launch = watched
    losses = [
        avatar.renderer(batch.theta, batch.cameras).forward_loss(pixels, background)
        for pixels in (images, odd)
    ]
    assert torch.equal(*losses)
    assert places == [0, 0]
