"""How far a head is turned for a camera."""

import pytest
import roma
import torch

from rgbavatar_ns.head import HeadModel, turn_range, turn_seen

_LAYOUT = HeadModel.embedded().layout
_FRONT = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


def _views(turns: torch.Tensor) -> torch.Tensor:
    """Cameras that the world is turned for, by matrices [F, 3, 3]."""
    views = _FRONT.repeat(len(turns), 1, 1)
    views[:, :3, :3] = views[:, :3, :3] @ turns
    return views


@pytest.mark.parametrize("seed", range(3))
def test_angles_are_those_of_the_turns_about_y_then_x_then_z(seed):
    generator = torch.Generator().manual_seed(seed)
    spans = torch.tensor([170.0, 80.0, 170.0])
    wanted = spans * (2 * torch.rand(20, 3, generator=generator) - 1)
    # Head to camera: -yaw about y, then -pitch about x, then roll about z.
    yaw, pitch, roll = (
        roma.rotvec_to_rotmat(angle[:, None] * torch.eye(3)[axis])
        for angle, axis in zip(wanted.deg2rad().unbind(1), (1, 0, 2))
    )
    views = _views(roll @ pitch.mT @ yaw.mT)
    seen = turn_seen(torch.zeros(1, _LAYOUT.size), views, _LAYOUT)
    assert torch.allclose(seen, wanted, atol=1e-2)


def test_it_is_no_matter_whether_head_neck_or_camera_turns():
    turn = torch.tensor([[0.1, -0.5, 0.2], [0.0, 0.4, 0.0]])
    head, neck, still = (torch.zeros(2, _LAYOUT.size) for _ in range(3))
    head[:, _LAYOUT.slice("rotation")] = neck[:, _LAYOUT.slice("neck")] = turn
    front = _views(torch.eye(3)[None])
    expected = turn_seen(still, _views(roma.rotvec_to_rotmat(turn)), _LAYOUT)
    assert torch.allclose(turn_seen(head, front, _LAYOUT), expected, atol=1e-4)
    assert torch.allclose(turn_seen(neck, front, _LAYOUT), expected, atol=1e-4)
    # A head that turns to its left shows its right side.
    assert expected[1, 0].item() == pytest.approx(-22.9, abs=0.1)


def test_one_bad_frame_of_sixty_hardly_changes_the_range():
    turns = torch.linspace(-20, 10, 60)[:, None].repeat(1, 3)
    low, high = turn_range(turns)
    turns[7] = 160.0
    bad_low, bad_high = turn_range(turns)
    assert (bad_low - low).abs().max() < 1
    assert (bad_high - high).abs().max() < 1
    assert low[0].item() == pytest.approx(-19.4, abs=0.1)


def test_a_film_of_the_back_is_no_full_circle():
    turns = torch.tensor([170.0, 175.0, 180.0, -175.0, -170.0])[:, None].repeat(1, 3)
    low, high = turn_range(turns)
    assert (high - low < 21).all()
