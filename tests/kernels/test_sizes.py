"""Large images, many Gaussians and many threads, by laws and by crops that the reference draws."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from rgbavatar_ns.bench.scenes import leaf_gaussians
from rgbavatar_ns.kernels import (
    GaussianSet,
    PinholeCameras,
    available_backends,
    rasterize,
    weighted_color_average,
)
from tests.kernels.agreement import assert_agrees, expect
from tests.kernels.scenes import (
    ATTRIBUTES,
    Scene,
    in_float32,
    random_scene,
    relative_l2,
    render_and_differentiate,
    settled_pixels,
    to,
)

pytestmark = pytest.mark.skipif(
    "cpu" not in available_backends(), reason="the extension is not compiled"
)


def _plane_scene(
    width: int, height: int, count: int, seed: int, *, batch: int = 1, radius_px=(0.5, 5.0)
) -> tuple[GaussianSet, PinholeCameras]:
    """float32 Gaussians all over the image of a camera at the origin that looks along +z."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *size: int) -> Tensor:
        return low + (high - low) * torch.rand(batch, count, *size, generator=generator)

    focal, centre = 1024.0, torch.tensor([width / 2, height / 2])
    depth = uniform(1.0, 3.0, 1)
    pixel = uniform(-0.004, 1.004, 2) * torch.tensor([width, height]) - centre
    gaussians = GaussianSet(
        torch.cat([pixel * depth / focal, depth], -1),
        torch.randn(batch, count, 4, generator=generator),
        uniform(*radius_px, 3) * depth / focal,
        uniform(0.05, 1.0),
        uniform(0.0, 1.0, 3),
    )
    cameras = PinholeCameras(
        torch.eye(4)[None], torch.full((1, 2), focal), centre[None], width, height
    )
    return gaussians, cameras


def _gradients(gaussians, cameras, image_grad: Tensor):
    """The rendering before black and the gradients of all attributes, in float32."""
    leaves = leaf_gaussians(gaussians)
    rendered = rasterize(leaves, cameras, backend="cpu", with_depth=True, with_visibility=True)
    rendered.image.backward(image_grad)
    return rendered, {name: torch.as_tensor(leaf.grad) for name, leaf in vars(leaves).items()}


PART_PX, MARGIN_PX = 128, 32
PARTS = {  # width, height of the image; left, top (multiples of the blocks' 4 px) of the part
    "first pixel of the largest": (2048, 2048, 0, 0),
    "across a tile's edge": (2048, 2048, 1000, 212),
    "last pixel of odd sides": (2047, 1533, 1920, 1408),
    "wide": (2045, 3, 1000, 0),
    "high": (3, 2045, 0, 1920),
}


