import math

import pytest
import torch

from rgbavatar_ns.avatar.methods.neighbours import neighbour_distance


def test_the_three_nearest_count_as_worked_by_hand():
    places = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 0, 0]])
    found = neighbour_distance(places)
    assert found[0].item() == pytest.approx(math.sqrt((1 + 4 + 9) / 3))
    assert found[1].item() == pytest.approx(math.sqrt((1 + 5 + 10) / 3))


def test_of_few_places_all_count_and_of_equal_ones_the_least_remains():
    pair = torch.tensor([[0.0, 0, 0], [0, 3, 4]], dtype=torch.float64)
    torch.testing.assert_close(neighbour_distance(pair), torch.full((2,), 5.0).double())
    assert neighbour_distance(pair[:1], 0.25).tolist() == [0.25]
    same = neighbour_distance(torch.ones(6, 3), 1e-3)
    torch.testing.assert_close(same, torch.full((6,), 1e-3))
