"""From one head's theta to another's: shoulders, FLAME, and what no name joins."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.driving.live_transfer import LiveTransfer
from rgbavatar_ns.driving.source import PerformerHead
from rgbavatar_ns.driving.theta_map import NamedMap, ThetaNames, arkit_theta, theta_map
from rgbavatar_ns.driving.transfer import (
    DrivingOptions,
    own_reference,
    reference_of,
    relative_theta,
)
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import front_camera
from rgbavatar_ns.head import EMBEDDED_BUST, HeadArrays, HeadModel
from rgbavatar_ns.head.arkit import ARKIT_NAMES
from rgbavatar_ns.head.flame import FLAME_VERTICES, load_flame
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from tests.avatar.small_head import small_head_arrays
from tests.export.subject import avatar_of, lively_theta

_HEAD, _BUST = HeadArrays.embedded(), HeadArrays.embedded(EMBEDDED_BUST)


def _names(arrays: HeadArrays) -> ThetaNames:
    return ThetaNames.of(HeadModel(arrays).layout, arrays)


def _turn(theta: torch.Tensor, names: ThetaNames) -> torch.Tensor:
    parts = names.layout.split(theta)
    return axis_angle_to_matrix(parts["rotation"]) @ axis_angle_to_matrix(parts["neck"])


def test_a_head_upon_shoulders_turns_on_them():
    head, bust = _names(_HEAD), _names(_BUST)
    theta = lively_theta(avatar_of(), 5)
    mapped = NamedMap(head, bust)(theta)
    torch.testing.assert_close(_turn(mapped.theta, bust), _turn(theta, head))
    still = bust.layout.split(mapped.theta)
    assert not still["rotation"].any()
    assert not still["translation"].any()
    assert not mapped.known[bust.layout.slice("rotation")].any()
    assert mapped.known[bust.layout.slice("neck")].all()


def test_the_shoulders_of_the_avatar_stay_where_its_film_had_them():
    avatar = avatar_of(arrays=_BUST)
    film = lively_theta(avatar, 20, seed=3)
    own = TrainingStatistics.of(film, torch.zeros(20, 1), avatar.layout)
    performed = lively_theta(avatar_of(), 8, seed=4)
    mapped = NamedMap(_names(_HEAD), _names(_BUST))(performed)
    driver = reference_of(mapped.theta, avatar.layout)
    for pose in ("relative", "absolute"):
        driven = relative_theta(
            mapped.theta,
            driver,
            own_reference(own),
            mapped.known,
            own,
            avatar.layout,
            DrivingOptions(pose=pose),
        )
        for name in ("rotation", "translation"):
            where = avatar.layout.slice(name)
            assert torch.equal(driven[:, where], own.theta_mean[where].expand(8, 3))
        assert driven[:, avatar.layout.slice("neck")].std(0).min() > 0.01


def test_a_person_with_shoulders_turns_a_head_alone_as_the_head_turned():
    head, bust = _names(_HEAD), _names(_BUST)
    theta = lively_theta(avatar_of(arrays=_BUST), 5)
    mapped = NamedMap(bust, head)(theta)
    torch.testing.assert_close(_turn(mapped.theta, head), _turn(theta, bust))
    assert mapped.known[head.layout.slice("neck")].all()
    assert not mapped.theta[:, head.layout.slice("neck")].any()


def test_arkits_names_lead_to_flame(flame_2020):
    """A smile of the embedded head widens FLAME's mouth as much, and turns its head alike."""
    avatar = avatar_of(arrays=flame_2020)
    way = theta_map(HeadModel(_HEAD).layout, _HEAD, avatar)
    theta = torch.zeros(2, HeadModel(_HEAD).layout.size)
    for name in ("mouthSmileLeft", "mouthSmileRight"):
        theta[1, _HEAD.expression_names.index(name)] = 1.0
    theta[1, HeadModel(_HEAD).layout.slice("neck")] = torch.tensor([0.0, 0.3, 0.0])
    mapped = way(theta)
    parts = avatar.layout.split(mapped.theta)
    torch.testing.assert_close(parts["rotation"][1], torch.tensor([0.0, 0.3, 0.0]))
    still = mapped.theta.clone()
    still[:, avatar.layout.slice("rotation")] = 0
    vertices = avatar.head(still, torch.zeros(avatar.head.num_identity))
    moved = (vertices[1] - vertices[0]).norm(dim=1).max().item()
    own = HeadModel(_HEAD)
    theta[:, own.layout.slice("neck")] = 0
    wanted = (own(theta)[1] - own(theta)[0]).norm(dim=1).max().item()
    assert moved == pytest.approx(wanted, rel=0.1)
    assert not mapped.known[avatar.layout.slice("translation")].any()


