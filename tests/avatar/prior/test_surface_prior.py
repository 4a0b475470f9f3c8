"""What no frame shows goes to the surface; what frames show stays where training put it."""

from dataclasses import replace

import pytest
import torch

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.prior.front import FrontSurface, longest_axes_m
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.avatar.prior.mouth import HiddenMouth
from rgbavatar_ns.avatar.prior.strands import Strands
from rgbavatar_ns.avatar.training import TrainingBatch, TrainingOptions, TrainingStep, fit
from rgbavatar_ns.head.arrays import EMBEDDED_BUST
from rgbavatar_ns.head.rotations import conjugate_quats_wxyz, turn_back
from rgbavatar_ns.kernels import weighted_color_average
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from rgbavatar_ns.kernels.cpu import INSTRUCTION_SET_VARIABLE

from .test_mesh_field import embedded_avatar
from .test_outline import SIZE, drawn_thicker, front_camera, turned

STEPS = range(199, 1440, 40)


@pytest.fixture
def filmed():
    """An avatar whose parameters are noise, filmed from the front."""
    avatar = embedded_avatar()
    theta = turned(avatar, [-8.0, 0.0, 8.0])
    images = drawn_thicker(avatar, theta, 0.0)
    return avatar, theta, images


def shaken(avatar) -> None:
    random = torch.Generator().manual_seed(1)
    shapes = avatar.blendshapes
    for tensor, size in (
        (shapes.position, 4e-3),
        (shapes.color_feature, 1.0),
        (shapes.basis_position, 1e-3),
        (shapes.basis_color_feature, 0.3),
    ):
        tensor.data.add_(size * torch.randn(tensor.shape, generator=random))


def _ahead(avatar) -> torch.Tensor:
    """The way to a camera in front, in each Gaussian's axes."""
    rest_quats = MeshField(avatar).rest_quats_wxyz
    return turn_back(rest_quats, torch.eye(3)[2].expand(len(rest_quats), 3))


def _on_the_surface(avatar, prior) -> torch.Tensor:
    position, opacity_logit = prior.surface(avatar)
    mouth = HiddenMouth.of(avatar, MeshField(avatar))
    assert mouth is not None
    skin = mouth.behind == 0
    assert torch.equal(position[skin], (prior.offset_m[:, None] * MeshField(avatar).outwards)[skin])
    assert torch.equal(opacity_logit[skin], prior.opacity_logit[skin])
    return position


def test_what_no_frame_shows_comes_to_the_surface(filmed):
    avatar, theta, images = filmed
    prior, shapes = SurfacePrior(avatar), avatar.blendshapes
    prior.begin(avatar, theta, front_camera(), images)
    shaken(avatar)
    nobody_filmed = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8).expand_as(images).contiguous()
    for step in STEPS:
        assert prior.due(step)
        prior.look(avatar, theta, front_camera(), nobody_filmed)
        prior.pull(avatar, step)
    assert not prior.seen_px.any()
    assert float((shapes.position - _on_the_surface(avatar, prior)).abs().max()) < 1e-6
    assert float(shapes.basis_position.abs().max()) < 1e-6
    assert float(shapes.basis_color_feature.abs().max()) < 1e-4
    assert torch.allclose(shapes.opacity_logit, prior.surface(avatar)[1])


