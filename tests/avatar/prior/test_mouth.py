"""The mouth is seen through the lips alone, and what nobody saw in it is dark."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.model.blendshapes import color_from_feature, feature_from_color
from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.avatar.prior.mouth import HiddenMouth, within_polygon
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from tests.head.test_mouth import seen_from_before

from .test_mesh_field import embedded_avatar
from .test_outline import drawn_thicker, front_camera, turned
from .test_surface_prior import STEPS


@pytest.fixture
def avatar():
    return embedded_avatar(uv_resolution=96)


@pytest.fixture
def mouth(avatar) -> HiddenMouth:
    found = HiddenMouth.of(avatar, MeshField(avatar))
    assert found is not None
    return found


def test_points_lie_within_a_polygon_as_opencv_says():
    random = np.random.default_rng(3)
    angle = np.sort(random.uniform(0, 2 * np.pi, (4, 20)), 1)
    radius = random.uniform(0.3, 1.0, (4, 20))
    polygons = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1).astype(np.float32)
    points = random.uniform(-1, 1, (4, 300, 2)).astype(np.float32)
    found = within_polygon(torch.from_numpy(points), torch.from_numpy(polygons))
    for polygon, inside, places in zip(polygons, found, points):
        expected = [cv2.pointPolygonTest(polygon, place.tolist(), False) > 0 for place in places]
        assert 30 < sum(expected) < 270
        assert inside.tolist() == expected


@pytest.mark.parametrize("turn_degrees", [0.0, 12.0])
def test_what_lies_behind_the_lips_counts_only_where_they_are_open(avatar, mouth, turn_degrees):
    theta = turned(avatar, [turn_degrees, turn_degrees])
    theta[1, avatar.layout.slice("jaw").start] = 0.35
    shown_px = torch.rand(2, avatar.num_gaussians)
    vertices = avatar.carrier_vertices(theta)
    closed, opened = mouth.through_lips(shown_px, vertices, front_camera()).unbind(0)
    outside = torch.ones(avatar.num_gaussians, dtype=torch.bool)
    outside[mouth.gaussians] = False
    assert torch.equal(closed[outside], shown_px[0, outside])
    assert torch.equal(opened[outside], shown_px[1, outside])
    # The lips may have been apart by a millimetre, through which hardly anything is seen.
    assert float((closed[mouth.gaussians] > 0).float().mean()) < 0.1
    through = opened[mouth.gaussians] > 0
    assert 0.15 < float(through.float().mean()) < 0.8
    assert torch.equal(opened[mouth.gaussians][through], shown_px[1, mouth.gaussians][through])


@pytest.mark.parametrize("jaw_rad", [0.0, 0.2, 0.4])
def test_nobody_in_front_sees_what_is_left_out_behind_the_lips(avatar, mouth, jaw_rad):
    corners, barycentric = avatar.anchors.corners()
    nearest = corners.gather(1, barycentric.argmax(1, keepdim=True))[:, 0]
    backs = nearest[mouth.backs].unique()
    assert len(backs) > 50
    assert not seen_from_before(avatar.head, jaw_rad, backs.numpy()).any()


def test_guesses_are_the_skins_colour_in_the_dark_and_give_way_to_what_is_seen(mouth):
    skin = torch.tensor([0.8, 0.6, 0.5])
    nothing = torch.zeros(len(mouth.weight))
    told = feature_from_color(skin).expand(len(nothing), 3)
    face = (mouth.weight == 0).float()
    found, sure = mouth.guessed(told, face)
    assert torch.allclose(found[face > 0], told[face > 0])
    deep = mouth.weight == mouth.weight.max()
    expected = mouth.guess * skin
    assert torch.allclose(color_from_feature(found[deep]), expected[deep], atol=1e-5)
    assert torch.equal(sure[face > 0], face[face > 0])
    cavity = color_from_feature(found[deep & (mouth.guess[:, 0] < 0.5)])
    assert float((cavity / skin).max()) < 0.4
    known, _ = mouth.guessed(told, nothing + 5)
    assert float((color_from_feature(known) - skin).abs().max()) < 0.01


def test_a_mouth_that_never_opened_is_dark_within(avatar, mouth):
    theta = turned(avatar, [-8.0, 0.0, 8.0])
    images = drawn_thicker(avatar, theta, 0.0)
    prior, shapes = SurfacePrior(avatar), avatar.blendshapes
    prior.begin(avatar, theta, front_camera(), images)
    shapes.color_feature.data.copy_(feature_from_color(torch.tensor([0.8, 0.6, 0.5])))
    # Skin that is half clear shows all that lies behind it.
    shapes.opacity_logit.data.fill_(0.0)
    for step in STEPS:
        prior.look(avatar, theta, front_camera(), images)
        prior.pull(avatar, step)
    colors = color_from_feature(shapes.color_feature.detach())
    seen = prior.clear_px > 0.5
    assert int(seen.sum()) > 100
    assert float(seen[mouth.gaussians].float().mean()) < 0.05
    assert float((colors[seen] - colors.new_tensor([0.8, 0.6, 0.5])).abs().max()) < 0.02
    inside = mouth.in_cavity > 0.99
    assert float(colors[inside].mean(1).median()) < 0.3
    # It is not sunk into the lips, and what faces them from behind is clear.
    outwards = MeshField(avatar).outwards
    assert float((shapes.position[inside] * outwards[inside]).sum(1).min()) > 0
    assert float((shapes.opacity_logit[mouth.backs] < -5).float().mean()) > 0.9
    assert float((shapes.opacity_logit[inside & ~mouth.backs] > 1).float().mean()) > 0.9


def test_lips_are_parted_by_expressions_that_carry_no_gaussian(monkeypatch):
    plain = embedded_avatar()
    avatar = Avatar(plain.head, plain.identity, replace(plain.config, carrier="joints"))
    theta = turned(avatar, [0.0, 5.0])
    part, names = avatar.layout.slice("expression"), avatar.head.arrays.expression_names
    theta[1, part.start + names.index("mouthUpperUpLeft")] = 1.0
    prior, given = SurfacePrior(avatar), []
    images = drawn_thicker(avatar, theta, 0.0)
    prior.begin(avatar, theta, front_camera(), images)

    def through(mouth, shown_px, vertices, cameras):
        given.append(vertices)
        return shown_px

    monkeypatch.setattr(HiddenMouth, "through_lips", through)
    prior.look(avatar, theta, front_camera(), images)
    assert torch.equal(given[0], avatar.head(theta, avatar.identity))
    assert not torch.equal(given[0][1], avatar.carrier_vertices(theta)[1])


def test_with_nothing_filmed_there_is_no_colour_to_guess_by(avatar, mouth):
    theta = turned(avatar, [0.0])
    images = drawn_thicker(avatar, theta, 0.0)
    nobody = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8).expand_as(images).contiguous()
    prior = SurfacePrior(avatar)
    prior.begin(avatar, theta, front_camera(), images)
    for step in STEPS[:3]:
        prior.look(avatar, theta, front_camera(), nobody)
        prior.pull(avatar, step)
    assert avatar.blendshapes.color_feature.isfinite().all()
