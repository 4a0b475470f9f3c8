"""The surface that a camera in front sees, and what goes to it; bodies' strays."""

import math

import numpy as np
import pytest
import torch

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.prior.discs import disc_log_scale
from rgbavatar_ns.avatar.prior.front import FrontSurface
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.avatar.prior.strands import Strands
from rgbavatar_ns.head.arrays import EMBEDDED_BUST
from rgbavatar_ns.head.rotations import conjugate_quats_wxyz, turn_back

from .test_mesh_field import embedded_avatar
from .test_outline import drawn_thicker, front_camera, turned

STEPS = range(199, 1440, 40)


def foremost_m(avatar: Avatar, places_m: torch.Tensor) -> np.ndarray:
    """z of the nearest triangle where a ray along z meets the mesh at rest; NaN where none does.

    Every triangle is asked, in double precision.
    """
    rest = MeshField(avatar).rest_m.double().numpy()
    first, second, third = rest[avatar.head.faces.numpy()].transpose(1, 0, 2)
    side, other = second - first, third - first
    area = side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0]
    found = np.full(len(places_m), np.nan)
    for k, place in enumerate(places_m.double().numpy()):
        away = place - first
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (away[:, 0] * other[:, 1] - away[:, 1] * other[:, 0]) / area
            v = (side[:, 0] * away[:, 1] - side[:, 1] * away[:, 0]) / area
        hit = (u >= 0) & (v >= 0) & (u + v <= 1)
        if hit.any():
            found[k] = (first[:, 2] + u * side[:, 2] + v * other[:, 2])[hit].max()
    return found


def test_the_front_surface_is_what_rays_from_in_front_meet_first():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    front = FrontSurface.of(avatar, MeshField(avatar))
    drawn = np.random.default_rng(0).uniform([-0.12, -0.2, 0], [0.12, 0.14, 0], (1500, 3))
    places = torch.from_numpy(drawn).float()
    ours, rays = front.at(places).numpy(), foremost_m(avatar, places)
    there = np.isfinite(rays)
    assert 300 < there.sum() < 1400
    # Pixels of 1.5 mm at the border may belong to either side.
    assert (np.isfinite(ours) == there).mean() > 0.97
    both = there & np.isfinite(ours)
    off = np.abs(ours - rays)[both]
    assert np.median(off) < 1e-3
    # Smoothed where the depth leaps: chin before neck, lobe before nape.
    assert np.quantile(off, 0.9) < 6e-3
    assert off.max() < 0.03, "and never that of nothing, 0, beside the mesh"
    beside = torch.tensor([[1.0, 0.0, 0.0], [0.0, -9.0, 0.0]])
    assert front.at(beside).isnan().all()


def test_a_chin_that_paints_the_neck_lies_on_it():
    """Its Gaussians go 25 mm down, before the neck, at the depth that they had."""
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field = MeshField(avatar)
    theta = turned(avatar, [-1.0, 0.0, 1.0])
    images = drawn_thicker(avatar, theta, 0.0)
    prior, position = SurfacePrior(avatar), avatar.blendshapes.position
    prior.begin(avatar, theta, front_camera(), images)
    rest, home = field.at_gaussians(field.rest_m), prior.surface(avatar)[0]
    turned_back = conjugate_quats_wxyz(field.rest_quats_wxyz)
    before = rest + turn_back(turned_back, home)
    down = torch.tensor([0.0, -0.025, 0.0])
    there_m = torch.from_numpy(foremost_m(avatar, before + down)).float()
    gap_m = before[:, 2] - there_m
    sideways = field.at_gaussians(field.normals)[:, 0].abs()
    skin = Strands.of(avatar, field).haired == 0
    chin = (gap_m > 0.01) & (sideways < 0.3) & skin & ~field.body_gaussians
    chin &= (before[:, 0].abs() < 0.03) & (before[:, 2] > 0)
    assert int(chin.sum()) >= 10
    position.data.copy_(home + turn_back(field.rest_quats_wxyz, down.expand_as(home)))
    prior.look(avatar, theta, front_camera(), images)
    for known in (prior.seen_px, prior.clear_px):
        known.fill_(1e3)  # nothing is drawn home for want of being seen
    for step in STEPS:
        prior.pull(avatar, step)
    after = rest + turn_back(turned_back, position.detach())
    assert float((after - before - down)[chin, :2].abs().max()) < 2e-3, "along the view alone"
    left = (after[:, 2] - there_m)[chin].abs() / gap_m[chin]
    assert float(left.median()) < 0.2