def test_what_the_film_may_move_begins_half_clear_and_lips_begin_closed(filmed):
    avatar, theta, images = filmed
    prior, mouth = SurfacePrior(avatar), HiddenMouth.of(avatar, MeshField(avatar))
    assert mouth is not None
    prior.begin(avatar, theta, front_camera(), images)
    begun = avatar.blendshapes.opacity_logit.sigmoid()
    closed = prior.surface(avatar)[1].sigmoid()
    lips = (mouth.before > 0.5) & (mouth.behind == 0)
    face = mouth.before == 0
    assert int(lips.sum()) > 50
    assert torch.equal(begun[lips], closed[lips])
    assert float(closed[lips].median()) == pytest.approx(0.9, abs=1e-4)
    full = face & (closed > 0.5)
    assert int(full.sum()) > 500
    assert torch.allclose(begun[full], torch.tensor(avatar.config.initial_opacity))
    empty = face & (closed < 0.01)
    assert torch.allclose(begun[empty], torch.tensor(0.01), atol=1e-4)
    # By hand: a mouth's own height is near it, and eyes, 8 cm above it, are not.
    rest = avatar.anchors.origins(avatar.carrier_vertices(torch.zeros_like(theta[:1])))[0]
    height_m = rest[:, 1] - rest[lips, 1].mean()
    front = rest[:, 2] > rest[lips, 2].mean() - 0.02
    assert not (mouth.before[front & (height_m > 0.08)] > 0).any()
    assert (mouth.before[front & (height_m.abs() < 0.01) & (rest[:, 0].abs() < 0.03)] > 0.9).all()


def test_a_head_whose_lips_are_not_known_begins_closed(filmed, monkeypatch):
    avatar, theta, images = filmed
    monkeypatch.setattr(HiddenMouth, "of", lambda avatar, field: None)
    prior = SurfacePrior(avatar)
    prior.begin(avatar, theta, front_camera(), images)
    begun = avatar.blendshapes.opacity_logit.sigmoid()
    closed = prior.opacity_logit > 0
    assert int(closed.sum()) > 500
    assert torch.allclose(begun[closed], torch.tensor(0.9))


def test_discs_that_nothing_shows_reach_each_other(filmed):
    avatar, theta, images = filmed
    small = replace(avatar.config, scale_from_texel_spacing=False, initial_scale_m=1e-4)
    avatar = Avatar(avatar.head, avatar.identity, small)
    prior = SurfacePrior(avatar)
    prior.begin(avatar, theta, front_camera(), images)
    nobody_filmed = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8).expand_as(images).contiguous()
    for step in STEPS:
        prior.look(avatar, theta, front_camera(), nobody_filmed)
        prior.pull(avatar, step)
    apart = avatar.anchors.texel_spacing()[:, None] * avatar.anchors.texel_stretch()
    mouth = HiddenMouth.of(avatar, MeshField(avatar))
    assert mouth is not None
    # Half as wide as texels lie apart, and by 1.4 more but in the mouth, whose lips are thin.
    wide = 0.5 * apart * 1.4 ** (1 - mouth.in_cavity)[:, None]
    # At the back also over the texture's ends (test_discs.py).
    field = MeshField(avatar)
    front = field.at_gaussians(field.back[:, None])[:, 0] == 0
    assert int((mouth.in_cavity == 0).sum()) > 0.9 * avatar.num_gaussians
    found = avatar.blendshapes.log_scale[:, :2].exp()
    assert torch.allclose(found[front], wide[front], rtol=1e-3)
    assert bool((found > 0.999 * wide).all())


def test_a_body_ends_where_its_picture_does_from_every_side():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    theta = turned(avatar, [-6.0, 0.0, 6.0])
    theta[:, avatar.layout.slice("translation").start + 1] = 0.13
    images = drawn_thicker(avatar, theta, 0.0)
    images[:, SIZE - 8 :] = 0
    prior = SurfacePrior(avatar)
    prior.begin(avatar, theta, front_camera(), images)
    rest = avatar.anchors.origins(avatar.carrier_vertices(torch.zeros_like(theta[:1])))[0]
    closed = prior.opacity_logit > 0
    # The end, by hand: the chest is 1.1 m less .05 m away, and 120 pixels below the middle.
    end_m = -120 / 900 * 1.05 - 0.13
    front, back = rest[:, 2] > 0.02, rest[:, 2] < -0.08
    for side in (front, back):
        lower, upper = side & (rest[:, 1] < end_m - 0.015), side & (rest[:, 1] > end_m + 0.03)
        assert int(lower.sum()) > 20
        assert not closed[lower].any()
        assert closed[upper].float().mean() > 0.97
    # What shines through where the front fades does not keep the back.
    shapes = avatar.blendshapes
    shapes.opacity_logit.data.fill_(3.0)
    prior.seen_px.zero_()
    prior.through_px.fill_(5.0)
    prior.pull(avatar, STEPS[0])
    assert float(shapes.opacity_logit[~closed].max()) < 0
    assert float(shapes.opacity_logit[closed].min()) > 2.9


