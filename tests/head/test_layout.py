import json

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel, ThetaField, ThetaLayout
from rgbavatar_ns.head.rotations import axis_angle_to_matrix

LAYOUT = ThetaLayout(
    (
        ThetaField("expression", 4, "linear"),
        ThetaField("jaw", 3, "axis_angle"),
        ThetaField("eyelids", 2, "linear"),
        ThetaField("translation", 3, "translation"),
    )
)


@given(st.lists(st.integers(1, 4), max_size=3), st.integers(0, 1000))
def test_join_undoes_split(batch: list[int], seed: int) -> None:
    theta = torch.randn(*batch, LAYOUT.size, generator=torch.Generator().manual_seed(seed))
    parts = LAYOUT.split(theta)
    assert [tuple(part.shape) for part in parts.values()] == [
        (*batch, size) for size in (4, 3, 2, 3)
    ]
    assert torch.equal(LAYOUT.join(parts), theta)


def test_a_missing_field_is_zero_and_batch_axes_broadcast() -> None:
    jaw = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    theta = LAYOUT.join({"jaw": jaw, "translation": torch.ones(3)})
    wanted = [[0, 0, 0, 0, 1, 2, 3, 0, 0, 1, 1, 1], [0, 0, 0, 0, 4, 5, 6, 0, 0, 1, 1, 1]]
    assert theta.tolist() == wanted


def test_between_is_linear_but_for_rotations_which_turn() -> None:
    # The same turn, written the long way round: half a turn about x, and nearly so backwards.
    first = LAYOUT.join({"jaw": torch.tensor([3.1, 0.0, 0.0]), "eyelids": torch.zeros(2)})
    second = LAYOUT.join({"jaw": torch.tensor([-3.1, 0.0, 0.0]), "eyelids": torch.ones(2)})
    assert LAYOUT.between(first, second, 0.0) is first
    assert LAYOUT.between(first, second, 1.0) is second
    middle = LAYOUT.split(LAYOUT.between(first, second, 0.5))
    assert middle["eyelids"].tolist() == [0.5, 0.5]
    assert middle["expression"].tolist() == [0.0] * 4
    torch.testing.assert_close(middle["jaw"].abs(), torch.tensor([torch.pi, 0.0, 0.0]))


def test_slices_follow_one_another() -> None:
    assert LAYOUT.slice("expression") == slice(0, 4)
    assert LAYOUT.slice("jaw") == slice(4, 7)
    assert LAYOUT.slice("translation") == slice(9, 12)
    assert LAYOUT.size == 12
    assert "jaw" in LAYOUT
    assert "neck" not in LAYOUT


def test_layout_survives_json() -> None:
    for layout in (LAYOUT, HeadModel.embedded().layout):
        assert ThetaLayout.from_json(json.loads(json.dumps(layout.to_json()))) == layout


@pytest.mark.parametrize(
    "values",
    [
        [{"name": "jaw", "size": 3}],
        [{"name": "jaw", "size": 3, "form": "axis_angle", "unit": "rad"}],
        [{"name": "jaw", "size": 3, "form": "euler"}],
        [{"name": "jaw", "size": 4, "form": "axis_angle"}],
        [{"name": "a", "size": 1, "form": "linear"}, {"name": "a", "size": 1, "form": "linear"}],
        [{"name": "jaw", "size": float("inf"), "form": "linear"}],
        ["jaw"],
    ],
)
def test_json_of_something_else_is_refused(values: list) -> None:
    with pytest.raises(UserError):
        ThetaLayout.from_json(values)


def test_unknown_fields_and_wrong_sizes_are_refused_by_name() -> None:
    with pytest.raises(UserError, match="neck"):
        LAYOUT.join({"neck": torch.zeros(3)})
    with pytest.raises(UserError, match="neck"):
        LAYOUT.slice("neck")
    with pytest.raises(UserError, match="jaw"):
        LAYOUT.join({"jaw": torch.zeros(4)})
    with pytest.raises(UserError, match="13 numbers"):
        LAYOUT.split(torch.zeros(2, 13))
    with pytest.raises(UserError):
        LAYOUT.join({})


@pytest.mark.parametrize(
    ("place", "value", "field"),
    [
        (0, 99.0, None),
        (0, -101.0, "expression reaches 101"),
        (8, 1e30, "eyelids"),
        (4, 12.5, None),
        (5, 12.6, "jaw"),
        (6, -1e38, "jaw reaches"),
        (11, 99.0, None),
        (11, -101.0, "translation"),
        (3, float("nan"), "expression reaches nan"),
        (10, float("inf"), "translation"),
    ],
)
def test_what_no_person_can_do_is_told(place: int, value: float, field: str | None) -> None:
    theta = torch.zeros(2, LAYOUT.size)
    theta[1, place] = value
    for told in (LAYOUT.absurd(theta), LAYOUT.absurd(theta[1])):
        assert told is None if field is None else (told or "").startswith(field)
    assert LAYOUT.absurd(theta[:0]) is None


@pytest.mark.parametrize("include_pose", [True, False])
@pytest.mark.parametrize("include_translation", [True, False])
def test_network_features_by_hand(include_pose: bool, include_translation: bool) -> None:
    theta = torch.randn(2, 3, LAYOUT.size, generator=torch.Generator().manual_seed(0))
    features = LAYOUT.network_features(theta, include_pose, include_translation)
    matrix = axis_angle_to_matrix(theta[..., 4:7])
    wanted = [theta[..., :4]]
    wanted += [matrix[..., 0, :], matrix[..., 1, :]] if include_pose else []
    wanted += [theta[..., 7:9]]
    wanted += [theta[..., 9:]] if include_translation else []
    assert torch.equal(features, torch.cat(wanted, -1))
    assert features.shape[-1] == LAYOUT.feature_size(include_pose, include_translation)
