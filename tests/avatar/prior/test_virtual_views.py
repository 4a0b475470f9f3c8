"""Views that nobody filmed: nothing beside the outline, no opinion within, never where filmed."""

import pytest
import torch

from rgbavatar_ns.avatar.orbit import head_centre
from rgbavatar_ns.avatar.prior import VirtualViews
from rgbavatar_ns.avatar.prior.mesh_field import MeshField, Outline
from rgbavatar_ns.avatar.prior.outline import measure_outline
from rgbavatar_ns.avatar.prior.virtual_views import TURNS_DEGREES
from rgbavatar_ns.drawing.compositing import is_unfilmed
from rgbavatar_ns.head.arrays import EMBEDDED_BUST
from rgbavatar_ns.head.joints import ROOT
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.kernels import PinholeCameras

from .test_mesh_field import embedded_avatar
from .test_outline import SIZE, drawn_thicker, front_camera, turned

BATCH = 10
EVERY = 4


def views_of(avatar, theta, offset_m=0.0, goes_on_below=False, empty=None) -> VirtualViews:
    count = len(avatar.head.arrays.v_template)
    views = VirtualViews(count, avatar.layout.size)
    offset = torch.full((count,), offset_m)
    empty = torch.zeros(count) if empty is None else empty
    outline = Outline(offset, empty, empty[:0], goes_on_below, hair_contrast=0.0)
    views.begin(avatar, outline, theta, front_camera())
    views.see(avatar, theta, front_camera())
    return views


def shown(views: VirtualViews) -> set[int]:
    """The views that take turns."""
    found = {views.due(step, BATCH) for step in range(0, 40 * EVERY, EVERY)}
    return {view for view in found if view is not None}


def within_outline(image: torch.Tensor) -> torch.Tensor:
    return (image[..., 3] > 0) | is_unfilmed(image)


def looking(avatar, yaw_degrees: list[float], pitch_degrees: list[float]) -> torch.Tensor:
    """Frames that turn, then frames that nod."""
    nods = turned(avatar, [0.0] * len(pitch_degrees))
    nods[:, avatar.layout.slice("rotation").start] = torch.deg2rad(torch.tensor(pitch_degrees))
    return torch.cat([turned(avatar, yaw_degrees), nods])


def places_px(cameras: PinholeCameras, points: torch.Tensor) -> torch.Tensor:
    """A pinhole by hand, in float64: where points of the world are in the picture."""
    pose = cameras.world_to_camera[0].double()
    seen = points.double() @ pose[:3, :3].T + pose[:3, 3]
    return seen[:, :2] / seen[:, 2:] * cameras.focal_px[0] + cameras.principal_point_px[0]