@pytest.mark.parametrize("degrees", [8.0, 25.0])
def test_what_a_frame_shows_well_stays(degrees):
    avatar = embedded_avatar()
    theta = turned(avatar, [-degrees, 0.0, degrees])
    images = drawn_thicker(avatar, theta, 0.0)
    prior, shapes = SurfacePrior(avatar), avatar.blendshapes
    prior.begin(avatar, theta, front_camera(), images)
    shaken(avatar)
    names = ("position", "color_feature", "log_scale", "opacity_logit", "basis_color_feature")
    before = {name: getattr(shapes, name).detach().clone() for name in names}
    home = _on_the_surface(avatar, prior)
    gone = (before["position"] - home).norm(dim=-1)
    # How much farther forward the surface is where it has gone, and was before its own place.
    field = MeshField(avatar)
    axes, rest = conjugate_quats_wxyz(field.rest_quats_wxyz), field.at_gaussians(field.rest_m)
    front = FrontSurface.of(avatar, field)
    here, there = (front.at(rest + turn_back(axes, at)) for at in (before["position"], home))
    hidden = (there - (rest + turn_back(axes, home))[:, 2]).clamp(min=0)
    leap = ((here - there).abs() + hidden).nan_to_num()
    # What reaches out before another part of the head is shortened (test_front.py).
    long_m = longest_axes_m(shapes, field.rest_quats_wxyz).detach()
    hangs = torch.zeros(len(rest), dtype=torch.bool)
    for at in (before["position"], home):
        hangs |= front.overhang(rest + turn_back(axes, at), long_m) > 0
    prior.look(avatar, theta, front_camera(), images)
    prior.pull(avatar, STEPS[0])
    clear = prior.seen_px > 1
    skin = Strands.of(avatar, MeshField(avatar)).haired == 0
    assert 100 < int(clear.sum()) < avatar.num_gaussians
    assert int((clear & ~hangs).sum()) > 0.8 * int(clear.sum())
    moved = shapes.position - before["position"]
    # A film that hardly turns does not tell its depth: that goes a little on its way.
    view = _ahead(avatar)
    depth = (moved * view).sum(1)
    across = (moved - depth[:, None] * view).norm(dim=-1)
    stays = across if degrees < 20 else moved.norm(dim=-1)
    assert float((stays / gone)[clear].max()) < 0.01
    assert float((depth.abs() / (gone + leap))[clear].max()) < 0.1
    # And what is seen less goes further.
    barely = prior.seen_px < 0.01
    assert float((moved.norm(dim=-1) / gone)[barely].min()) > 0.1
    for name in names:
        change = (getattr(shapes, name) - before[name]).abs()
        # Colours of hair count as seen from in front alone (test_strands.py).
        kept = clear & ((prior.clear_px > 1) | skin) if "color" in name else clear
        kept = kept & ~hangs if name == "log_scale" else kept
        change = change[:, kept] if name.startswith("basis") else change[kept]
        assert float(change.max()) < 0.05, name


