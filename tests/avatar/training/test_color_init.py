import math

import pytest
import torch

from rgbavatar_ns.avatar.model.blendshapes import color_from_feature
from rgbavatar_ns.avatar.training.color_init import (
    WEIGHT_THRESHOLD,
    ColorInitSchedule,
    estimate_colors,
    initialize_colors,
)
from rgbavatar_ns.kernels import GaussianSet
from tests.avatar.small_head import front_camera, random_theta


def one_gaussian(opacity: float, x_m: float = 0.0, count: int = 1) -> GaussianSet:
    """Gaussians of 1 cm (4 pixels of a 100-pixel camera) in the middle of the picture."""
    return GaussianSet(
        means=torch.tensor([[[x_m, 0.0, 0.0]]]).repeat(1, count, 1),
        quats_wxyz=torch.tensor([[[1.0, 0, 0, 0]]]).repeat(1, count, 1),
        scales=torch.full((1, count, 3), 0.01),
        opacities=torch.full((1, count), opacity),
        colors=torch.zeros(1, count, 3),
    )


def images(rgba, size: int = 100, batch: int = 1) -> torch.Tensor:
    return torch.tensor(rgba).expand(batch, size, size, 4).clone()


def test_a_constant_image_gives_its_color():
    estimate = estimate_colors(one_gaussian(0.8), front_camera(100), images([0.2, 0.4, 0.9, 1.0]))
    torch.testing.assert_close(estimate.color, torch.tensor([[0.2, 0.4, 0.9]]))
    assert estimate.reliable.all()


def test_each_pixel_counts_by_its_matte():
    # Left half: opaque red. Right half: half transparent blue. By hand: (1 r + .5 b) / 1.5.
    picture = images([0.0, 0.0, 1.0, 0.5])
    picture[:, :, :50] = torch.tensor([1.0, 0.0, 0.0, 1.0])
    estimate = estimate_colors(one_gaussian(0.8), front_camera(100), picture)
    expected = torch.tensor([[2 / 3, 0.0, 1 / 3]])
    torch.testing.assert_close(estimate.color, expected, atol=1e-4, rtol=0)


def test_a_gaussian_over_background_alone_is_not_estimated():
    estimate = estimate_colors(one_gaussian(0.8), front_camera(100), images([0.2, 0.4, 0.9, 0.0]))
    assert not estimate.reliable.any()


@pytest.mark.parametrize(
    ("opacity", "seen"), [(WEIGHT_THRESHOLD * 0.95, False), (WEIGHT_THRESHOLD * 1.1, True)]
)
def test_the_blending_weight_must_exceed_the_threshold(opacity, seen):
    # A pixel's centre lies .5 pixels off the Gaussian's mean of 4 pixels deviation: < 2 % less.
    estimate = estimate_colors(one_gaussian(opacity), front_camera(100), images([0.5] * 3 + [1.0]))
    assert bool(estimate.reliable) is seen


def test_the_weight_is_alpha_times_transmittance():
    # Behind one of opacity .99 and five times its size, a Gaussian of .9 weighs below .04.
    pair = one_gaussian(0.9, count=2)
    pair.means[0, 1, 2] = -0.02
    pair.scales[0, 0], pair.opacities[0, 0] = 0.05, 0.99
    estimate = estimate_colors(pair, front_camera(100), images([0.5] * 3 + [1.0]))
    assert estimate.reliable.tolist() == [True, False]


def test_sums_run_over_the_batch():
    camera = front_camera(100)
    pictures = torch.cat((images([0.2, 0.2, 0.2, 1.0]), images([0.8, 0.8, 0.8, 1.0])))
    estimate = estimate_colors(one_gaussian(0.5), camera, pictures)
    torch.testing.assert_close(estimate.color, torch.full((1, 3), 0.5))


def test_colors_are_initialised_once_and_nothing_else_changes(make_avatar):
    avatar = make_avatar(random=True)
    camera, theta = front_camera(48), random_theta(avatar.layout, 2)
    before = {name: p.detach().clone() for name, p in avatar.named_parameters()}
    count = initialize_colors(avatar, theta, camera, images([0.2, 0.4, 0.9, 1.0], 48, 2))
    fresh = avatar.color_initialized.clone()
    assert 0 < count < avatar.num_gaussians
    assert count == int(fresh.sum())
    colors = color_from_feature(avatar.blendshapes.color_feature.detach())
    expected = torch.tensor([0.2, 0.4, 0.9]).expand(count, 3)
    torch.testing.assert_close(colors[fresh], expected)
    for name, parameter in avatar.named_parameters():
        if name == "blendshapes.color_feature":
            assert torch.equal(parameter[~fresh], before[name][~fresh])
        else:
            assert torch.equal(parameter, before[name]), name

    again = initialize_colors(avatar, theta, camera, images([0.9, 0.1, 0.1, 1.0], 48, 2))
    assert again == 0
    torch.testing.assert_close(color_from_feature(avatar.blendshapes.color_feature), colors)


def test_gaussians_seen_later_are_initialised_later(make_avatar):
    avatar = make_avatar()
    with torch.no_grad():
        avatar.blendshapes.opacity_logit[:50] = math.log(0.05 / 0.95)
    camera, theta = front_camera(48), torch.zeros(1, avatar.layout.size)
    initialize_colors(avatar, theta, camera, images([0.2, 0.4, 0.9, 1.0], 48))
    assert not avatar.color_initialized[:50].any()
    grey = color_from_feature(avatar.blendshapes.color_feature)[:50]
    torch.testing.assert_close(grey, torch.full((50, 3), 0.5))
    with torch.no_grad():
        avatar.blendshapes.opacity_logit[:50] = 3.0
    assert initialize_colors(avatar, theta, camera, images([0.9, 0.1, 0.1, 1.0], 48)) > 0
    late = avatar.color_initialized[:50]
    colors = color_from_feature(avatar.blendshapes.color_feature)[:50][late]
    torch.testing.assert_close(colors, torch.tensor([0.9, 0.1, 0.1]).expand_as(colors))


def test_the_schedule_is_dense_first_and_sparse_later():
    schedule = ColorInitSchedule(every_step_until=3, interval=10, regular_until=40)
    due = [step for step in range(400) if schedule.due(step)]
    assert due == [0, 1, 2, 10, 20, 30, 40, 80, 160, 320]
    # As every second per cent of a long run would be.
    assert sum(map(ColorInitSchedule().due, range(5000))) < 0.01 * 5000


@pytest.mark.parametrize("scale_with_triangle", [False, True])
def test_the_compiled_way_gives_the_same_colors(make_avatar, scale_with_triangle):
    """The blended renderer's sums against those over world-space Gaussians, 8 bit and float."""
    camera, size = front_camera(48), 48
    pictures = torch.randint(
        0, 256, (3, size, size, 4), generator=torch.Generator().manual_seed(3), dtype=torch.uint8
    )
    features = []
    for backend, rgba in (("auto", pictures), ("reference", pictures / 255)):
        avatar = make_avatar(random=True, scale_with_triangle=scale_with_triangle)
        theta = random_theta(avatar.layout, 3)
        before = rgba.clone()
        assert initialize_colors(avatar, theta, camera, rgba, backend=backend) > 0
        assert torch.equal(before, rgba)
        features.append((avatar.color_initialized, avatar.blendshapes.color_feature.detach()))
    (seen, colors), (expected_seen, expected_colors) = features
    assert torch.equal(seen, expected_seen)
    torch.testing.assert_close(colors, expected_colors, atol=2e-4, rtol=0)