def _other_version(flame: HeadArrays, expressions: int = 100) -> HeadArrays:
    """Its expressions mixed, as another version has other directions of the same faces."""
    generator = np.random.default_rng(3)
    mixed, _ = np.linalg.qr(generator.normal(size=(100, 100)))
    own = flame.shapedirs[..., flame.num_identity :]
    directions = [flame.shapedirs[..., : flame.num_identity], (own @ mixed)[..., :expressions]]
    return replace(
        flame,
        name="FLAME 2023",
        shapedirs=np.concatenate(directions, 2).astype(np.float32),
        expression_names=flame.expression_names[:expressions],
    )


@pytest.mark.parametrize(
    ("expressions", "teeth"), [(100, "strips"), (50, "strips"), (100, "blocks")]
)
def test_another_version_of_flame_moves_the_same_points(
    flame_2020, flame_2020_pickle, expressions, teeth
):
    same = teeth == "strips"
    as_read = flame_2020 if same else load_flame(flame_2020_pickle, teeth_form=teeth)
    driver, avatar = _other_version(as_read, expressions), avatar_of(arrays=flame_2020)
    head = HeadModel(driver)
    theta = torch.zeros(6, head.layout.size)
    generator = torch.Generator().manual_seed(1)
    expression, jaw = (head.layout.slice(name) for name in ("expression", "jaw"))
    theta[1:, expression] = torch.randn(5, expressions, generator=generator)
    theta[1:, jaw.start] = 0.1
    mapped = theta_map(head.layout, driver, avatar)(theta)
    wanted, shown = (
        model(rows, torch.zeros(model.num_identity))[:, :FLAME_VERTICES]
        for model, rows in ((head, theta), (avatar.head, mapped.theta))
    )
    moved, apart = (
        (one - other).norm(dim=-1).mean() for one, other in ((wanted, wanted[:1]), (shown, wanted))
    )
    assert apart < 0.05 * moved
    assert torch.equal(mapped.theta[:, avatar.layout.slice("jaw")], theta[:, jaw])
    assert mapped.known[avatar.layout.slice("expression")].all()
    assert (mapped.unmapped, mapped.missing) == ((), ())
    told = "the driver's expressions are those of FLAME 2023, the avatar's of FLAME 2020: they are"
    assert mapped.told.startswith(told)
    share = int(mapped.told.split()[-8])
    assert share <= 5
    # Who drives live is told the same.
    film, camera = lively_theta(avatar, 4), front_camera(avatar, 64, 64)
    views = camera.world_to_camera.expand(4, 4, 4)
    own = TrainingStatistics.of(film, torch.zeros(4, 1), avatar.layout, views)
    live = LiveTransfer(avatar, own, PerformerHead(head.layout, driver), camera)
    assert live.told == mapped.told


def test_of_one_version_coefficients_are_copied(flame_2020):
    """Also from files of 16 bits, and of fewer expressions."""
    avatar = avatar_of(arrays=flame_2020)
    rough = _other_version(flame_2020).shapedirs.copy()
    rough[..., flame_2020.num_identity :] = flame_2020.shapedirs[..., flame_2020.num_identity :]
    rough = rough.astype(np.float16).astype(np.float32)
    names = flame_2020.expression_names
    fewer = replace(flame_2020, shapedirs=rough[..., :-50], expression_names=names[:50])
    for driver, missing in ((replace(flame_2020, shapedirs=rough), ()), (fewer, names[50:])):
        layout = HeadModel(driver).layout
        theta = torch.randn(3, layout.size, generator=torch.Generator().manual_seed(1))
        mapped = theta_map(layout, driver, avatar)(theta)
        where = slice(0, len(driver.expression_names))
        assert torch.equal(mapped.theta[:, where], theta[:, where])
        assert (mapped.told, mapped.missing) == ("", missing)


def test_names_say_what_they_say_whatever_they_move():
    """A head whose smile is another one still smiles by its name."""
    driver = replace(_HEAD, shapedirs=0.5 * _HEAD.shapedirs)
    theta = lively_theta(avatar_of(), 3)
    mapped = theta_map(HeadModel(driver).layout, driver, avatar_of())(theta)
    assert torch.equal(mapped.theta, theta)
    assert mapped.told == ""


def test_coefficients_alone_tell_nothing_of_the_head():
    avatar = avatar_of()
    mapped = arkit_theta(avatar, torch.zeros(1, len(ARKIT_NAMES)), None)
    for name in ("rotation", "neck", "translation"):
        assert not mapped.known[avatar.layout.slice(name)].any()
    assert mapped.known[avatar.layout.slice("jaw").start]
    turned = arkit_theta(avatar, torch.zeros(1, len(ARKIT_NAMES)), torch.zeros(1, 3))
    assert turned.known[avatar.layout.slice("rotation")].all()


def test_heads_that_share_no_name_are_refused():
    tiny = small_head_arrays()
    with pytest.raises(UserError, match="has no expression that the avatar knows"):
        theta_map(HeadModel(tiny).layout, tiny, avatar_of())