def _interior(start: int, size: int, whole: int) -> Tensor:
    """Pixels of a part that lie far from its ends, or at an end that is the image's as well."""
    place = torch.arange(size)
    low = (place >= MARGIN_PX) | (start == 0)
    return low & ((place < size - MARGIN_PX) | (start + size == whole))


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("name", PARTS)
def test_parts_of_large_images_match_reference(name):
    width, height, left, top = PARTS[name]
    part_width, part_height = min(PART_PX, width - left), min(PART_PX, height - top)
    gaussians, cameras = _plane_scene(width, height, 2500, seed=1)
    mean_px = gaussians.means[0, :, :2] / gaussians.means[0, :, 2:] * 1024
    mean_px = mean_px + cameras.principal_point_px - torch.tensor([left, top])
    # Farther out the part's camera clamps the Jacobian, but nothing reaches the interior.
    end = torch.tensor([part_width, part_height]) + 16
    near = ((mean_px > -16) & (mean_px < end)).all(-1).nonzero()[:, 0]
    interior = _interior(top, part_height, height)[:, None] & _interior(left, part_width, width)
    shape = (1, part_height, part_width)
    generator = torch.Generator().manual_seed(0)
    part_cameras = dataclasses.replace(
        cameras,
        principal_point_px=cameras.principal_point_px - torch.tensor([left, top]),
        width=part_width,
        height=part_height,
    )
    part = Scene(
        to(GaussianSet(**{k: v[:, near] for k, v in vars(gaussians).items()}), torch.float64),
        to(part_cameras, torch.float64),
        torch.zeros(3, dtype=torch.float64),
        torch.randn(*shape, 3, generator=generator).double(),
        torch.zeros(*shape, 1, dtype=torch.float64),
    )
    # A pixel's place in a large image is known to 2^-13 px.
    mask = (settled_pixels(part, 2e-3) & interior[..., None]).double()
    expected, expected_grads = render_and_differentiate(part, torch.float64, "reference", mask)
    assert (expected.alpha * mask).max() > 0.3
    image_grad = torch.zeros(1, height, width, 3)
    inside = (slice(None), slice(top, top + part_height), slice(left, left + part_width))
    image_grad[inside] = (part.image_grad * mask).float()
    rendered, grads = _gradients(gaussians, cameras, image_grad)
    assert rendered.image.shape == (1, height, width, 3)
    assert ((rendered.image[inside] - expected.image) * mask).abs().max() < 5e-4
    assert ((rendered.alpha[inside] - expected.alpha) * mask).abs().max() < 5e-4
    others = torch.ones(gaussians.means.shape[1], dtype=torch.bool)
    others[near] = False
    for attribute in ATTRIBUTES:
        got = grads[attribute]
        assert relative_l2(got[:, near].double(), expected_grads[attribute]) < 3e-3, attribute
        assert (got[:, others] == 0).all()


@pytest.mark.usefixtures("instruction_set")
def test_one_to_sixteen_threads_give_the_same_bits():
    scene = random_scene(
        4, width=203, height=141, batch=3, count=1200, num_cameras=3, shared=("opacities", "means")
    )
    gaussians, cameras = in_float32(scene)
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 3, 5, 8, 16, 2):
            torch.set_num_threads(count)
            rendered, grads = render_and_differentiate(scene, torch.float32, "cpu")
            average = weighted_color_average(gaussians, cameras, rendered.image.float())
            results.append({**vars(rendered), **grads, **vars(average)})
    finally:
        torch.set_num_threads(threads)
    for result in results[1:]:
        for name, value in results[0].items():
            if name != "background":  # torch sums it
                assert torch.equal(result[name], value), name


COUNT = 500_000


@pytest.mark.slow
def test_half_a_million_gaussians_obey_euler():
    """Gradients as sums that scalings of the scene make known, for every Gaussian."""
    gaussians, cameras = _plane_scene(512, 509, COUNT, seed=2, radius_px=(0.3, 1.5))
    generator = torch.Generator().manual_seed(0)
    image_grad = torch.randn(1, cameras.height, cameras.width, 3, generator=generator)
    rendered, grads = _gradients(gaussians, cameras, image_grad)
    for value in (*vars(rendered).values(), *grads.values()):
        assert torch.isfinite(value).all()
    visible = torch.as_tensor(rendered.visibility) > 0
    assert visible.sum() > 100_000
    for name, grad in grads.items():
        rows = grad.reshape(1, COUNT, -1)
        assert (rows[~visible] == 0).all(), name
        assert (rows[visible] != 0).any(-1).double().mean() > 0.9, name
    # The image is linear in the colours: their part of the loss is all of it.
    loss = (image_grad.double() * rendered.image).sum()
    linear = (grads["colors"].double() * gaussians.colors).sum()
    scale = (image_grad.double() * rendered.image).abs().sum()
    assert (linear - loss).abs() < 1e-6 * scale
    # Seen from the origin, a Gaussian twice as large and twice as far is the same.
    shares = [grads[name] * getattr(gaussians, name) for name in ("means", "scales")]
    along = sum(share.sum(-1) for share in shares)
    size = sum(share.norm(dim=-1) for share in shares)
    assert along.norm() < 1e-4 * size.norm()
    # The length of a quaternion has no meaning.
    along = (grads["quats_wxyz"] * gaussians.quats_wxyz).sum(-1)
    size = grads["quats_wxyz"].norm(dim=-1) * gaussians.quats_wxyz.norm(dim=-1)
    assert along.norm() < 1e-5 * size.norm()