def test_a_face_comes_to_its_surface_along_the_view_of_a_film_that_never_turns():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field, view = MeshField(avatar), _ahead(avatar)
    left = {}
    for kind, degrees in (("still", [-1.0, 0.0, 1.0]), ("turning", [-25.0, 0.0, 25.0])):
        theta = turned(avatar, degrees)
        images = drawn_thicker(avatar, theta, 0.0)
        prior, position = SurfacePrior(avatar), avatar.blendshapes.position
        prior.begin(avatar, theta, front_camera(), images)
        home = prior.surface(avatar)[0].clone()
        position.data.add_(0.004 * view)
        prior.look(avatar, theta, front_camera(), images)
        prior.seen_px.fill_(1e3)  # nothing is drawn to the surface for want of being seen
        for step in STEPS:
            prior.pull(avatar, step)
        left[kind] = ((position.detach() - home) * view).sum(1) / 0.004
        torch.testing.assert_close(position.detach() - home, (0.004 * left[kind])[:, None] * view)
    sideways = field.at_gaussians(field.normals)[:, 0].abs()
    front = (sideways < 0.2) & ~field.body_gaussians
    skin = Strands.of(avatar, field).haired == 0
    assert int((front & skin).sum()) > 100
    # Of 32 looks each leaves nine tenths.
    assert float(left["still"][front & skin].max()) < 0.06
    assert float(left["still"][(sideways > 0.75) | field.body_gaussians].min()) > 0.99
    assert float(left["turning"].min()) > 0.99


def test_a_run_that_it_did_not_see_begin_is_left_alone(filmed):
    avatar, theta, images = filmed
    prior = SurfacePrior(avatar)
    assert not any(prior.due(step) for step in STEPS)
    take = TrainingStep(avatar, prior=prior)
    take(TrainingBatch(theta, front_camera(), images), 5)
    assert not prior.has_begun


def test_without_the_option_nothing_is_measured(filmed):
    avatar, theta, images = filmed
    prior = SurfacePrior(avatar)
    take = TrainingStep(avatar, options=TrainingOptions(surface_prior=False), prior=prior)
    take(TrainingBatch(theta, front_camera(), images), 0)
    assert not prior.has_begun


def test_its_memory_goes_on_from_its_state(filmed):
    avatar, theta, images = filmed
    prior, copy = (SurfacePrior(avatar) for _ in range(2))
    prior.begin(avatar, theta, front_camera(), images)
    prior.look(avatar, theta, front_camera(), images)
    prior.views.hair_contrast.fill_(0.1)
    copy.load_state_dict(prior.state_dict())
    assert copy.has_begun
    assert float(copy.views.hair_contrast) == pytest.approx(0.1)
    for name, value in prior.state_dict().items():
        assert torch.equal(value, copy.state_dict()[name])


@pytest.mark.nightly
def test_what_training_never_shows_does_not_walk_away(monkeypatch):
    # How far depends on how an instruction set rounds: the same one on every machine.
    monkeypatch.setenv(INSTRUCTION_SET_VARIABLE, "generic")

    def walked_m(surface_prior: bool) -> float:
        avatar = embedded_avatar(uv_resolution=64)
        theta = turned(avatar, [-8.0, -4.0, 0.0, 4.0, 8.0])
        images = drawn_thicker(avatar, theta, 0.005)
        images[..., :3] = torch.tensor([200, 60, 40], dtype=torch.uint8)
        images[:, :, : images.shape[2] // 2, :3] = torch.tensor([40, 60, 200], dtype=torch.uint8)
        batch = TrainingBatch(theta, front_camera(), images)
        take = TrainingStep(avatar, options=TrainingOptions(surface_prior=surface_prior))
        fit(take, lambda step: batch, range(400))
        gaussians = avatar.gaussians(theta)
        ones = torch.ones(len(theta), *images.shape[1:3], 1)
        weights = weighted_color_average(gaussians, front_camera(), ones).weight_sum.amax(0)
        across = avatar.blendshapes.position[weights < 1e-3, :2]
        return float(across.norm(dim=-1).median())

    kept, left_to_chance = walked_m(True), walked_m(False)
    assert kept < 4e-3
    assert left_to_chance > 2 * kept