def test_nothing_is_beside_the_outline_and_within_it_the_avatar_is_closed():
    avatar = embedded_avatar()
    theta = turned(avatar, [-4.0, 4.0])
    thin, thick = (views_of(avatar, theta, offset_m) for offset_m in (0.0, 0.01))
    for view in (0, 12, len(TURNS_DEGREES) - 1):
        frame = thin.frame(avatar, view)
        within = within_outline(frame.images_rgba)[0]
        rim = is_unfilmed(frame.images_rgba)[0]
        # Outside, background: nothing at all; inside, closed, but for a thin rim.
        assert not frame.images_rgba[0][~within].any()
        assert (frame.images_rgba[0, ..., 3][within & ~rim] == 255).all()
        assert 0 < rim.sum() < 0.1 * within.sum()
        # The mesh lies within, to a part of a pixel, and the corners do not.
        vertices = avatar.carrier_vertices(frame.theta)[0]
        column, row = places_px(frame.cameras, vertices).long().unbind(1)
        there = (column >= 0) & (column < SIZE) & (row >= 0) & (row < SIZE)
        assert there.float().mean() > 0.9
        assert within[row[there], column[there]].float().mean() > 0.995
        assert not within[0, [0, -1]].any()
        # A thicker person covers the rim beside it, as much as its thickness is in pixels.
        wider = within_outline(thick.frame(avatar, view).images_rgba)[0]
        assert not (within & ~wider)[: SIZE // 2].any()
        crown = [int(mask.any(1).nonzero()[0]) for mask in (within, wider)]
        assert crown[0] - crown[1] == pytest.approx(0.01 / 1.1 * 900, abs=2)


def test_around_a_collar_nothing_is_known_and_beside_the_head_that_nothing_is():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    theta = turned(avatar, [-4.0, 4.0])
    theta[:, avatar.layout.slice("translation").start + 1] = 0.08
    frame = views_of(avatar, theta).frame(avatar, 0)
    vertices = avatar.carrier_vertices(frame.theta)[0]
    pose = frame.cameras.world_to_camera[0]
    away_m = vertices @ pose[2, :3] + pose[2, 3]
    rows, columns = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    pixels = torch.stack([columns, rows], -1).flatten(0, 1) + 0.5
    mesh_px = places_px(frame.cameras, vertices).float()
    # Metres to the nearest vertex: mostly a few millimetres more than to the mesh between them.
    nearest_px, index = torch.cdist(pixels, mesh_px).min(1)
    off_m = nearest_px * away_m[index] / frame.cameras.focal_px[0, 0]
    rest = torch.as_tensor(avatar.head.arrays.v_template)
    foot = float((torch.as_tensor(avatar.head.arrays.joint_regressor[ROOT]).to(rest) @ rest)[1])
    height_m = rest[index, 1] - foot
    unfilmed = is_unfilmed(frame.images_rgba)[0].flatten()
    background = ~within_outline(frame.images_rgba)[0].flatten()
    around = (off_m > 0.008) & (off_m < 0.016) & (unfilmed | background)
    collar = around & (height_m > -0.04) & (height_m < 0.02)
    head = around & (height_m > 0.1)
    assert min(int(collar.sum()), int(head.sum())) > 500
    assert float(unfilmed[collar].float().mean()) > 0.97
    assert float(background[head].float().mean()) > 0.97
    assert float(background[off_m > 0.04].float().mean()) > 0.97


def test_a_view_asks_for_the_avatars_own_colours_as_they_are_now():
    avatar = embedded_avatar()
    views = views_of(avatar, turned(avatar, [0.0]))
    avatar.blendshapes.opacity_logit.data.fill_(3.0)
    for color in ((0.8, 0.3, 0.2), (0.1, 0.6, 0.5)):
        # Colours are .5 + .282 f (spherical harmonics of degree 0).
        feature = (torch.tensor(color) - 0.5) / 0.28209479
        avatar.blendshapes.color_feature.data.copy_(feature.expand(avatar.num_gaussians, 3))
        avatar.blendshapes.basis_color_feature.data.zero_()
        image = views.frame(avatar, 4).images_rgba
        known = (image[..., 3] > 0) & ~is_unfilmed(image)
        mean = image[known][:, :3].float().mean(0) / 255
        assert mean.tolist() == pytest.approx(color, abs=0.01)


@pytest.mark.parametrize("contrast", [0.0, 0.1])
def test_light_is_smoothed_but_in_hair_with_strands_and_hue_everywhere(contrast: float):
    avatar = embedded_avatar(uv_resolution=128)
    views = views_of(avatar, turned(avatar, [0.0]))
    views.hair_contrast.fill_(contrast)
    avatar.blendshapes.opacity_logit.data.fill_(4.0)
    view = TURNS_DEGREES.index((60, 12))
    frame = views.frame(avatar, view)
    random, noise = torch.Generator().manual_seed(0), {}
    for kind, spread in (
        ("light", torch.randn(avatar.num_gaussians, 1, generator=random)),
        ("hue", torch.randn(avatar.num_gaussians, 1, generator=random) * torch.tensor([1, -1, 0])),
    ):
        avatar.blendshapes.color_feature.data.copy_(spread)
        own = avatar.render(frame.theta, frame.cameras).image[0] * 255
        asked = views.frame(avatar, view).images_rgba[0, ..., :3].float()
        noise[kind] = (own, asked)
    rest = avatar.carrier_vertices(frame.theta)[0]
    v_template = torch.as_tensor(avatar.head.arrays.v_template)
    hair = (v_template[:, 2] < -0.02) & (v_template[:, 1] > 0.06) & (v_template[:, 0].abs() > 0.03)
    cheek = (v_template[:, 2] > 0.02) & (v_template[:, 1].abs() < 0.04)
    left = {}
    for part, chosen in (("hair", hair), ("cheek", cheek)):
        turned_to = places_px(frame.cameras, rest[chosen])
        column, row = turned_to.mean(0).long().tolist()
        place = slice(row - 8, row + 9), slice(column - 8, column + 9)
        for kind, pictures in noise.items():
            own, asked = (picture[place].mean(-1) for picture in pictures)
            if kind == "hue":
                own, asked = (
                    picture[place][..., 0] - picture[place][..., 1] for picture in pictures
                )
            left[part, kind] = float(asked.std() / own.std())
    assert left["hair", "light"] > 0.9 if contrast else left["hair", "light"] < 0.85
    assert left["cheek", "light"] < 0.85
    assert max(left["hair", "hue"], left["cheek", "hue"]) < 0.6


def test_what_the_film_shows_to_be_empty_is_not_closed():
    avatar = embedded_avatar()
    theta = turned(avatar, [0.0])
    low = torch.as_tensor(avatar.head.arrays.v_template)[:, 1] < -0.1
    frame, faded = (
        views_of(avatar, theta, empty=empty).frame(avatar, 0).images_rgba
        for empty in (None, low.float())
    )
    rim, rim_faded = is_unfilmed(frame)[0], is_unfilmed(faded)[0]
    assert torch.equal(within_outline(frame), within_outline(faded))
    neck = (rim_faded & ~rim).nonzero()[:, 0]
    assert len(neck) > 500
    assert int(neck.min()) > SIZE // 2


def test_a_view_in_which_nobody_is_for_certain_asks_for_no_colours():
    avatar = embedded_avatar()
    nowhere = torch.ones(len(avatar.head.arrays.v_template))
    image = views_of(avatar, turned(avatar, [0.0]), empty=nowhere).frame(avatar, 0).images_rgba
    assert is_unfilmed(image).any()
    assert not image[~is_unfilmed(image)].any()


def test_views_turn_about_the_head_as_far_as_they_say():
    avatar = embedded_avatar()
    theta = turned(avatar, [0.0])
    views = views_of(avatar, theta)
    centre = head_centre(avatar, theta)
    before = places_px(front_camera(), centre)
    for view, (yaw, pitch) in enumerate(TURNS_DEGREES):
        frame = views.frame(avatar, view)
        assert torch.allclose(places_px(frame.cameras, centre), before, atol=1e-3)
        turns = views.turns_degrees[view]
        if yaw == 0 or pitch == 0:
            assert turns[:2].tolist() == pytest.approx([yaw, pitch], abs=1e-3)
        assert abs(float(turns[0])) >= abs(yaw) - 1e-3


@pytest.mark.parametrize(("yaw", "pitch"), [(12.0, 0.0), (0.0, -9.0)])
def test_the_film_is_known_to_look_at_the_head_from_where_its_camera_is(yaw: float, pitch: float):
    avatar = embedded_avatar()
    frames = looking(avatar, [yaw], []) if yaw else looking(avatar, [], [pitch])
    ahead, alone = views_of(avatar, frames).seen_from()
    # A turned head sees a camera on its old z axis turned the other way.
    turn = axis_angle_to_matrix(frames[0, avatar.layout.slice("rotation")])
    assert torch.allclose(ahead, turn.T @ torch.tensor([0.0, 0.0, 1.0]), atol=1e-4)
    assert float(alone) == pytest.approx(1, abs=1e-3)
    _, alone = views_of(avatar, looking(avatar, [-5.0, 15.0], [])).seen_from()
    assert float(alone) == pytest.approx(0.5, abs=1e-3)  # 20 of 40 degrees


def test_some_views_open_the_mouth_to_either_side_and_none_closes_it():
    avatar = embedded_avatar()
    theta = turned(avatar, [0.0, 0.0, 0.0])
    jaw = avatar.layout.slice("jaw").start
    theta[1, jaw] = 0.2
    views = views_of(avatar, theta)
    opened = views.theta[:, jaw]
    filmed = theta[[view % len(theta) for view in range(len(opened))], jaw]
    assert (opened >= filmed).all()
    wide = {(yaw > 0) - (yaw < 0) for (yaw, _), rad in zip(TURNS_DEGREES, opened) if rad > 0.1}
    assert wide == {-1, 0, 1}
    others = [k for k in range(views.theta.shape[1]) if k != jaw]
    expected = theta[[view % len(theta) for view in range(len(opened))]]
    assert torch.equal(views.theta[:, others], expected[:, others])


def test_no_view_takes_a_turn_that_the_film_shows():
    avatar = embedded_avatar()
    narrow = views_of(avatar, turned(avatar, [-3.0, 3.0]))
    first = shown(narrow)
    assert len(first) == len(TURNS_DEGREES)
    # The film goes on: the head turns and nods somewhat, then farther than any view does.
    narrow.see(avatar, looking(avatar, [-25.0, 25.0], [-12.0, 12.0]), front_camera())
    left = shown(narrow)
    assert left == {
        view
        for view, (yaw, pitch) in enumerate(narrow.turns_degrees[:, :2].tolist())
        if abs(yaw) > 30 or abs(pitch) > 17
    }
    assert 0 < len(left) < len(first)
    narrow.see(avatar, looking(avatar, [-70.0, 70.0], [-45.0, 45.0]), front_camera())
    assert not shown(narrow)


def test_one_trained_frame_in_forty_is_a_view():
    views = views_of(embedded_avatar(), turned(embedded_avatar(), [0.0]))
    for batch_size in (1, 4, 10, 15, 40):
        steps = range(240)
        taken = sum(views.due(step, batch_size) is not None for step in steps)
        trained = len(steps) * batch_size
        assert taken == len(steps) / 2 or trained / 50 <= taken <= trained / 30


def test_its_state_gives_the_same_views():
    avatar = embedded_avatar()
    views = views_of(avatar, turned(avatar, [-4.0, 4.0]), 0.004, goes_on_below=True)
    copy = VirtualViews(len(avatar.head.arrays.v_template), avatar.layout.size)
    assert copy.due(0, BATCH) is None  # of an earlier version, or not yet begun
    copy.load_state_dict(views.state_dict())
    every, others = (v.frames(avatar, range(len(TURNS_DEGREES))) for v in (views, copy))
    assert torch.equal(every.images_rgba, others.images_rgba)
    assert torch.equal(every.cameras.world_to_camera, others.cameras.world_to_camera)
    assert torch.equal(views.frame(avatar, 3).images_rgba, copy.frame(avatar, 3).images_rgba)
    assert [views.due(step, BATCH) for step in range(90)] == [
        copy.due(step, BATCH) for step in range(90)
    ]


def test_below_a_mesh_that_the_person_goes_beyond_nothing_is_known():
    avatar = embedded_avatar()
    theta = turned(avatar, [0.0, 4.0])
    theta[:, avatar.layout.slice("translation").start + 1] = 0.04
    head = drawn_thicker(avatar, theta, 0.0)
    person = head.clone()
    lowest = int((head[..., 3] > 0).any(0).any(1).nonzero().max())
    assert lowest < SIZE - 10
    person[:, lowest - 5 :, 60:200] = 255
    for images, goes_on in ((head, False), (person, True)):
        found = measure_outline(avatar, MeshField(avatar), theta, front_camera(), images)
        assert found.goes_on_below == goes_on
        views = VirtualViews(len(found.offset_m), avatar.layout.size)
        views.begin(avatar, found, theta, front_camera())
        image = views.frame(avatar, 0).images_rgba
        assert bool(is_unfilmed(image)[0, -1].all()) == goes_on
