"""Projected means that are moved in the image, and the gradient that this gives of them."""

import functools
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, available_backends, rasterize
from rgbavatar_ns.kernels.reference import BlendingRules, rasterize_reference
from tests.kernels.agreement import assert_agrees, expect
from tests.kernels.scenes import (
    ATTRIBUTES,
    changed,
    in_float32,
    moved,
    random_scene,
    relative_l2,
    render_and_differentiate,
    settled_pixels,
)

DTYPES = {"reference": torch.float64, "cpu": torch.float32}
SCENES = {
    "extremes": {},
    "cameras": {"num_cameras": 3},
    "all shared but the cameras": {"shared": ATTRIBUTES, "num_cameras": 3},
    "one means": {"shared": ("means",)},
    "several tiles": {"width": 131, "height": 66, "batch": 2, "count": 101},
    "one Gaussian": {"count": 1, "width": 18, "height": 13},
}


@functools.cache
def _expected(name: str):
    return expect(moved(random_scene(5, **SCENES[name])))


@pytest.mark.parametrize("name", SCENES)
def test_values_and_gradients_match_reference(fast_backend, name):
    expected = _expected(name)
    assert "screen_offset" in expected.gradients
    assert_agrees(expected, fast_backend)


def test_the_reference_s_gradient_is_that_of_finite_differences():
    scene = moved(random_scene(3, batch=2, count=3, width=5, height=3, extremes=False), 0.5)
    gaussians = changed(
        scene, scales=scene.gaussians.scales * 2, opacities=0.3 + 0.5 * scene.gaussians.opacities
    ).gaussians
    rules = BlendingRules(smooth_cutoff=True, block_stopping=False)

    def draw(screen_offset: Tensor) -> tuple[Tensor, Tensor]:
        rendered = rasterize_reference(
            gaussians,
            scene.cameras,
            scene.background[None],
            screen_offset=screen_offset,
            rules=rules,
        )
        return rendered.image, rendered.alpha

    offset = scene.screen_offset
    assert offset is not None
    assert torch.autograd.gradcheck(draw, offset.requires_grad_(), atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("backend", available_backends())
def test_one_gaussian_by_hand(backend):
    # On the axis at z = 2 with f = 8: sigma is 0.25 * 8 / 2 = 1 px, so cov = 1 + .3 on both axes.
    dtype = DTYPES[backend]
    gaussians = GaussianSet(
        torch.tensor([[[0.0, 0.0, 2.0]]], dtype=dtype),
        torch.tensor([[[1.0, 0.0, 0.0, 0.0]]], dtype=dtype),
        torch.full((1, 1, 3), 0.25, dtype=dtype),
        torch.tensor([[0.6]], dtype=dtype),
        torch.tensor([[[0.2, 0.5, 1.0]]], dtype=dtype),
    )
    focal, centre = (torch.full((1, 2), value, dtype=dtype) for value in (8.0, 3.0))
    cameras = PinholeCameras(torch.eye(4, dtype=dtype)[None], focal, centre, 6, 6)
    offset = torch.tensor([[[0.25, -1.0]]], dtype=dtype).requires_grad_()
    rendered = rasterize(gaussians, cameras, backend=backend, screen_offset=offset)
    blue = rendered.image[0, 2, 4, 2]
    blue.backward()
    # The pixel's centre is at (4.5, 2.5): (1.25, .5) from the moved mean (3.25, 2).
    alpha = 0.6 * math.exp(-0.5 * (1.25**2 + 0.5**2) / 1.3)
    assert blue.item() == pytest.approx(alpha, abs=3e-6)
    # d/dmean exp(-d^2 / 2.6) = d / 1.3 of it; the colour is 1: towards the pixel it brightens.
    expected = [alpha * 1.25 / 1.3, alpha * 0.5 / 1.3]
    assert torch.as_tensor(offset.grad).flatten().tolist() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("shift_px", [(-3, 5), (40, -20)])
def test_whole_pixels_for_all_shift_the_picture(fast_backend, shift_px):
    width, height = 83, 51
    scene = random_scene(9, width=width, height=height, batch=1, count=90, extremes=False)
    right, down = shift_px
    offset = torch.tensor([shift_px], dtype=torch.float64).expand(1, 90, 2)
    gaussians, cameras = in_float32(scene)
    before = rasterize(gaussians, cameras, backend=fast_backend, with_depth=True)
    after = rasterize(
        gaussians, cameras, backend=fast_backend, with_depth=True, screen_offset=offset.float()
    )
    there = slice(max(down, 0), height + min(down, 0)), slice(max(right, 0), width + min(right, 0))
    here = (
        slice(there[0].start - down, there[0].stop - down),
        slice(there[1].start - right, there[1].stop - right),
    )
    settled = settled_pixels(scene)[0][here]  # where rounding does not decide about an alpha
    settled = settled & settled_pixels(replace(scene, screen_offset=offset))[0][there]
    assert settled.double().mean() > 0.5
    # Other pixels share a block, which ends with less than 1e-4 behind it, earlier or later.
    for name, error in (("image", 2e-4), ("alpha", 2e-4), ("depth", 2e-3)):
        was, now = getattr(before, name)[0][here], getattr(after, name)[0][there]
        assert was.max() > 0.1
        assert ((now - was) * settled).abs().max() < error, name


def test_the_same_for_all_is_a_move_of_the_principal_point(fast_backend):
    scene = random_scene(8, num_cameras=3, extremes=False)
    # So near the image's middle that the clamp, which follows the principal point, acts on none.
    scene = changed(scene, means=0.7 * scene.gaussians.means)
    shift = torch.tensor([[1.75, -2.3], [0.4, 0.3], [-3.1, 0.0]]).double()
    centre = scene.cameras.principal_point_px + shift
    offset = shift[:, None].expand(3, 200, 2).contiguous()
    (shifted, grads), (expected, expected_grads) = (
        render_and_differentiate(each, torch.float32, fast_backend)
        for each in (
            replace(scene, screen_offset=offset),
            replace(scene, cameras=replace(scene.cameras, principal_point_px=centre)),
        )
    )
    # Rounding may move single alphas over the cut of 1 / 255.
    assert (shifted.image - expected.image).abs().max() < 5e-3
    assert (shifted.image - expected.image).abs().mean() < 1e-5
    for name in ATTRIBUTES:
        assert relative_l2(grads[name], expected_grads[name]) < 5e-3, name


@pytest.mark.parametrize("shared", [(), ATTRIBUTES])
def test_zeros_and_none_draw_the_same_bits(fast_backend, shared):
    scene = random_scene(6, num_cameras=3, shared=shared)
    zeros = replace(scene, screen_offset=torch.zeros(3, 200, 2).double())
    (rendered, grads), (expected, expected_grads) = (
        render_and_differentiate(each, torch.float32, fast_backend) for each in (zeros, scene)
    )
    for name, value in vars(expected).items():
        assert torch.equal(getattr(rendered, name), value), name
    for name, value in expected_grads.items():
        assert torch.equal(grads[name], value), name
    assert grads["screen_offset"].abs().max() > 0


def test_the_offset_alone_is_differentiated(fast_backend):
    scene = moved(random_scene(6))
    _, expected = render_and_differentiate(scene, torch.float32, fast_backend)
    gaussians, cameras = in_float32(scene)
    assert scene.screen_offset is not None
    offset = scene.screen_offset.float().requires_grad_()
    rendered = rasterize(gaussians, cameras, backend=fast_backend, screen_offset=offset)
    background = scene.background.float()
    image = rendered.image + (1 - rendered.alpha) * background
    loss = (image * scene.image_grad).sum() + (rendered.alpha * scene.alpha_grad).sum()
    loss.backward()
    assert relative_l2(torch.as_tensor(offset.grad).double(), expected["screen_offset"]) < 1e-5


def test_what_is_not_seen_has_no_gradient(fast_backend):
    scene = random_scene(5)
    zeros = replace(scene, screen_offset=torch.zeros(3, 200, 2).double())
    rendered, grads = render_and_differentiate(zeros, torch.float32, fast_backend)
    hidden = torch.as_tensor(rendered.visibility) == 0
    assert hidden[:, 30:35].all()  # these have no opacity
    assert 0.1 < hidden.double().mean() < 0.9
    assert (grads["screen_offset"][hidden] == 0).all()
    assert (grads["screen_offset"][~hidden] != 0).any(-1).double().mean() > 0.9


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30, -3e38, 1e5])
def test_a_gaussian_that_is_moved_out_of_sight_might_as_well_be_absent(fast_backend, value):
    scene = moved(random_scene(0, count=60, batch=2, width=9, height=10, extremes=False), 0.5)
    absent = scene.gaussians.opacities.clone()
    absent[1, 7] = 0
    assert scene.screen_offset is not None
    offset = scene.screen_offset.clone()
    offset[1, 7, 1] = value
    (rendered, grads), (expected, expected_grads) = (
        render_and_differentiate(each, torch.float32, fast_backend)
        for each in (replace(scene, screen_offset=offset), changed(scene, opacities=absent))
    )
    for name in ("image", "alpha", "depth", "visibility"):
        assert torch.equal(getattr(rendered, name), getattr(expected, name)), name
    for name, value_grad in expected_grads.items():
        assert torch.equal(grads[name], value_grad), name
    assert (grads["screen_offset"][1, 7] == 0).all()


