"""Pictures that are only to be seen, from Gaussians packed in few bits."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from rgbavatar_ns.avatar.training import TrainingOptions, TrainingStep, make_optimizer
from rgbavatar_ns.drawing.compositing import to_uint8
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels import available_backends, packed_gaussians, rasterize
from rgbavatar_ns.kernels.constants import MIN_ALPHA
from rgbavatar_ns.threads import using_threads
from tests.avatar.fused_scene import (
    VARIANTS,
    drawn_by_the_reference,
    far_batch,
    fused_step,
    spoil,
    stir,
)
from tests.avatar.small_head import front_camera, random_theta
from tests.kernels.conftest import instruction_set  # noqa: F401

pytestmark = pytest.mark.skipif("cpu" not in available_backends(), reason="not compiled")

ROUNDING = 1 / 512
MOST_AT_THE_CUT = 5
"""Pixels where the edge of a Gaussian, at 1/255, or two of one depth fall to the other side."""


@pytest.fixture
def stirred(make_avatar):
    return lambda seed=0, **changes: stir(make_avatar(**changes), seed)


def seen(avatar, theta, camera, *background, **options):
    """The picture that an avatar shows which has not changed since the last one."""
    with torch.no_grad():
        for _ in range(2):
            drawn = avatar.render(theta, camera, *background, to_be_seen=True, **options)
    assert avatar._for_pictures._made is not None
    return drawn


def assert_same_to_the_eye(drawn, exact) -> None:
    for name in ("image", "alpha"):
        difference = (getattr(drawn, name) - getattr(exact, name)).abs().amax(-1)
        assert int((difference > ROUNDING).sum()) <= MOST_AT_THE_CUT, name
        assert float(difference.mean()) < 1e-4, name


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_picture_of_every_variant_is_the_exact_one_to_the_eye(stirred, variant, seed):
    avatar = stirred(seed, **VARIANTS[variant])
    theta, camera = random_theta(avatar.layout, 1, seed), front_camera(45)
    background = torch.tensor([0.2, 0.5, 0.9])
    drawn = seen(avatar, theta, camera, background, with_depth=True)
    exact = avatar.render(theta, camera, background, with_depth=True)
    assert_same_to_the_eye(drawn, exact)
    far = (drawn.depth - exact.depth).abs() > 1e-4
    assert int(far.sum()) <= MOST_AT_THE_CUT
    assert int((exact.alpha > 0.1).sum()) > 100, "there is something to see"


def test_the_first_picture_is_exact_to_the_bit(stirred):
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    first = avatar.render(theta, camera, to_be_seen=True).image
    assert torch.equal(first, avatar.render(theta, camera).image)


def test_pictures_to_measure_stay_exact_beside_those_to_see(stirred):
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    before = avatar.render(theta, camera).image
    drawn = seen(avatar, theta, camera).image
    assert not torch.equal(drawn, before)
    assert torch.equal(avatar.render(theta, camera).image, before)
    pair = theta.expand(2, -1)
    several = avatar.render(pair, camera, to_be_seen=True)
    assert torch.equal(several.image, avatar.render(pair, camera).image)
    visible = avatar.render(theta, camera, to_be_seen=True, with_visibility=True).visibility
    assert torch.equal(visible, avatar.render(theta, camera, with_visibility=True).visibility)


@pytest.mark.usefixtures("unchecked_types")
def test_later_pictures_take_what_the_first_one_takes(stirred):
    """Colours of another type, and more cameras or colours than theta."""
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    gray, two = torch.full((3,), 0.25), torch.tensor([[0.2, 0.5, 0.9], [0.7, 0.1, 0.0]])
    cases = [(camera, gray.double(), gray), (camera, torch.ones(3, dtype=torch.uint8), None)]
    cases += [(camera.select([0, 0]), gray, gray), (camera, two, two)]
    for cameras, background, exact_background in cases:
        exact_background = torch.ones(3) if exact_background is None else exact_background
        with torch.no_grad():
            exact = rasterize(avatar.gaussians(theta), cameras, exact_background)
        for _ in range(3):
            drawn = avatar.render(theta, cameras, background, to_be_seen=True)
            assert drawn.image.shape == exact.image.shape
            assert_same_to_the_eye(drawn, exact)
        for differentiable in (True, False):
            drawn = avatar.render(theta, cameras, background, differentiable=differentiable)
            torch.testing.assert_close(drawn.image, exact.image, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    "change", ["in place", "fused step", "eager step", "loaded", "another tensor"]
)
def test_a_changed_avatar_is_shown_as_it_is_now(stirred, change):
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    before = seen(avatar, theta, camera).image
    if change == "in place":
        with torch.no_grad():
            avatar.blendshapes.basis_color_feature.mul_(3)
    elif change == "fused step":
        assert fused_step(avatar, make_optimizer(avatar), *far_batch(avatar, 2)) is not None
    elif change == "eager step":
        options = TrainingOptions(fast=False)
        batch, background = far_batch(avatar, 2)
        TrainingStep(avatar, options=options)(replace(batch, background=background), 0)
    elif change == "loaded":
        avatar.load_state_dict(stirred(4).state_dict())
    else:
        shapes = avatar.blendshapes
        shapes.position = torch.nn.Parameter(shapes.position.detach() + 2e-3)
    exact = avatar.render(theta, camera).image
    assert float((exact - before).abs().max()) > 0.02
    assert torch.equal(avatar.render(theta, camera, to_be_seen=True).image, exact)
    assert_same_to_the_eye(seen(avatar, theta, camera), avatar.render(theta, camera))


@pytest.mark.usefixtures("instruction_set")
def test_threads_change_no_bit(stirred):
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera(130)
    pictures = []
    for threads in (1, 2, 3, 7):
        with using_threads(threads):
            pictures.append(seen(avatar, theta, camera, with_depth=True))
    for drawn in pictures[1:]:
        assert torch.equal(drawn.image, pictures[0].image)
        assert torch.equal(drawn.depth, pictures[0].depth)


@pytest.mark.usefixtures("instruction_set")
def test_the_size_of_a_basis_does_not_matter(stirred):
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    psi = avatar.weights(theta).detach()
    expected = seen(avatar, theta, camera, psi=psi).image
    for exponent in (-40, 30):
        other, factor = copy.deepcopy(avatar), 2.0**exponent
        with torch.no_grad():
            for name in ("basis_position", "basis_rotation_wxyz", "basis_color_feature"):
                getattr(other.blendshapes, name).mul_(factor)
        assert torch.equal(seen(other, theta, camera, psi=psi / factor).image, expected)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["position", "log_scale", "opacity_logit", "basis_rotation_wxyz"])
def test_what_is_not_finite_shows_as_in_the_exact_picture(stirred, name, value):
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    spoil(avatar, name, value)
    exact = drawn_by_the_reference(avatar, theta, camera)
    assert bool(exact.image.isfinite().all())
    assert_same_to_the_eye(avatar.render(theta, camera), exact)
    assert_same_to_the_eye(seen(avatar, theta, camera), exact)


@pytest.mark.parametrize("drawn", [0, 1, 15, 16, 17])
def test_what_no_picture_shows_is_left_out(stirred, drawn):
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    below = math.log(MIN_ALPHA / (1 - MIN_ALPHA)) - 0.01
    with torch.no_grad():
        avatar.blendshapes.opacity_logit[drawn:] = below
    packed = packed_gaussians(avatar._morphed_gaussians())
    assert packed is not None
    assert packed.count == drawn
    assert_same_to_the_eye(seen(avatar, theta, camera), avatar.render(theta, camera))


def test_the_copy_takes_a_third_of_the_bases_and_a_little_more(stirred):
    """Each basis three halves and two words, where it had ten floats."""
    avatar = stirred(num_bases=21)
    packed = packed_gaussians(avatar._morphed_gaussians())
    assert packed is not None
    bases = (3 * 2 + 2 * 4) * 21 * avatar.num_gaussians
    assert bases <= packed.num_bytes < 1.3 * bases


@torch.no_grad()
def test_what_a_picture_asks_of_torch_wakes_no_other_threads(stirred):
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    used = []

    def look(*_) -> None:
        used.append(torch.get_num_threads())

    with using_threads(3):
        seen(avatar, theta, camera)
        hooks = [part.register_forward_hook(look) for part in (avatar.head, avatar.weight_network)]
        avatar.render(theta, camera, to_be_seen=True)
        to_uint8(torch.zeros(4, 4, 3))
        assert not used, "neither is asked"
        avatar.render(theta, camera)
        assert used == [1, 1]
        assert torch.get_num_threads() == 3
        for to_be_seen in (True, False):
            with pytest.raises(UserError, match="theta"):
                avatar.render(theta[:, 1:], camera, to_be_seen=to_be_seen)
        hooks.append(avatar.head.register_forward_hook(_fail))
        with pytest.raises(RuntimeError, match="no head"):
            avatar.render(theta, camera)
        assert torch.get_num_threads() == 3
    for hook in hooks:
        hook.remove()


def _fail(*_) -> None:
    raise RuntimeError("no head today")


def test_packed_gaussians_draw_one_picture_at_a_time(stirred):
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    seen(avatar, theta, camera)
    with pytest.raises(ValueError, match="one picture at a time"):
        avatar.picture_renderer(theta, camera.select([0, 0]))
    with pytest.raises(ValueError, match=r"Pass \[B, 3\]"):
        avatar.picture_renderer(theta, camera, torch.zeros(1, 2))


def test_a_copy_begins_without_packed_gaussians(stirred):
    avatar = stirred()
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    drawn = seen(avatar, theta, camera).image
    other = copy.deepcopy(avatar)
    assert other._for_pictures._made is None
    assert torch.equal(seen(other, theta, camera).image, drawn)
