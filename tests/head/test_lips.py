import pytest
import torch

from rgbavatar_ns.head import EMBEDDED_BUST, HeadArrays, HeadModel
from rgbavatar_ns.head.lips import LipGap
from tests.avatar.small_head import small_head_arrays


def _gap(arrays: HeadArrays) -> LipGap:
    head = HeadModel(arrays)
    found = LipGap.of(head, torch.zeros(head.num_identity))
    assert found is not None
    return found


@pytest.mark.parametrize("name", [HeadArrays.embedded().name, EMBEDDED_BUST])
def test_the_jaw_parts_the_lips_and_the_heads_turn_does_not(name):
    gap, arrays = _gap(HeadArrays.embedded(name)), HeadArrays.embedded(name)
    layout = HeadModel(arrays).layout
    theta = torch.zeros(4, layout.size)
    theta[1:, gap.jaw] = 0.2
    theta[2, layout.slice("rotation")] = torch.tensor([0.4, -0.5, 0.3])
    theta[3, layout.slice("neck")] = torch.tensor([-0.3, 0.2, 0.1])
    closed, opened, *turned = gap(theta).tolist()
    assert abs(closed) < 0.004, "closed lips touch"
    # A chin 8 cm from the hinge drops by 16 mm at .2 rad, the lip nearly as far.
    assert 0.010 < opened - closed < 0.020
    assert turned == pytest.approx([opened, opened], abs=1e-6)


def test_flames_lips_part_alike(flame_2020):
    flame, own = _gap(flame_2020), _gap(HeadArrays.embedded())
    assert flame.slope_m_per_rad == pytest.approx(own.slope_m_per_rad, rel=0.35)


def test_a_head_of_another_topology_has_none():
    head = HeadModel(small_head_arrays())
    assert LipGap.of(head, torch.zeros(head.num_identity)) is None
