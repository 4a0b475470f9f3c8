"""The surface's discs: wide enough that it closes, and what faces the film no thicker than they."""

import math

import pytest
import torch

from rgbavatar_ns.avatar.orbit import orbit
from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.prior.discs import disc_log_scale, flatten, log_overlap
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.head.arrays import EMBEDDED_BUST
from rgbavatar_ns.head.rotations import conjugate_quats_wxyz, quat_wxyz_to_matrix, turn_back
from rgbavatar_ns.head.surface import vertex_normals

from .test_mesh_field import embedded_avatar
from .test_outline import drawn_thicker, front_camera, turned


def _thickness_m(shapes, normals: torch.Tensor) -> torch.Tensor:
    axes = quat_wxyz_to_matrix(shapes.rotation_wxyz.double())
    covariance = axes @ torch.diag_embed((2 * shapes.log_scale.double()).exp()) @ axes.mT
    return torch.einsum("ni,nij,nj->n", normals.double(), covariance, normals.double()).sqrt()


def test_needles_along_the_normal_are_shortened_and_nothing_else_is(make_avatar):
    avatar = make_avatar()
    shapes, random = avatar.blendshapes, torch.Generator().manual_seed(0)
    disc = disc_log_scale(avatar)
    count = avatar.num_gaussians
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=1)
    shapes.rotation_wxyz.data.copy_(torch.randn(count, 4, generator=random))
    shapes.log_scale.data.copy_(disc + 0.8 * torch.randn(count, 3, generator=random))
    before, scales = _thickness_m(shapes, normals).detach(), shapes.log_scale.detach().clone()
    limit = 1.5 * disc[:, :2].mean(1).exp()
    share = (torch.arange(count) % 2).float()
    with torch.no_grad():
        for _ in range(12):  # what several axes make up takes several looks
            flatten(shapes, normals, disc, share)
    after = _thickness_m(shapes, normals).detach()
    thick = (before > limit) & (share > 0)
    assert 0.05 * count < int(thick.sum()) < 0.95 * count
    assert float((after / limit)[thick].max()) < 1.02
    assert torch.equal(shapes.log_scale[~thick], scales[~thick])


def test_what_lies_across_the_normal_keeps_its_length(make_avatar):
    avatar = make_avatar()
    shapes, disc = avatar.blendshapes, disc_log_scale(avatar)
    shapes.rotation_wxyz.data.zero_()[:, 0] = 1
    shapes.log_scale.data.copy_(disc + math.log(20))
    with torch.no_grad():
        flatten(shapes, torch.eye(3)[2].expand(len(disc), 3), disc, torch.ones(len(disc)))
    assert torch.allclose(shapes.log_scale[:, :2], disc[:, :2] + math.log(20))
    assert torch.allclose(shapes.log_scale[:, 2], math.log(1.5) + disc[:, :2].mean(1))


def test_what_has_no_normal_or_no_size_stays_a_number(make_avatar):
    avatar = make_avatar()
    shapes, disc = avatar.blendshapes, disc_log_scale(avatar)
    shapes.log_scale.data[::2] = -80.0
    normals = torch.eye(3)[2].repeat(len(disc), 1)
    normals[::3] = 0
    with torch.no_grad():
        flatten(shapes, normals, disc, torch.ones(len(disc)))
    assert bool(shapes.log_scale.isfinite().all())


def test_what_a_frame_shows_from_the_side_keeps_its_thickness_and_nothing_else_does():
    avatar = embedded_avatar()
    theta, camera = turned(avatar, [-3.0, 0.0, 3.0, 85.0]), front_camera()
    images = drawn_thicker(avatar, theta, 0.0)
    prior, shapes = SurfacePrior(avatar), avatar.blendshapes
    prior.begin(avatar, theta, camera, images)
    shapes.log_scale.data.copy_(disc_log_scale(avatar))
    shapes.log_scale.data[:, 2] += math.log(40)  # needles ten discs long
    prior.look(avatar, theta, camera, images)
    prior.pull(avatar, 199)
    longer = (shapes.log_scale.detach() - disc_log_scale(avatar))[:, 2].exp()
    place = avatar.anchors.origins(avatar.carrier_vertices(theta[1:2]))[0]
    face = (place[:, 2] > 0.0) & (prior.clear_px > 1)
    aside, only_clear = face & (prior.grazing_px > 1), face & (prior.grazing_px == 0)
    assert int(aside.sum()) > 10
    assert int(only_clear.sum()) > 100
    assert float(longer[aside].min()) > 30
    assert float(longer[only_clear].median()) < 10