@pytest.mark.slow
@pytest.mark.usefixtures("instruction_set")
def test_half_a_million_unseen_gaussians_change_nothing():
    few, cameras = _plane_scene(251, 197, 1000, seed=3)
    many, _ = _plane_scene(251, 197, COUNT, seed=4)
    rows = {name: value.clone() for name, value in vars(many).items()}
    unseen = torch.arange(COUNT)
    rows["opacities"][:, unseen % 4 == 0] = 0.5 / 255  # transparent
    rows["means"][:, unseen % 4 == 1, 2] *= -1  # behind the camera
    rows["means"][:, unseen % 4 == 2, 0] += 5  # outside the image
    rows["quats_wxyz"][:, unseen % 4 == 3] = 0  # without an orientation
    places = torch.randperm(COUNT, generator=torch.Generator().manual_seed(0))[:1000].sort().values
    for name, row in rows.items():
        row[:, places] = getattr(few, name)
    image_grad = torch.randn(1, 197, 251, 3, generator=torch.Generator().manual_seed(1))
    expected, expected_grads = _gradients(few, cameras, image_grad)
    rendered, grads = _gradients(GaussianSet(**rows), cameras, image_grad)
    assert torch.equal(rendered.image, expected.image)
    assert torch.equal(rendered.alpha, expected.alpha)
    hidden = torch.ones(COUNT, dtype=torch.bool)
    hidden[places] = False
    for name in ATTRIBUTES:
        assert torch.equal(grads[name][:, places], expected_grads[name]), name
        assert (grads[name][:, hidden] == 0).all()


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize(
    ("side_px", "count", "radius_px"),
    [(12, 9000, (0.3, 0.6)), (32, 700, (12.0, 40.0))],
    ids=["more groups than are kept", "more pixels than are kept"],
)
def test_a_tile_fuller_than_what_is_kept_of_it_matches_reference(side_px, count, radius_px):
    """So faint that light comes through all of them: the last ones are drawn again backwards."""
    gaussians, cameras = _plane_scene(side_px, side_px, count, seed=5, radius_px=radius_px)
    gaussians.opacities.mul_(0.004).add_(0.0045)
    generator = torch.Generator().manual_seed(6)
    size = (1, side_px, side_px)
    scene = Scene(
        to(gaussians, torch.float64),
        to(cameras, torch.float64),
        torch.rand(3, generator=generator, dtype=torch.float64),
        torch.randn(*size, 3, generator=generator, dtype=torch.float64),
        torch.randn(*size, 1, generator=generator, dtype=torch.float64),
    )
    expected = expect(scene, least_settled=0.3)
    assert (1 - expected.rendered.alpha).amin() > 1e-3
    assert_agrees(expected, "cpu")


BATCH, LIMIT_MB = 10, 40

# The high-water mark is of this process's own memory; getrusage's would be at least the parent's.
PROGRAM = f"""
import torch

from rgbavatar_ns.bench.scenes import ellipsoid_scene, leaf_gaussians
from rgbavatar_ns.kernels import rasterize


def resident_mb(which):
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(which)) / 1024


def draw(gaussians, cameras):
    rasterize(leaf_gaussians(gaussians), cameras, backend="cpu").image.sum().backward()


torch.set_num_threads(2)
draw(*ellipsoid_scene(100, 16, {BATCH}))
inputs = ellipsoid_scene(60_000, 512, {BATCH})
before = resident_mb("VmRSS")
draw(*inputs)
print((resident_mb("VmHWM") - before) / {BATCH})
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's /proc")
def test_an_image_and_its_gradients_take_less_than_40_mb():
    output = subprocess.check_output([sys.executable, "-c", PROGRAM], text=True, timeout=120)
    growth_mb = float(output)
    # Outputs and gradients alone are 8 MB.
    assert 8 < growth_mb < LIMIT_MB
