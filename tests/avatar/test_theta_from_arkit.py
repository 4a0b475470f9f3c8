"""`Avatar.theta_from_arkit`: what a program that knows ARKit needs to drive an avatar."""

import pytest
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import EMBEDDED_BUST, HeadArrays
from rgbavatar_ns.head.arkit import ARKIT_NAMES
from tests.avatar.small_head import small_head_arrays
from tests.export.subject import avatar_of


def test_names_and_rows_mean_the_same():
    avatar = avatar_of()
    named = avatar.theta_from_arkit({"jawOpen": 1, "mouthSmileLeft": 0.5, "EyeBlinkLeft": 0.25})
    row = torch.zeros(2, 52)
    for name, value in (("jawOpen", 1.0), ("mouthSmileLeft", 0.5), ("eyeBlinkLeft", 0.25)):
        row[0, ARKIT_NAMES.index(name)] = value
    several = avatar.theta_from_arkit(row)
    assert torch.equal(several[0], named)
    assert not several[1].any()
    assert named[avatar.head.arrays.expression_names.index("mouthSmileLeft")] == 0.5


def test_the_head_turns_where_it_hangs():
    turn = torch.tensor([0.1, -0.2, 0.05])
    for avatar, field in (
        (avatar_of(), "rotation"),
        (avatar_of(arrays=HeadArrays.embedded(EMBEDDED_BUST)), "neck"),
    ):
        theta = avatar.theta_from_arkit({}, turn)
        assert torch.equal(theta[avatar.layout.slice(field)], turn)
        assert int((theta != 0).sum()) == 3


def test_what_is_none_of_arkits_is_told():
    avatar = avatar_of()
    with pytest.raises(UserError, match="no blend shape 'smile'"):
        avatar.theta_from_arkit({"smile": 0.5})
    with pytest.raises(UserError, match="hold NaN"):
        avatar.theta_from_arkit(torch.full((52,), torch.nan))
    with pytest.raises(UserError, match="hold NaN"):
        avatar.theta_from_arkit({}, torch.tensor([0.0, torch.inf, 0.0]))


@pytest.mark.usefixtures("unchecked_types")
def test_what_is_no_row_of_numbers_is_told():
    avatar = avatar_of()
    for value in ("0.5", None, [0.5], 10**400):
        with pytest.raises(UserError, match=r"jawOpen is .*Give a number from 0 to 1"):
            avatar.theta_from_arkit({"jawOpen": value})
    for value in ("jawOpen", None, [0.0] * 52):
        with pytest.raises(UserError, match=r"ARKit values are (str|NoneType|list)\..*a mapping"):
            avatar.theta_from_arkit(value)
    with pytest.raises(UserError, match="no blend shape '3'"):
        avatar.theta_from_arkit({3: 0.5})
    # A row of Live Link Face's table, with the turns of head and eyes.
    for shape in ((61,), (4, 61), (4, 51), ()):
        with pytest.raises(UserError, match=r"ARKit values are \[.*the 52 blend shapes.*timecode"):
            avatar.theta_from_arkit(torch.zeros(shape))


def test_a_head_without_a_face_is_told():
    with pytest.raises(UserError, match="No face was found"):
        avatar_of(arrays=small_head_arrays()).theta_from_arkit({"jawOpen": 0.5})