def test_needles_along_the_view_of_a_frontal_film_go_from_lips_and_stay_at_the_sides():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    camera = front_camera()
    rest = avatar.anchors.origins(avatar.carrier_vertices(turned(avatar, [0.0])))[0]
    longer, back_m = {}, {}
    for kind, degrees in (("still", [-1.0, 0.0, 1.0]), ("turning", [-25.0, 0.0, 25.0])):
        theta = turned(avatar, degrees)
        images = drawn_thicker(avatar, theta, 0.0)
        prior, shapes = SurfacePrior(avatar), avatar.blendshapes
        prior.begin(avatar, theta, camera, images)
        # All reach ten discs along z, towards the camera, and one across.
        disc = disc_log_scale(avatar)
        frames = avatar.anchors.frames(avatar.carrier_vertices(turned(avatar, [0.0])))
        shapes.rotation_wxyz.data.copy_(frames.quat_wxyz[0] * torch.tensor([1.0, -1, -1, -1]))
        wide = disc[:, :2].mean(1)
        shapes.log_scale.data.copy_(wide[:, None].expand(-1, 3))
        shapes.log_scale.data[:, 2] += math.log(10)
        placed = shapes.position.detach().clone()
        prior.look(avatar, theta, camera, images)
        prior.seen_px.fill_(1e3)  # nothing is drawn to the surface
        prior.grazing_px.fill_(1e3)  # and nothing shortened along its normal
        prior.pull(avatar, 199)
        longer[kind] = (shapes.log_scale.detach()[:, 2] - wide).exp()
        ends = conjugate_quats_wxyz(frames.quat_wxyz[0]), shapes.position.detach() - placed
        cut_m = 1.5 * (10 - longer[kind]) * wide.exp()
        back_m[kind] = turn_back(*ends)[:, 2] + cut_m
    field = MeshField(avatar)
    sideways = field.at_gaussians(field.normals)[:, 0].abs()
    middle = (rest[:, 0].abs() < 0.03) & (rest[:, 2] > 0.03) & (rest[:, 1] < 0.03)
    lips = middle & (sideways < 0.2) & ~field.body_gaussians
    sides = (sideways > 0.75) & ~field.body_gaussians
    assert int(lips.sum()) > 30
    assert min(int(sides.sum()), int(field.body_gaussians.sum())) > 100
    assert float(longer["still"][lips].max()) < 2.8  # 2.5, and what .95 of the way leaves
    assert float(longer["still"][field.body_gaussians].min()) > 9.9
    # What stands before the head is cut off (test_front.py), and the rest closes it.
    assert float(back_m["still"][sides].abs().max()) < 1e-3
    assert float(longer["still"][sides].min()) > 2.5
    assert float(longer["turning"].min()) > 9.9


def test_discs_grow_with_a_surface_that_is_larger_than_its_mesh():
    avatar = embedded_avatar()
    field = MeshField(avatar)
    flat, thick = (
        log_overlap(avatar, field, torch.full((field.num_vertices,), off)) for off in (0.0, 0.03)
    )
    rest = avatar.carrier_vertices(torch.zeros(1, avatar.layout.size))
    larger = rest + 0.03 * vertex_normals(rest, avatar.head.faces.long())
    corners = avatar.anchors.corners()[0]
    areas = []
    for places in (rest[0], larger[0]):
        first, second, third = places[corners].unbind(1)
        areas.append(torch.linalg.cross(second - first, third - first).norm(dim=1))
    apart = (areas[1] / areas[0]).sqrt()
    # Over a skull as over a ball; folds of ears and lips are not.
    skull = avatar.anchors.origins(rest)[0, :, 1] > 0.05
    grown = (thick - flat)[skull].mean(1).exp()
    assert float(grown.median()) == pytest.approx(float(apart[skull].median()), rel=0.05)
    assert float(grown.median()) > 1.2


def test_the_back_of_a_head_is_closed_also_where_the_texture_ends():
    avatar = embedded_avatar(uv_resolution=128)
    theta = turned(avatar, [-8.0, 0.0, 8.0])
    prior, camera = SurfacePrior(avatar), front_camera()
    images = drawn_thicker(avatar, theta, 0.02)
    prior.begin(avatar, theta, camera, images)
    for step in range(199, 1440, 40):
        prior.pull(avatar, step)
    shapes = avatar.blendshapes
    front = avatar.anchors.origins(avatar.carrier_vertices(theta[1:2]))[0, :, 2] > -0.03
    shapes.color_feature.data.copy_(torch.where(front, 1.772, -1.772)[:, None].expand(-1, 3))
    behind = orbit(camera, torch.zeros(1, 3), torch.tensor([180.0]), torch.zeros(1))
    with torch.no_grad():
        image = avatar.render(theta[1:2], behind).image[0, ..., 0]
    # The middle third, crown to neck: what the front's light side shines through.
    assert float(image[60:200, 100:156].max()) < 0.06