def test_what_hangs_before_another_part_is_as_short_as_its_disc_again():
    """From each place of the skin a Gaussian hangs 18 mm down: chins before throats, brows not."""
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field, long_m = MeshField(avatar), 0.012
    theta = turned(avatar, [-1.0, 0.0, 1.0])
    images = drawn_thicker(avatar, theta, 0.0)
    prior, shapes = SurfacePrior(avatar), avatar.blendshapes
    prior.begin(avatar, theta, front_camera(), images)
    rest, frame = field.at_gaussians(field.rest_m), field.rest_quats_wxyz
    down = turn_back(frame, torch.tensor([0.0, -1.0, 0.0]).expand_as(rest))
    # A half turn about the bisector takes the first axis to any direction.
    half = torch.nn.functional.normalize(down + torch.tensor([1.0, 0.0, 0.0]), dim=1)
    shapes.rotation_wxyz.data.copy_(torch.nn.functional.pad(half, (1, 0)))
    shapes.log_scale.data[:, 0] = math.log(long_m)
    centre = rest + turn_back(conjugate_quats_wxyz(frame), shapes.position.detach())
    tips = [centre + torch.tensor([0.0, 1.5 * way * long_m, 0.0]) for way in (-1, 1)]
    own, *others = (at[:, 2].numpy() - foremost_m(avatar, at) for at in (centre, *tips))
    before_m = np.fmax(*others) - own.clip(0)
    skin = Strands.of(avatar, field).haired == 0
    plain = skin & ~field.body_gaussians & (field.at_gaussians(field.normals)[:, 1].abs() < 0.3)
    hangs = skin & ~field.body_gaussians & torch.from_numpy(before_m > 0.01)
    lies = plain & torch.from_numpy(np.abs(before_m) < 0.002) & (centre[:, 2] > 0.03)
    assert int(hangs.sum()) >= 15
    assert int(lies.sum()) >= 50
    prior.look(avatar, theta, front_camera(), images)
    prior.seen_px.fill_(1e3)
    prior.pull(avatar, STEPS[0])
    disc_m = disc_log_scale(avatar)[:, :2].mean(1).exp()
    found_m = shapes.log_scale.detach()[:, 0].exp()
    assert float((found_m / disc_m)[hangs].quantile(0.8)) < 1.05
    assert float((found_m / long_m)[lies].quantile(0.1)) > 0.95


@pytest.mark.parametrize(
    ("degrees", "off_m", "cut"), [(0.0, -0.0125, True), (0.0, 0.008, False), (60.0, -0.0125, False)]
)
def test_needles_along_the_view_end_at_the_face_and_still_close_its_sides(degrees, off_m, cut):
    """Beside cheeks needles reach 25 mm out of the head: those are cut off, nothing behind is.

    But what stands off as a whole stays, and so does what a film from aside shows."""
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field, long_m = MeshField(avatar), 0.025
    theta = turned(avatar, [degrees - 1, degrees, degrees + 1])
    images = drawn_thicker(avatar, theta, 0.0)
    prior, shapes = SurfacePrior(avatar), avatar.blendshapes
    prior.begin(avatar, theta, front_camera(), images)
    rest, frame = field.at_gaussians(field.rest_m), field.rest_quats_wxyz
    ahead = turn_back(frame, torch.tensor([0.0, 0.0, 1.0]).expand_as(rest))
    half = torch.nn.functional.normalize(ahead + torch.tensor([1.0, 0.0, 0.0]), dim=1)
    shapes.rotation_wxyz.data.copy_(torch.nn.functional.pad(half, (1, 0)))
    shapes.log_scale.data[:, 0] = math.log(long_m)
    foremost = torch.from_numpy(foremost_m(avatar, rest)).float()
    centre = torch.cat([rest[:, :2], (foremost + off_m)[:, None]], 1)
    shapes.position.data.copy_(turn_back(frame, centre - rest).nan_to_num())
    sideways = field.at_gaussians(field.normals)[:, 0].abs()
    sides = (Strands.of(avatar, field).haired == 0) & ~field.body_gaussians & (sideways > 0.75)
    # Where the drawn surface, which is smoothed, is that of the rays.
    sides &= (FrontSurface.of(avatar, field).at(rest) - foremost).abs() < 1e-3
    # And where what is left is longer than its disc.
    sides &= disc_log_scale(avatar)[:, :2].amax(1).exp() < 0.01
    assert int(sides.sum()) >= 20
    prior.look(avatar, theta, front_camera(), images)
    for known in (prior.seen_px, prior.clear_px, prior.grazing_px):
        known.fill_(1e3)  # nothing is drawn home, nor flat for being seen from in front alone
    prior.pull(avatar, STEPS[0])
    after = rest + turn_back(conjugate_quats_wxyz(frame), shapes.position.detach())
    reach = 1.5 * shapes.log_scale.detach()[:, 0].exp()
    before_m, back_m = after[:, 2] + reach - foremost, after[:, 2] - reach
    if not cut:
        np.testing.assert_allclose(before_m[sides], off_m + 1.5 * long_m, atol=1e-3)
        return
    assert float(before_m[sides].max()) < 6e-3
    assert float(before_m[sides].min()) > 2e-3, "no more than that"
    assert float((back_m - (centre[:, 2] - 1.5 * long_m))[sides].abs().max()) < 1e-3
    assert float((after - centre)[sides, :2].abs().max()) < 1e-3


