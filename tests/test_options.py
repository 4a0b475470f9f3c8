from dataclasses import dataclass, field
from typing import Annotated, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import Between, CheckedOptions, Count, FrameRate, Share, check_options


@dataclass(frozen=True)
class Inner(CheckedOptions):
    rate: FrameRate = 25.0


@dataclass(frozen=True)
class Outer(CheckedOptions):
    count: Count | None = None
    color: tuple[Share, Share] = (0.0, 1.0)
    opacity: Annotated[float, Between(0, 1, open=True)] = 0.5
    inner: Inner = field(default_factory=Inner)
    free: float = 0.0
    shape: Literal["round", "flat", "none"] = "round"
    engine: Literal["own", "host"] | None = None
    pose: Literal["up", "down"] | Literal["auto"] = "auto"
    sides: int | Literal["all"] = "all"


@pytest.mark.parametrize(
    ("given_values", "told"),
    [
        ({"count": 0}, "--count is 0. Give a number from 1 to 1,000,000,000."),
        ({"count": True}, "--count is True."),
        ({"color": (0.5, 1.5)}, "--color is 1.5."),
        ({"opacity": 1.0}, r"from 0 to 1 \(both excluded\)"),
        ({"opacity": float("nan")}, "--opacity is nan"),
        ({"shape": "square"}, "--shape is 'square'. Give 'round', 'flat' or 'none'."),
        ({"engine": "none"}, "--engine is 'none'. Give 'own', 'host' or None."),
        ({"shape": None}, "--shape is None. Give 'round', 'flat' or 'none'."),
        ({"shape": True}, "--shape is True."),
        ({"pose": "left"}, "--pose is 'left'. Give 'up', 'down' or 'auto'."),
    ],
)
def test_a_value_out_of_its_range_is_told_with_its_option(given_values, told):
    with pytest.raises(UserError, match=told):
        Outer(**given_values)


@given(st.floats())
def test_a_rate_is_taken_exactly_where_it_lies_within(rate):
    try:
        Inner(rate)
    except UserError:
        assert not 0.01 <= rate <= 1000
    else:
        assert 0.01 <= rate <= 1000


class Host:
    workers: int = 2
    device: Literal["cpu", "cuda"] = "cpu"


def test_options_within_are_named_by_their_path_and_hosts_have_ranges_too():
    with pytest.raises(UserError, match=r"--machine\.workers is -1"):
        check_options(Host, {"workers": -1}, "machine.", {Host: {"workers": Between(0, 4)}})
    # A host's words are its own affair: there are devices that it does not name.
    check_options(Host, {"device": "elsewhere"})
    inner = Inner()
    object.__setattr__(inner, "rate", 0.0)
    with pytest.raises(UserError, match=r"--groups\.a\.rate is 0\.0"):
        check_options(Outer, {"groups": {"a": inner}})
    check_options(Outer, {"free": float("inf"), "count": None})


def test_every_choice_is_taken():
    assert Outer(shape="none", engine="host").shape == "none"
    assert Outer(engine=None, pose="up").engine is None
    assert Outer(sides=3).sides == 3
