import math

import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.model.blendshapes import color_from_feature
from rgbavatar_ns.avatar.training import TrainingBatch, TrainingOptions, TrainingStep
from rgbavatar_ns.avatar.training.color_init import (
    WEIGHT_THRESHOLD,
    FirstColors,
    FirstColorsKind,
    is_seen_well,
    mean_color,
    sums_of,
)
from rgbavatar_ns.kernels import GaussianSet
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from rgbavatar_ns.kernels.types import SIGHT_UNIT
from tests.avatar.small_head import front_camera, random_theta

BLACK = torch.zeros(1, 3)


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


def initialise(avatar: Avatar, theta, camera, rgba, backend: str = "auto") -> int:
    """Give first colours by a pass of its own; how many got one."""
    before = int(avatar.color_initialized.sum())
    colors, background = FirstColors(avatar), torch.zeros(len(theta), 3)
    colors.give(colors.seen_in(theta, camera, rgba, background, backend=backend))
    return int(avatar.color_initialized.sum()) - before


def grey(avatar: Avatar) -> Avatar:
    """As before training."""
    torch.nn.init.zeros_(avatar.blendshapes.color_feature)
    return avatar


def random_pictures(count: int, size: int) -> torch.Tensor:
    """8-bit RGBA, with a stripe that nobody filmed."""
    generator = torch.Generator().manual_seed(3)
    rgba = torch.randint(0, 256, (count, size, size, 4), generator=generator, dtype=torch.uint8)
    rgba[:, size // 2 : size // 2 + 3] = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8)
    return rgba


def test_a_constant_image_gives_its_color():
    sums = sums_of(one_gaussian(0.8), front_camera(100), images([0.2, 0.4, 0.9, 1.0]), BLACK)
    torch.testing.assert_close(mean_color(sums), torch.tensor([[0.2, 0.4, 0.9]]))
    assert is_seen_well(sums).all()


def test_each_pixel_counts_by_its_matte():
    # Left half: opaque red. Right half: half transparent blue. By hand: (1 r + .5 b) / 1.5.
    picture = images([0.0, 0.0, 1.0, 0.5])
    picture[:, :, :50] = torch.tensor([1.0, 0.0, 0.0, 1.0])
    sums = sums_of(one_gaussian(0.8), front_camera(100), picture, BLACK)
    expected = torch.tensor([[2 / 3, 0.0, 1 / 3]])
    torch.testing.assert_close(mean_color(sums), expected, atol=1e-4, rtol=0)


def test_a_gaussian_over_background_alone_is_not_estimated():
    sums = sums_of(one_gaussian(0.8), front_camera(100), images([0.2, 0.4, 0.9, 0.0]), BLACK)
    assert not is_seen_well(sums).any()


@pytest.mark.parametrize(
    ("opacity", "seen"), [(WEIGHT_THRESHOLD * 0.95, False), (WEIGHT_THRESHOLD * 1.1, True)]
)
def test_the_blending_weight_must_exceed_the_threshold(opacity, seen):
    # A pixel's centre lies .5 pixels off the Gaussian's mean of 4 pixels deviation: < 2 % less.
    sums = sums_of(one_gaussian(opacity), front_camera(100), images([0.5] * 3 + [1.0]), BLACK)
    assert bool(is_seen_well(sums)) is seen


def test_the_weight_is_alpha_times_transmittance():
    # Behind one of opacity .99 and five times its size, a Gaussian of .9 weighs below .04.
    pair = one_gaussian(0.9, count=2)
    pair.means[0, 1, 2] = -0.02
    pair.scales[0, 0], pair.opacities[0, 0] = 0.05, 0.99
    sums = sums_of(pair, front_camera(100), images([0.5] * 3 + [1.0]), BLACK)
    assert is_seen_well(sums).tolist() == [True, False]


def test_sums_run_over_the_batch():
    camera = front_camera(100)
    pictures = torch.cat((images([0.2, 0.2, 0.2, 1.0]), images([0.8, 0.8, 0.8, 1.0])))
    sums = sums_of(one_gaussian(0.5), camera, pictures, BLACK.expand(2, 3))
    torch.testing.assert_close(mean_color(sums), torch.full((1, 3), 0.5))


def test_colors_are_initialised_once_and_nothing_else_changes(make_avatar):
    avatar = grey(make_avatar(random=True))
    camera, theta = front_camera(48), random_theta(avatar.layout, 2)
    before = {name: p.detach().clone() for name, p in avatar.named_parameters()}
    count = initialise(avatar, theta, camera, images([0.2, 0.4, 0.9, 1.0], 48, 2))
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

    again = initialise(avatar, theta, camera, images([0.9, 0.1, 0.1, 1.0], 48, 2))
    assert again == 0
    torch.testing.assert_close(color_from_feature(avatar.blendshapes.color_feature), colors)


def test_gaussians_seen_later_are_initialised_later(make_avatar):
    avatar = make_avatar()
    with torch.no_grad():
        avatar.blendshapes.opacity_logit[:50] = math.log(0.05 / 0.95)
    camera, theta = front_camera(48), torch.zeros(1, avatar.layout.size)
    initialise(avatar, theta, camera, images([0.2, 0.4, 0.9, 1.0], 48))
    assert not avatar.color_initialized[:50].any()
    grey = color_from_feature(avatar.blendshapes.color_feature)[:50]
    torch.testing.assert_close(grey, torch.full((50, 3), 0.5))
    with torch.no_grad():
        avatar.blendshapes.opacity_logit[:50] = 3.0
    assert initialise(avatar, theta, camera, images([0.9, 0.1, 0.1, 1.0], 48)) > 0
    late = avatar.color_initialized[:50]
    colors = color_from_feature(avatar.blendshapes.color_feature)[:50][late]
    torch.testing.assert_close(colors, torch.tensor([0.9, 0.1, 0.1]).expand_as(colors))


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
        assert initialise(avatar, theta, camera, rgba, backend) > 0
        assert torch.equal(before, rgba)
        features.append((avatar.color_initialized, avatar.blendshapes.color_feature.detach()))
    (seen, colors), (expected_seen, expected_colors) = features
    assert torch.equal(seen, expected_seen)
    torch.testing.assert_close(colors, expected_colors, atol=2e-4, rtol=0)


@pytest.mark.parametrize("kind", ["matted", "paper"])
def test_a_step_sums_what_a_pass_of_its_own_does(make_avatar, kind: FirstColorsKind):
    """Over the first two of three pictures, for those that wait and are shown; others stay at 0."""
    avatar, size = make_avatar(random=True), 48
    camera, theta, rgba = front_camera(size), random_theta(avatar.layout, 3), random_pictures(3, 48)
    background = torch.rand(3, 3, generator=torch.Generator().manual_seed(4))
    avatar.color_initialized[::3] = True
    colors = FirstColors(avatar, kind)
    sight = colors.sight(2)
    renderer = avatar.renderer(theta, camera)
    if renderer is None or sight is None:
        pytest.skip("the compiled CPU extension is not there")
    renderer.forward_loss(rgba, background, sight)
    found = sight.sums.double() * SIGHT_UNIT
    expected = colors.seen_in(theta[:2], camera, rgba[:2], background[:2]).double()
    expected[::3] = 0
    assert int(is_seen_well(expected).sum()) > 30
    expected[expected[:, 4] <= WEIGHT_THRESHOLD] = 0
    assert sorted(sight.shown) == expected[:, 4].nonzero()[:, 0].tolist()
    torch.testing.assert_close(found, expected, atol=2e-6, rtol=2e-6)


def test_sums_are_the_same_with_any_number_of_threads(make_avatar):
    avatar = make_avatar(random=True)
    camera, theta, rgba = front_camera(96), random_theta(avatar.layout, 3), random_pictures(3, 96)
    found, threads = [], torch.get_num_threads()
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            renderer, sight = avatar.renderer(theta, camera), FirstColors(avatar).sight(3)
            if renderer is None or sight is None:
                pytest.skip("the compiled CPU extension is not there")
            renderer.forward_loss(rgba, torch.zeros(3, 3), sight)
            found.append(sight.sums)
    finally:
        torch.set_num_threads(threads)
    assert found[0].any()
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


def test_over_its_background_a_picture_colors_by_both():
    # Half transparent red over blue, by hand: (.5, 0, .5).
    picture, blue = images([1.0, 0.0, 0.0, 0.5]), torch.tensor([[0.0, 0.0, 1.0]])
    sums = sums_of(one_gaussian(0.8), front_camera(100), picture, blue, "paper")
    torch.testing.assert_close(mean_color(sums), torch.tensor([[0.5, 0.0, 0.5]]))


@pytest.mark.parametrize("fast", [True, False])
def test_every_gaussian_is_initialised_in_the_first_step_that_shows_it(make_avatar, fast):
    """A stream of turns: what any step draws with a weight above .1 has its colour after it."""
    avatar, size = make_avatar(random=True), 48
    with torch.no_grad():
        # Faint ones, which training makes opaque at some time.
        avatar.blendshapes.opacity_logit[::2] = math.log(0.06 / 0.94)
    camera, rgba = front_camera(size), images([0.3, 0.5, 0.8, 1.0], size, 2)
    rgba = (rgba * 255).round().to(torch.uint8)
    step = TrainingStep(avatar, options=TrainingOptions(fast=fast, surface_prior=False))
    counts = []
    for number in range(12):
        theta = random_theta(avatar.layout, 2, seed=number)
        drawn = avatar.gaussians(theta)
        shown = sums_of(drawn, camera, rgba, torch.zeros(2, 3))
        # A weight within rounding of the threshold may fall on either side.
        clearly = is_seen_well(shown - torch.tensor([0, 0, 0, 0, 1e-4]))
        had = avatar.color_initialized.clone()
        step(TrainingBatch(theta, camera, rgba), number)
        assert avatar.color_initialized[clearly].all()
        assert not (avatar.color_initialized & ~had & (shown[:, 4] < WEIGHT_THRESHOLD - 1e-4)).any()
        counts.append(int(avatar.color_initialized.sum()))
    assert counts[0] < counts[5] < counts[-1]


@pytest.mark.parametrize("kind", ["matted", "paper"])
def test_a_color_learned_from_faint_sights_stays_but_in_the_paper(
    make_avatar, kind: FirstColorsKind
):
    """Ten Gaussians whose colours steps have moved from grey, ten that one step has moved."""
    avatar = make_avatar(initial_color=0.3)
    colors, feature = FirstColors(avatar, kind), avatar.blendshapes.color_feature
    bright = torch.zeros(avatar.num_gaussians, 5)
    bright[:20] = torch.tensor([0.4, 0.8, 1.2, 2.0, 0.5])
    with torch.no_grad():
        feature[:10, 1] += 0.1
        feature[10:20] -= 0.0125
    before = feature.detach().clone()
    colors.give(bright)
    assert avatar.color_initialized.tolist() == [True] * 20 + [False] * (avatar.num_gaussians - 20)
    given = color_from_feature(feature.detach())
    replaced = 0 if kind == "paper" else 10
    mean = torch.tensor([0.2, 0.4, 0.6]).expand(20 - replaced, 3)
    torch.testing.assert_close(given[replaced:20], mean)
    assert torch.equal(feature[:replaced], before[:replaced])
    assert torch.equal(feature[20:], before[20:])


def test_a_look_back_finds_what_the_last_step_brought_to_light(make_avatar):
    """Its update lifts a faint Gaussian above the threshold; no step draws it any more."""
    avatar, size = grey(make_avatar(random=True)), 48
    theta, camera = random_theta(avatar.layout, 2), front_camera(size)
    rgba = (images([0.3, 0.5, 0.8, 1.0], size, 2) * 255).round().to(torch.uint8)
    step = TrainingStep(avatar, options=TrainingOptions(surface_prior=False))
    with torch.no_grad():
        avatar.blendshapes.opacity_logit.fill_(math.log(0.02 / 0.98))
    batch = TrainingBatch(theta, camera, rgba)
    step(batch, 0)
    assert not avatar.color_initialized.any()
    with torch.no_grad():
        avatar.blendshapes.opacity_logit.fill_(3.0)
    before = {name: value.detach().clone() for name, value in avatar.named_parameters()}
    shown = is_seen_well(sums_of(avatar.gaussians(theta), camera, rgba, torch.zeros(2, 3)))
    assert step.look_back([batch])
    assert torch.equal(avatar.color_initialized, shown)
    for name, value in avatar.named_parameters():
        changed = (value != before[name]).flatten(1).any(1) if name.endswith("feature") else None
        if changed is None:
            assert torch.equal(value, before[name]), name
        elif not name.endswith("basis_color_feature"):
            assert torch.equal(changed, shown)
    assert not step.look_back([batch])
    assert not step.look_back([])
