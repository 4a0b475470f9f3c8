"""From one head's theta to another's: shoulders, FLAME, and what no name joins."""

import pytest
import torch

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.driving.theta_map import NamedMap, ThetaNames, arkit_theta, theta_map
from rgbavatar_ns.driving.transfer import (
    DrivingOptions,
    own_reference,
    reference_of,
    relative_theta,
)
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import EMBEDDED_BUST, HeadArrays, HeadModel
from rgbavatar_ns.head.arkit import ARKIT_NAMES
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
