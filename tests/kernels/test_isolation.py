"""What is broken in one Gaussian, one image or one pixel stays there: drawn by hypothesis."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rgbavatar_ns.kernels import available_backends
from tests.kernels.scenes import ATTRIBUTES, changed, random_scene, render_and_differentiate

pytestmark = [
    pytest.mark.usefixtures("instruction_set"),
    pytest.mark.skipif("cpu" not in available_backends(), reason="the extension is not compiled"),
]
BATCH, COUNT, WIDTH, HEIGHT = 3, 37, 19, 14
NOT_FINITE = [math.nan, math.inf, -math.inf]
EXTREME = [0.0, -0.0, 1e-40, -1e-40, 1e-30, 1e-20, 1e20, -1e20, 1e30, 3.4e38, -3.4e38, -1.0]
# The instruction set is a fixture of a function that hypothesis calls many times; it is constant.
drawn = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def _scene(seed: int, shared: tuple[str, ...] = ()):
    return random_scene(
        seed,
        batch=BATCH,
        count=COUNT,
        width=WIDTH,
        height=HEIGHT,
        num_cameras=BATCH,
        extremes=False,
        shared=shared,
    )


def _draw(scene):
    """Rendering and gradients as float32 has them, to the bit."""
    return render_and_differentiate(scene, torch.float32, "cpu")


def _with(scene, changes):
    """A copy in which `name`'s row of one image and Gaussian holds `value` (at one component)."""
    rows = {name: value.clone() for name, value in vars(scene.gaussians).items()}
    for name, index, component, value in changes:
        row = rows[name][component % len(rows[name]), index].view(-1)
        row[component % len(row)] = value
    return changed(scene, **rows)


def _assert_in_range(rendered) -> None:
    assert 0 <= rendered.alpha.min() <= rendered.alpha.max() <= 1
    assert -1e-6 <= rendered.image.min() <= rendered.image.max() <= 1 + 1e-5


def _assert_others_untouched(drawn, expected) -> None:
    """All but the middle image, and their Gaussians' gradients, to the bit."""
    for image in (0, 2):
        assert torch.equal(drawn[0].image[image], expected[0].image[image])
        for name in ATTRIBUTES:
            assert torch.equal(drawn[1][name][image], expected[1][name][image]), name


def _changes(values) -> st.SearchStrategy:
    change = st.tuples(
        st.sampled_from(ATTRIBUTES),
        st.integers(0, COUNT - 1),
        st.integers(0, 11),
        st.sampled_from(values),
    )
    return st.lists(change, min_size=1, max_size=6)


@drawn
@given(changes=_changes(NOT_FINITE), seed=st.integers(0, 3), shared=st.sampled_from(ATTRIBUTES))
def test_gaussians_that_are_not_finite_might_as_well_be_absent(changes, seed, shared):
    scene = _scene(seed, (shared,))
    # Broken in every image, so that it can be left out of the batch.
    indices = sorted({index for _, index, _, _ in changes})
    everywhere = [
        (name, index, BATCH * component + image, value)
        for name, index, component, value in changes
        for image in range(BATCH)
    ]
    keep = [index for index in range(COUNT) if index not in indices]
    rendered, grads = _draw(_with(scene, everywhere))
    alone, alone_grads = _draw(
        changed(scene, **{name: row[:, keep] for name, row in vars(scene.gaussians).items()})
    )
    for name in ("image", "alpha", "depth"):
        assert torch.equal(getattr(rendered, name), getattr(alone, name)), name
    assert (rendered.visibility[:, indices] == 0).all()
    for name in ATTRIBUTES:
        assert torch.equal(grads[name][:, keep], alone_grads[name]), name
        assert (grads[name][:, indices] == 0).all()


@drawn
@given(change=_changes(NOT_FINITE + EXTREME), seed=st.integers(0, 3))
def test_what_is_broken_in_one_image_is_not_seen_in_another(change, seed):
    scene = _scene(seed)
    # The middle image's rows are 1 modulo the batch's size.
    middle = [(name, index, 3 * component + 1, value) for name, index, component, value in change]
    _assert_others_untouched(_draw(_with(scene, middle)), _draw(scene))


