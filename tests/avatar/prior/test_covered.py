"""What lies within a head is not seen, however much of it skin lets through."""

import math

import numpy as np
import pytest
import torch
import trimesh

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.prior.covered import HeadSolid
from rgbavatar_ns.avatar.prior.front import FrontSurface
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.avatar.prior.mouth import HiddenMouth
from rgbavatar_ns.head.arrays import EMBEDDED_BUST
from rgbavatar_ns.head.rotations import turn_back

from .test_mesh_field import embedded_avatar
from .test_outline import drawn_thicker, front_camera, turned

STEPS = range(199, 1440, 40)


def triangles(avatar: Avatar, field: MeshField) -> np.ndarray:
    """The corners of the mesh at rest."""
    return field.rest_m.double().numpy()[avatar.head.faces.numpy()]


def towards(yaw_degrees: float, pitch_degrees: float = 0.0) -> list[float]:
    """A unit vector in the head's axes, x to its left and y up."""
    yaw, pitch = math.radians(yaw_degrees), math.radians(pitch_degrees)
    return [math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)]


def crossings_m(corners_m: np.ndarray, place_m: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """How far ahead of a place each triangle lies that a ray meets, in double precision."""
    first, second, third = corners_m.transpose(1, 0, 2)
    side, other, away = second - first, third - first, place_m - first
    across = np.cross(ahead, other)
    with np.errstate(divide="ignore", invalid="ignore"):
        area = (side * across).sum(1)
        u = (away * across).sum(1) / area
        v = (np.cross(away, side) * ahead).sum(1) / area
        far = (np.cross(away, side) * other).sum(1) / area
    return far[(u >= 0) & (v >= 0) & (u + v <= 1) & (far > 2e-3)]


@pytest.mark.parametrize(
    "ahead", [towards(0), towards(20), towards(-35, 10), towards(70), towards(180)]
)
def test_what_rays_reach_is_not_covered_and_what_the_head_is_before_is(ahead):
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field = MeshField(avatar)
    solid = HeadSolid.of(avatar, field, FrontSurface.of(avatar, field))
    mouth = HiddenMouth.of(avatar, field)
    assert mouth is not None
    outer = (mouth.behind == 0) & ~field.body_gaussians
    some = torch.nonzero(outer)[:, 0][::3]
    places, normals = (field.at_gaussians(part)[some] for part in (field.rest_m, field.normals))
    covered = solid.covered(places, torch.tensor([ahead]))[0].numpy()
    direction = np.array(ahead)
    corners = triangles(avatar, field)
    hits = [crossings_m(corners, place, direction) for place in places.double().numpy()]
    free = np.array([len(far) == 0 for far in hits])
    assert free.sum() > 50
    assert (covered[free] < 0.01).mean() > 0.99
    # In the middle of its way a ray is as deep within as it gets.
    away = np.flatnonzero((normals.numpy() @ direction < -0.3) & ~free)
    half_m = np.array([hits[k].max() / 2 for k in away])
    middle = places.numpy()[away] + half_m[:, None] * direction
    mesh = trimesh.Trimesh(field.rest_m.numpy(), avatar.head.faces.numpy(), process=False)
    deep = trimesh.proximity.closest_point_naive(mesh, middle)[1] > 0.027
    assert deep.sum() > 20
    assert (covered[away][deep] > 0.5).mean() > 0.97
    assert np.median(covered[away][deep]) == 1


def test_depths_lie_between_the_nearest_surface_and_that_straight_ahead_or_behind():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field = MeshField(avatar)
    solid = HeadSolid.of(avatar, field, FrontSurface.of(avatar, field))
    rest, corners = field.rest_m, triangles(avatar, field)
    low, high = rest.amin(0), rest.amax(0)
    drawn = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    places = low + drawn * (high - low)
    along_m, inside = np.zeros(len(places)), np.zeros(len(places), bool)
    for k, place in enumerate(places.double().numpy()):
        ends = crossings_m(corners, np.array([*place[:2], -10.0]), np.array([0.0, 0.0, 1.0])) - 10
        inside[k] = len(ends) > 0 and ends.min() < place[2] < ends.max()
        along_m[k] = min(ends.max() - place[2], place[2] - ends.min()) if inside[k] else 0.0
    assert 80 < inside.sum() < 300
    mesh = trimesh.Trimesh(rest.numpy(), avatar.head.faces.numpy(), process=False)
    nearest_m = trimesh.proximity.closest_point_naive(mesh, places.numpy()[inside])[1]
    found = solid.depth_m(places).numpy()
    # Pixels of 1.5 mm, smoothed where the depth leaps.
    assert np.quantile(found - along_m, 0.97) < 4e-3
    assert np.quantile(nearest_m - found[inside], 0.95) < 1e-2
    assert np.median(np.abs(nearest_m - found[inside])) < 3e-3
    beside = torch.tensor([[1.0, 0, 0], [0, -9.0, 0], [-1e6, 1e6, 0], [0, 0, 3.0], [0, 0, -3.0]])
    assert not solid.depth_m(beside).any()


def test_a_disc_of_the_side_that_paints_the_skin_from_behind_goes_home():
    """Half clear skin shows it well, from in front all the same, but not on a turned head."""
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field, shapes = MeshField(avatar), avatar.blendshapes
    theta = turned(avatar, [-4.0, 0.0, 4.0])
    images = drawn_thicker(avatar, theta, 0.0)
    prior = SurfacePrior(avatar)
    prior.begin(avatar, theta, front_camera(), images)
    home = prior.surface(avatar)[0].clone()
    rest, normal = (field.at_gaussians(part) for part in (field.rest_m, field.normals))
    # Temples that a camera in front still sees, above the eyes and before the ears.
    sides = (rest[:, 0] > 0.05) & (normal[:, 2] > 0.1) & ~field.body_gaussians
    sides &= (rest[:, 2] < 0.03) & (rest[:, 1] > -0.02)
    inwards = torch.tensor([-0.04, 0.0, -0.04]).expand_as(home)
    shapes.opacity_logit.data.fill_(-2.0)
    prior.look(avatar, theta, front_camera(), images)
    sides &= prior.seen_px > 1
    assert int(sides.sum()) >= 10
    shapes.position.data[sides] += turn_back(field.rest_quats_wxyz, inwards)[sides]
    shapes.log_scale.data[sides] = math.log(0.012)
    shapes.opacity_logit.data[sides] = 4.0
    fresh = SurfacePrior(avatar)
    fresh.load_state_dict(prior.state_dict())
    for known in (fresh.seen_px, fresh.clear_px, fresh.grazing_px, fresh.through_px):
        known.zero_()
    fresh.look(avatar, theta, front_camera(), images)
    assert float(fresh.through_px[sides].max()) > 5.0
    assert float(fresh.seen_px[sides].max()) < 1e-3
    assert float(fresh.seen_px[~sides & (normal[:, 2] > 0.7) & (rest[:, 2] > 0.03)].median()) > 1
    gone = (shapes.position - home)[sides].norm(dim=1)
    assert float(gone.min()) > 0.05
    for step in STEPS[:16]:
        fresh.pull(avatar, step)
    left = (shapes.position - home)[sides].norm(dim=1)
    assert float((left / gone).max()) < 0.01


@pytest.mark.parametrize("uv_resolution", [48, 128])
@pytest.mark.parametrize("thicker_m", [-0.012, -0.006, 0.0, 0.01])
def test_what_lies_on_a_persons_own_surface_is_as_seen_as_ever(
    uv_resolution, thicker_m, monkeypatch
):
    """Also on people who are thinner than their mesh, and from both sides that a film shows."""
    avatar = embedded_avatar(uv_resolution=uv_resolution, name=EMBEDDED_BUST)
    theta = turned(avatar, [-40.0, 40.0])
    images = drawn_thicker(avatar, theta, thicker_m)
    prior = SurfacePrior(avatar)
    prior.begin(avatar, theta, front_camera(), images)
    copy = SurfacePrior(avatar)
    copy.load_state_dict(prior.state_dict())
    prior.look(avatar, theta, front_camera(), images)
    none = torch.zeros(len(theta), avatar.num_gaussians)
    monkeypatch.setattr(HeadSolid, "covered", lambda *_: none)
    copy.look(avatar, theta, front_camera(), images)
    facing = copy.clear_px > 0.5 * copy.seen_px
    shown = facing & (copy.seen_px > 0.5)
    assert int(shown.sum()) > 300
    share = (prior.seen_px / copy.seen_px)[shown]
    # Lids and brows lie before each other at times; with both ways swapped it is three quarters.
    assert float((share > 0.9).float().mean()) > 0.88
    assert float(share.mean()) > 0.93


def test_bodies_and_mouths_are_left_to_what_else_tells_of_them(monkeypatch):
    """Bodies do not turn with the head, and the mouth is seen through its lips."""
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    parts = SurfacePrior(avatar)._parts(avatar)
    assert parts.mouth is not None
    assert not parts.outer[parts.field.body_gaussians].any()
    assert not parts.outer[parts.mouth.behind == 1].any()
    assert int((parts.mouth.behind == 1).sum()) > 50
    assert float(parts.outer.mean()) > 0.5
    monkeypatch.setattr(HiddenMouth, "of", lambda avatar, field: None)
    assert not SurfacePrior(avatar)._parts(avatar).outer.any(), "teeth might be covered"


def test_a_place_that_is_no_number_covers_nothing_else():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field = MeshField(avatar)
    solid = HeadSolid.of(avatar, field, FrontSurface.of(avatar, field))
    strange = torch.tensor([[math.nan] * 3, [math.inf] * 3, [0.0, 0.0, -math.inf]])
    assert not solid.covered(strange, torch.tensor([towards(10)])).any()