def test_what_stands_off_as_a_whole_hangs_nowhere():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field = MeshField(avatar)
    front, rest = FrontSurface.of(avatar, field), field.at_gaussians(field.rest_m)
    upon = rest.clone()
    upon[:, 2] = front.at(rest)
    brow = ~upon[:, 2].isnan() & (field.at_gaussians(field.normals)[:, 2] > 0.95)
    brow &= rest[:, 1] > 0.04
    assert int(brow.sum()) >= 15
    upon, aside = upon[brow], torch.tensor([0.006, 0.0, 0.0]).expand(int(brow.sum()), 3)
    off = torch.tensor([0.0, 0.0, 0.02])
    assert float(front.overhang(upon + off, aside).max()) == 0, "as glasses do"
    ahead = torch.tensor([0.0, 0.0, 0.02]).expand_as(aside)
    assert float(front.overhang(upon, ahead).min()) == 1


def test_skin_that_is_never_seen_in_front_does_not_paint_what_is_far_off():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    theta = turned(avatar, [-1.0, 0.0, 1.0])
    images = drawn_thicker(avatar, theta, 0.0)
    prior, shapes, field = SurfacePrior(avatar), avatar.blendshapes, MeshField(avatar)
    prior.begin(avatar, theta, front_camera(), images)
    home = prior.surface(avatar)[0]
    head = ~field.body_gaussians
    skin = head & (Strands.of(avatar, field).haired == 0)
    third = torch.arange(len(head)) % 3
    far, near = torch.tensor([0.03, 0.02, 0.0]), torch.tensor([0.006, 0.004, 0.0])
    shapes.position.data.copy_(home + torch.where((third == 2)[:, None], near, far))
    before = shapes.position.detach().clone()
    for known in (prior.seen_px, prior.through_px, prior.grazing_px):
        known.fill_(7.0)
    prior.clear_px.copy_(torch.where(third == 1, 7.0, 0.3))
    for step in STEPS[:12]:
        prior.pull(avatar, step)
    went = (shapes.position.detach() - home).norm(dim=1) / (before - home).norm(dim=1)
    hair = head & (Strands.of(avatar, field).haired == 1)
    assert float(went[skin & (third == 0)].quantile(0.9)) < 0.65, "until it is near enough"
    for stays in (skin & (third == 1), skin & (third == 2), hair):
        assert int(stays.sum()) > 100
        assert float(went[stays].median()) > 0.95


def test_what_of_a_body_strays_where_nothing_is_filmed_is_clear_until_it_is_back():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    theta = turned(avatar, [-1.0, 0.0, 1.0])
    images = drawn_thicker(avatar, theta, 0.0)
    prior, shapes = SurfacePrior(avatar), avatar.blendshapes
    prior.begin(avatar, theta, front_camera(), images)
    home, logit = prior.surface(avatar)
    body = MeshField(avatar).body_gaussians & (logit > 0)
    assert int(body.sum()) > 100
    shapes.opacity_logit.data.fill_(2.0)
    strays = home + torch.tensor([0.03, 0.0, 0.0])
    shapes.position.data.copy_(strays)
    even = torch.arange(len(body)) % 2 == 0
    corner, shown = body & even, body & ~even
    prior.seen_px[corner], prior.seen_px[shown] = 0.01, 1e3
    prior.through_px.copy_(prior.seen_px)
    prior.pull(avatar, STEPS[0])
    position, opacity_logit = shapes.position.detach(), shapes.opacity_logit.detach()
    assert float(opacity_logit[corner].max()) < 0
    assert float(opacity_logit[shown].min()) > 1.9
    assert float((position - strays)[shown].abs().max()) < 1e-3
    for step in STEPS:
        prior.pull(avatar, step)
    assert float((position - home)[corner].abs().max()) < 1e-4
    assert float(opacity_logit[corner].min()) > 1
