import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.driving.theta_map import NamedMap, ThetaNames
from rgbavatar_ns.driving.transfer import DrivingOptions, drive, make_relative
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import ThetaField, ThetaLayout
from rgbavatar_ns.head.rotations import axis_angle_to_matrix


def _layout(expressions: int, eyelids: bool = False) -> ThetaLayout:
    fields = [ThetaField("expression", expressions, "linear")]
    fields += [ThetaField(name, 3, "axis_angle") for name in ("rotation", "neck", "jaw")]
    if eyelids:
        fields.append(ThetaField("eyelids", 2, "linear"))
    return ThetaLayout((*fields, ThetaField("translation", 3, "translation")))


_OURS = ThetaNames(_layout(3), ("smile", "frown", "blink"))
_THEIRS = ThetaNames(_layout(2, eyelids=True), ("frown", "pout"))


def _theta(names: ThetaNames, count: int, seed: int = 0) -> torch.Tensor:
    return 0.3 * torch.randn(
        count, names.layout.size, generator=torch.Generator().manual_seed(seed)
    )


def _statistics(theta: torch.Tensor, names: ThetaNames = _OURS) -> TrainingStatistics:
    return TrainingStatistics.of(theta, torch.zeros(len(theta), 1), names.layout)


def _driven(theta: torch.Tensor, own: TrainingStatistics, **options: Any) -> torch.Tensor:
    mapped = NamedMap(_OURS, _OURS)(theta)
    return drive(mapped, _OURS.layout, own, 25.0, DrivingOptions(**options)).theta


def test_numbers_go_to_the_same_name_and_what_has_none_is_listed():
    theta = _theta(_THEIRS, 4)
    mapped = NamedMap(_THEIRS, _OURS)(theta)
    driver, ours = _THEIRS.layout.split(theta), _OURS.layout.split(mapped.theta)
    assert torch.equal(ours["expression"][:, 1], driver["expression"][:, 0])
    assert not ours["expression"][:, [0, 2]].any()
    for name in ("rotation", "neck", "jaw", "translation"):
        assert torch.equal(ours[name], driver[name])
    assert mapped.unmapped == ("pout", "eyelids[0]", "eyelids[1]")
    assert mapped.missing == ("smile", "blink")
    assert int(mapped.known.sum()) == 13


def test_the_same_layout_maps_to_itself():
    theta = _theta(_OURS, 3)
    mapped = NamedMap(_OURS, _OURS)(theta)
    assert torch.equal(mapped.theta, theta)
    assert mapped.unmapped == mapped.missing == ()


def test_a_driver_without_a_known_expression_or_of_another_size_is_refused():
    other = ThetaNames(_layout(2), ("expression_0", "expression_1"))
    with pytest.raises(UserError, match=r"expression_0, expression_1.*smile, frown, blink"):
        NamedMap(other, _OURS)(_theta(other, 2))
    with pytest.raises(UserError, match="has 5 numbers"):
        NamedMap(_THEIRS, _OURS)(torch.zeros(2, 5))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_relative_driving_sends_the_drivers_reference_to_ours_and_composes_turns(seed):
    theta = _theta(_OURS, 3, seed)
    theirs, ours = _theta(_OURS, 2, seed + 1)
    layout = _OURS.layout
    at_rest = make_relative(theirs[None], theirs, ours, layout)[0]
    assert torch.allclose(at_rest, ours, atol=1e-5)
    itself = make_relative(theta, theirs, theirs, layout)
    assert torch.allclose(itself, theta, atol=1e-5)
    there = make_relative(theta, theirs, ours, layout)
    back = make_relative(there, ours, theirs, layout)
    assert torch.allclose(back, theta, atol=1e-5)
    for name in ("rotation", "neck", "jaw"):
        moved, driver, start, end = (
            axis_angle_to_matrix(values[..., layout.slice(name)])
            for values in (there, theta, theirs, ours)
        )
        # The same turn leads from each reference to its frame.
        assert torch.allclose(moved @ end.mT, driver @ start.mT, atol=1e-5)


def test_a_driver_with_its_own_neutral_shows_ours_at_rest():
    own = _statistics(torch.cat([torch.zeros(1, 15), _theta(_OURS, 20).abs() + 0.1]))
    bias = torch.zeros(_OURS.layout.size)
    bias[:3] = torch.tensor([0.4, 0.0, 0.2])
    theta = torch.cat([torch.zeros(1, 15), _theta(_OURS, 5).abs() + 0.1]) + bias
    for relative, size in (("neutral", 0.0), ("off", 0.6)):
        driven = _driven(theta, own, relative=relative, pose="absolute")
        assert driven[0].abs().sum().item() == pytest.approx(size, abs=1e-5)


def test_mean_driving_has_our_mean_and_the_pose_is_as_asked():
    own = _statistics(_theta(_OURS, 30, seed=3))
    theta = _theta(_OURS, 40, seed=4)
    driven = _driven(theta, own, relative="mean")
    linear = slice(0, 3)
    assert torch.allclose(driven[:, linear].mean(0), own.theta_mean[linear], atol=1e-6)
    for name in ("rotation", "neck", "translation"):
        numbers = _OURS.layout.slice(name)
        if name == "translation":
            assert torch.allclose(driven[:, numbers].mean(0), own.theta_mean[numbers], atol=1e-6)
        kept, taken = (_driven(theta, own, pose=way)[:, numbers] for way in ("keep", "absolute"))
        assert torch.equal(kept, own.theta_mean[numbers].expand(40, 3))
        assert torch.allclose(taken, theta[:, numbers], atol=1e-5)
    assert _driven(theta, own, pose="keep")[:, _OURS.layout.slice("jaw")].std(0).min() > 0.05


def test_projection_holds_expressions_to_those_seen_and_leaves_the_pose():
    generator = torch.Generator().manual_seed(5)
    # Only two ways to move were seen: smile with blink, and the jaw.
    way = torch.zeros(2, _OURS.layout.size)
    way[0, [0, 2]] = torch.tensor([0.8, 0.6])
    way[1, _OURS.layout.slice("jaw").start] = 1.0
    seen = torch.rand(50, 2, generator=generator) @ way
    own = _statistics(seen)
    assert len(own.components) == 2
    assert torch.allclose(own.project(seen), seen, atol=1e-5)
    wild = _theta(_OURS, 20) * 5
    held = own.project(wild)
    assert torch.allclose(own.project(held), held, atol=1e-5), "projecting again changes nothing"
    expressive, along = own.expressive, (held - own.theta_mean) @ own.components.T
    assert torch.equal(held[:, ~expressive], wild[:, ~expressive])
    assert (along <= own.component_max + 1e-5).all()
    assert (along >= own.component_min - 1e-5).all()
    assert held[:, 1].abs().max() < 1e-5, "a frown was never seen"


def test_smoothing_takes_jitter_from_a_performance():
    own = _statistics(_theta(_OURS, 30))
    calm = torch.sin(torch.arange(200) / 25 * math.pi)[:, None] * torch.full((15,), 0.2)
    noisy = calm + 0.02 * torch.randn(200, 15, generator=torch.Generator().manual_seed(6))
    plain, smooth = (
        _driven(noisy, own, relative="off", pose="absolute", smooth=on) for on in (False, True)
    )

    def jitter(theta):
        return theta.diff(n=2, dim=0).std().item()

    assert jitter(smooth) < 0.4 * jitter(plain)
    assert (smooth - calm).abs().mean() < 0.1