@pytest.mark.skipif("cpu" not in available_backends(), reason="the extension is not compiled")
@pytest.mark.usefixtures("instruction_set")
def test_any_number_of_threads_gives_the_same_bits():
    scene = moved(random_scene(4, width=203, height=141, batch=3, count=2500, shared=("means",)))
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 5, 16):
            torch.set_num_threads(count)
            rendered, grads = render_and_differentiate(scene, torch.float32, "cpu")
            results.append((rendered.image, *(grads[name] for name in ("means", "screen_offset"))))
    finally:
        torch.set_num_threads(threads)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0]))


@pytest.mark.parametrize(
    ("offset", "message"),
    [
        (torch.zeros(1, 4, 2), r"screen_offset is \[1, 4, 2\]. Pass \[3, 4, 2\]"),
        (torch.zeros(3, 5, 2), r"screen_offset is \[3, 5, 2\]. Pass \[3, 4, 2\]"),
        (torch.zeros(3, 4, 2, dtype=torch.float16), "screen_offset: torch.float16"),
        (torch.zeros(3, 4, 2, device="meta"), "screen_offset: torch.float32 on meta"),
    ],
)
def test_offsets_that_do_not_fit_are_refused(offset, message):
    gaussians, cameras = in_float32(random_scene(0, count=4, extremes=False))
    with pytest.raises(ValueError, match=message):
        rasterize(gaussians, cameras, screen_offset=offset)


def test_backgrounds_alone_can_make_the_batch(fast_backend):
    gaussians, cameras = in_float32(random_scene(2, batch=1))
    offset = torch.tensor([[[0.0, 0.0]], [[3.0, 1.5]]]).expand(2, 200, 2).clone().requires_grad_()
    both = rasterize(
        gaussians, cameras, torch.zeros(2, 3), backend=fast_backend, screen_offset=offset
    )
    assert both.image.shape[0] == 2
    both.image.square().sum().backward()
    for place in range(2):
        alone = offset.detach()[place : place + 1].clone().requires_grad_()
        image = rasterize(gaussians, cameras, backend=fast_backend, screen_offset=alone).image
        image.square().sum().backward()
        assert torch.equal(image[0], both.image[place])
        assert torch.equal(torch.as_tensor(alone.grad)[0], torch.as_tensor(offset.grad)[place])