@drawn
@given(changes=_changes(EXTREME), seed=st.integers(0, 3))
def test_extreme_shapes_and_opacities_leave_images_in_range(changes, seed):
    scene = _scene(seed)
    changes = [change for change in changes if change[0] != "colors"]
    rendered, grads = _draw(_with(scene, changes))
    touched = {index for _, index, _, _ in changes}
    others = [index for index in range(COUNT) if index not in touched]
    _assert_in_range(rendered)
    for name in ATTRIBUTES:
        assert torch.isfinite(grads[name][:, others]).all(), name


def _camera_changes(values) -> dict[str, st.SearchStrategy]:
    return {
        "name": st.sampled_from(["world_to_camera", "focal_px", "principal_point_px"]),
        "position": st.integers(0, 100),
        "value": st.sampled_from(values),
    }


@drawn
@given(**_camera_changes(NOT_FINITE))
def test_cameras_that_are_not_finite_are_refused(name, position, value):
    scene = _scene(0)
    flat = getattr(scene.cameras, name).view(-1)
    flat[position % len(flat)] = value
    with pytest.raises(ValueError, match=f"{name} holds NaN or infinity"):
        _draw(scene)


@drawn
@given(**_camera_changes(EXTREME))
def test_extreme_cameras_are_refused_or_leave_images_in_range(name, position, value):
    scene = _scene(1)
    values = getattr(scene.cameras, name)[1].view(-1)
    values[position % len(values)] = value
    if name == "focal_px" and value <= 0:
        with pytest.raises(ValueError, match="focal_px must be positive"):
            _draw(scene)
        return
    found = _draw(scene)
    _assert_in_range(found[0])
    _assert_others_untouched(found, _draw(_scene(1)))


@drawn
@given(channel=st.integers(0, 2), value=st.sampled_from(NOT_FINITE + EXTREME))
def test_a_strange_background_stays_in_its_image_and_channel(channel, value):
    plain = replace(_scene(2), background=_scene(2).background.repeat(BATCH, 1))
    broken = replace(plain, background=plain.background.clone())
    broken.background[1, channel] = value
    if not math.isfinite(value):
        with pytest.raises(ValueError, match="background holds NaN or infinity"):
            _draw(broken)
        return
    (rendered, grads), (expected, expected_grads) = _draw(broken), _draw(plain)
    assert torch.equal(rendered.alpha, expected.alpha)
    others = [k for k in range(3) if k != channel]
    assert torch.equal(rendered.image[..., others], expected.image[..., others])
    _assert_others_untouched((rendered, grads), (expected, expected_grads))
    assert torch.equal(grads["colors"], expected_grads["colors"])


@drawn
@given(
    row=st.integers(0, HEIGHT - 1),
    column=st.integers(0, WIDTH - 1),
    value=st.sampled_from(NOT_FINITE),
)
def test_a_broken_gradient_of_a_pixel_stays_with_the_gaussians_of_its_image(row, column, value):
    scene = _scene(3)
    scene.image_grad[1, row, column, 1] = value
    _assert_others_untouched(_draw(scene), _draw(_scene(3)))


@pytest.mark.parametrize("value", [1e3, -1e3])
def test_a_glaring_gaussian_leaves_its_neighbours_gradients(value):
    """What lies behind it has a gradient in which its colour does not occur."""
    scene = random_scene(0, batch=1, count=COUNT, width=WIDTH, height=HEIGHT, extremes=False)
    nearest = (scene.gaussians.means[0] @ scene.cameras.world_to_camera[0, 2, :3]).argmin()
    glaring = _with(scene, [("colors", int(nearest), k, value) for k in range(3)])
    (_, grads), (_, expected) = _draw(glaring), _draw(scene)
    others = torch.arange(COUNT) != nearest
    for name in ATTRIBUTES:
        error = (grads[name] - expected[name])[:, others].norm()
        assert error < 1e-3 * expected[name].norm(), f"{name}: {error}"
