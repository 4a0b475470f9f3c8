"""Hair that nobody filmed: strands along its fall, the stronger the film's are, in its hue."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from rgbavatar_ns.avatar.model.blendshapes import color_from_feature, feature_from_color
from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.avatar.prior.outline import measure_outline
from rgbavatar_ns.avatar.prior.strands import Strands
from rgbavatar_ns.head.arrays import EMBEDDED_BUST, EMBEDDED_HEAD
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA

from .test_mesh_field import embedded_avatar
from .test_outline import SIZE, drawn_thicker, front_camera, turned
from .test_surface_prior import STEPS

M_OF_PX = 1.0 / 900
"""Of the hair's border, .1 m nearer than the head's middle."""


def _strands(**settings):
    avatar = embedded_avatar(**settings)
    field = MeshField(avatar)
    return avatar, field, Strands.of(avatar, field)


def _places(avatar) -> torch.Tensor:
    rest = avatar.carrier_vertices(torch.zeros(1, avatar.layout.size))
    return avatar.anchors.origins(rest)[0]


@pytest.mark.parametrize("name", [EMBEDDED_HEAD, EMBEDDED_BUST])
def test_hair_is_behind_and_above_and_no_face_has_strands(name: str):
    avatar, _, strands = _strands(name=name, uv_resolution=96)
    place, pattern = _places(avatar), strands.pattern
    assert bool((pattern[strands.haired == 0] == 0).all())
    back = (place[:, 2] < -0.06) & (place[:, 1] > 0.0)
    face, below = place[:, 2] > 0.04, place[:, 1] < -0.1
    assert float(strands.haired[back].mean()) > 0.97  # but at an ear
    assert float(strands.haired[face | below].max()) == 0
    # Lighter as often as darker, in all of it.
    assert abs(float(pattern[back].mean())) < 0.3 * float(pattern[back].std())


def test_strands_are_longer_than_wide_and_fall_from_the_crown():
    avatar, _, strands = _strands(uv_resolution=192)
    hair = (strands.haired == 1).numpy()
    place, pattern = _places(avatar).numpy()[hair], strands.pattern.numpy()[hair]
    # The back of the head, where hair falls straight down.
    back = (place[:, 2] < np.quantile(place[:, 2], 0.4)) & (place[:, 1] < 0.03)
    place, pattern = place[back], pattern[back]
    first, second = KDTree(place).query_pairs(7e-3, output_type="ndarray").T
    way = place[second] - place[first]
    far = np.linalg.norm(way, axis=1) > 5e-3
    steep = np.abs(way[:, 1]) / np.linalg.norm(way, axis=1)

    def alike(chosen: np.ndarray) -> float:
        return float(np.corrcoef(pattern[first[chosen]], pattern[second[chosen]])[0, 1])

    down, across = far & (steep > 0.9), far & (steep < 0.3)
    assert min(down.sum(), across.sum()) > 50
    assert alike(down) > alike(across) + 0.25


def test_a_contrast_changes_light_alone_and_none_changes_nothing():
    avatar, _, strands = _strands()
    feature = feature_from_color(0.1 + 0.5 * torch.rand(avatar.num_gaussians, 3))
    assert torch.allclose(strands.drawn(feature, torch.tensor(0.0)), feature, atol=1e-6)
    before = color_from_feature(feature)
    after = color_from_feature(strands.drawn(feature, torch.tensor(0.1)))
    expected = before * (1 + 0.1 * strands.pattern[:, None])
    assert torch.allclose(after, expected, atol=1e-6)
    assert float((after - before).abs().max()) > 0.02


def test_what_is_hardly_seen_beside_ears_is_not_taken_for_hair():
    avatar, field, strands = _strands()
    beside, places = strands.beside_ears, torch.as_tensor(avatar.head.arrays.v_template)
    assert 20 < int(beside.sum()) < 0.5 * int(field.scalp.sum())
    assert float(places[beside, 0].abs().min()) > 0.04
    most = torch.rand(field.num_vertices) * 50
    for share, tells in ((0.1, 0.0), (1.0, 1.0)):
        known = strands.known(share * most, most)
        assert torch.equal(known[~beside], (share * most)[~beside])
        assert torch.equal(known[beside], tells * (share * most)[beside])


def test_no_contrast_turns_hair_to_less_than_black():
    for settings in ({"uv_resolution": 192}, {"uv_resolution": 32, "name": EMBEDDED_BUST}):
        _, _, strands = _strands(**settings)
        assert float(strands.pattern.min()) * 0.25 > -1
        assert float(strands.pattern.max()) < 4
        assert abs(float(strands.pattern.mean())) < 1e-3


def test_a_mesh_that_is_all_face_has_no_strands(make_avatar):
    avatar = make_avatar()
    field = MeshField(avatar)
    assert not field.scalp.any()
    assert bool(Strands.of(avatar, field).pattern.isfinite().all())
    field.haired = torch.zeros_like(field.haired)
    strands = Strands.of(avatar, field)
    assert not strands.pattern.any()
    assert not strands.haired.any()


def test_colours_of_hair_are_told_by_what_is_seen_in_front_and_of_skin_by_all():
    _, _, strands = _strands()
    seen, clear, aside = (torch.full_like(strands.haired, px) for px in (1.0, 0.25, 0.75))
    told_px = strands.colored_px(seen, clear, aside)
    assert torch.allclose(told_px[strands.haired == 1], torch.tensor(0.325))  # .25 + .1 x .75
    assert torch.equal(told_px[strands.haired == 0], seen[strands.haired == 0])


def _striped(avatar, theta: torch.Tensor, share: float, period_m: float) -> torch.Tensor:
    images = drawn_thicker(avatar, theta, 0.0)
    wave = np.sin(2 * math.pi * np.arange(SIZE) * M_OF_PX / period_m)
    images[..., :3] = torch.from_numpy((120 * (1 + share * wave)).round()).to(torch.uint8)[:, None]
    return images


def test_the_films_contrast_is_that_of_a_band_of_its_light():
    avatar = embedded_avatar()
    field, theta = MeshField(avatar), turned(avatar, [-3.0, 0.0, 3.0])
    period_m, share = 0.012, 0.3
    found = measure_outline(
        avatar, field, theta, front_camera(), _striped(avatar, theta, share, period_m)
    )
    # A Gaussian's blur leaves exp(-2 (pi sigma / period)^2) of a wave, whose median is sin(pi / 4).
    fine, coarse = (math.exp(-2 * (math.pi * s / period_m) ** 2) for s in (1e-3, 6e-3))
    expected = 1.4826 * share / math.sqrt(2) * (fine - coarse)
    assert found.hair_contrast == pytest.approx(expected, rel=0.15)
    # Frames that show no hair say nothing.
    images = _striped(avatar, theta, share, period_m)
    images[:2] = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8)
    some = measure_outline(avatar, field, theta, front_camera(), images)
    assert some.hair_contrast == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("hair", [25, 60, 230])
def test_a_hairline_is_no_strand(hair: int):
    avatar = embedded_avatar()
    field, theta = MeshField(avatar), turned(avatar, [-3.0, 0.0, 3.0])
    images = drawn_thicker(avatar, theta, 0.0)
    y_m = torch.as_tensor(avatar.head.arrays.v_template)[:, 1]
    # Skin, up to three centimetres below the crown.
    border = SIZE // 2 - round(float(y_m.max() - 0.03) * 900 / 1.1)
    images[:, :border, :, :3], images[:, border:, :, :3] = hair, 170
    found = measure_outline(avatar, field, theta, front_camera(), images)
    assert found.hair_contrast < 0.03


@pytest.mark.parametrize("light", [0, 3, 128])
def test_plain_dark_and_unfilmed_hair_has_none(light: int):
    avatar = embedded_avatar()
    field, theta = MeshField(avatar), turned(avatar, [0.0, 3.0])
    images = drawn_thicker(avatar, theta, 0.0)
    noise = torch.randint(0, 2, images.shape[:3], generator=torch.Generator().manual_seed(0))
    images[..., :3] = (light + noise[..., None]).to(torch.uint8)
    assert measure_outline(avatar, field, theta, front_camera(), images).hair_contrast < 0.04
    images[:] = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8)
    assert measure_outline(avatar, field, theta, front_camera(), images).hair_contrast == 0


def test_the_back_of_a_head_has_the_strands_of_its_front():
    avatar = embedded_avatar(uv_resolution=64)
    theta = turned(avatar, [-6.0, 0.0, 6.0])
    variation = []
    for share in (0.0, 0.3):
        images = _striped(avatar, theta, share, 0.012)
        prior, shapes = SurfacePrior(avatar), avatar.blendshapes
        shapes.color_feature.data.fill_(float(feature_from_color(0.4)))
        prior.begin(avatar, theta, front_camera(), images)
        for step in STEPS[:12]:
            prior.look(avatar, theta, front_camera(), images)
            prior.pull(avatar, step)
        back = (_places(avatar)[:, 2] < -0.08) & (Strands.of(avatar, MeshField(avatar)).haired == 1)
        light = color_from_feature(shapes.color_feature.detach()).mean(1)
        variation.append(float(light[back].std() / light[back].mean()))
        forehead = (_places(avatar)[:, 2] > 0.0) & (_places(avatar)[:, 1] > 0.03)
        assert int(forehead.sum()) > 100
        assert float(light[forehead].std()) < 0.02
    assert variation[0] < 0.01
    pattern = Strands.of(avatar, MeshField(avatar)).pattern
    assert variation[1] == pytest.approx(
        float(prior.views.hair_contrast * pattern[back].std()), rel=0.1
    )
    assert variation[1] > 0.1
