"""What holds for every rendering, whatever draws it."""

from dataclasses import replace

import pytest
import torch

from rgbavatar_ns.kernels import GaussianSet, rasterize
from tests.kernels.scenes import (
    ATTRIBUTES,
    changed,
    in_float32,
    random_scene,
    relative_l2,
    render_and_differentiate,
)


def _image(scene, backend, background=None):
    return rasterize(*in_float32(scene), background, backend=backend)


def test_batched_render_equals_loop(fast_backend):
    scene = random_scene(1, num_cameras=3, shared=("scales",))
    gaussians, cameras = in_float32(scene)
    together = rasterize(gaussians, cameras, backend=fast_backend, with_depth=True)
    for i in range(3):
        one = GaussianSet(
            **{k: v[i : i + 1] if len(v) > 1 else v for k, v in vars(gaussians).items()}
        )
        alone = rasterize(one, cameras.select([i]), backend=fast_backend, with_depth=True)
        for name in ("image", "alpha", "depth"):
            assert torch.equal(getattr(alone, name)[0], getattr(together, name)[i]), name


def test_gradients_of_shared_attributes_are_sums(fast_backend):
    shared = random_scene(2, batch=3, shared=ATTRIBUTES, num_cameras=3)
    rows = {k: v.expand(3, *v.shape[1:]) for k, v in vars(shared.gaussians).items()}
    apart = changed(shared, **rows)
    _, summed = render_and_differentiate(shared, torch.float32, fast_backend)
    _, single = render_and_differentiate(apart, torch.float32, fast_backend)
    for name in ATTRIBUTES:
        assert relative_l2(summed[name], single[name].sum(0, keepdim=True)) < 1e-5


def test_order_in_memory_does_not_matter(fast_backend):
    scene = random_scene(3)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(0))
    shuffled = changed(scene, **{k: v[:, order] for k, v in vars(scene.gaussians).items()})
    before, grads = render_and_differentiate(scene, torch.float32, fast_backend)
    after, shuffled_grads = render_and_differentiate(shuffled, torch.float32, fast_backend)
    torch.testing.assert_close(after.image, before.image, atol=1e-6, rtol=0)
    assert before.visibility is not None
    torch.testing.assert_close(after.visibility, before.visibility[:, order], atol=1e-6, rtol=0)
    for name in ATTRIBUTES:
        assert relative_l2(shuffled_grads[name], grads[name][:, order]) < 1e-5


def test_background_shows_through_what_is_not_covered(fast_backend):
    scene = random_scene(5)
    black = _image(scene, fast_backend)
    colors = torch.rand(3, 3, generator=torch.Generator().manual_seed(0))
    over = _image(scene, fast_backend, colors)
    expected = black.image + (1 - black.alpha) * colors[:, None, None]
    torch.testing.assert_close(over.image, expected, atol=2e-6, rtol=0)


@pytest.mark.parametrize("wanted", [("means",), ("colors", "opacities"), ("background",)])
def test_only_wanted_gradients_are_given(fast_backend, wanted):
    scene = random_scene(6)
    _, expected = render_and_differentiate(scene, torch.float32, fast_backend)
    gaussians, cameras = in_float32(scene)
    background = scene.background.float().requires_grad_("background" in wanted)
    for name in ATTRIBUTES:
        getattr(gaussians, name).requires_grad_(name in wanted)
    rendered = rasterize(gaussians, cameras, background, backend=fast_backend)
    loss = (rendered.image * scene.image_grad).sum() + (rendered.alpha * scene.alpha_grad).sum()
    loss.backward()
    for name in (*ATTRIBUTES, "background"):
        leaf = background if name == "background" else getattr(gaussians, name)
        assert (leaf.grad is not None) is (name in wanted)
        if leaf.grad is not None:
            assert relative_l2(leaf.grad.double(), expected[name]) < 1e-5


def test_alpha_alone_has_gradients(fast_backend):
    scene = random_scene(7, extremes=False)
    silent = replace(scene, image_grad=torch.zeros_like(scene.image_grad))
    _, expected = render_and_differentiate(silent, torch.float32, fast_backend)
    gaussians, cameras = in_float32(scene)
    gaussians.opacities.requires_grad_()
    alpha = rasterize(gaussians, cameras, backend=fast_backend).alpha
    (alpha * scene.alpha_grad).sum().backward()
    assert relative_l2(gaussians.opacities.grad.double(), expected["opacities"]) < 1e-5


def test_rigid_motion_of_world_and_camera_changes_nothing(fast_backend):
    scene = random_scene(8, extremes=False)
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).double()
    shift = torch.tensor([0.25, -0.5, 0.125]).double()
    w, x, y, z = scene.gaussians.quats_wxyz.unbind(-1)
    # A quarter turn about z is (1, 0, 0, 1) / sqrt 2 from the left.
    turned = torch.stack([w - z, x - y, x + y, w + z], -1)
    moved_means = scene.gaussians.means @ quarter.T + shift
    world_to_camera = scene.cameras.world_to_camera.clone()
    world_to_camera[:, :3, :3] = world_to_camera[:, :3, :3] @ quarter.T
    world_to_camera[:, :3, 3] -= (world_to_camera[:, :3, :3] @ shift[:, None])[..., 0]
    moved = changed(scene, means=moved_means, quats_wxyz=turned)
    moved = replace(moved, cameras=replace(scene.cameras, world_to_camera=world_to_camera))
    difference = (_image(moved, fast_backend).image - _image(scene, fast_backend).image).abs()
    # Rounding may move single alphas over the cut of 1 / 255.
    assert difference.max() < 5e-3
    assert difference.mean() < 1e-5
