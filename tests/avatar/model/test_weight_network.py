import pytest
import torch

from rgbavatar_ns.avatar import WeightNetwork
from tests.avatar.small_head import random_theta


def test_mlp_is_three_layers_with_relu_between():
    network = WeightNetwork(5, 3, hidden_width=7, generator=torch.Generator().manual_seed(0))
    x = torch.randn(4, 5)
    (w1, b1, w2, b2, w3, b3) = (p.detach() for p in network.parameters())
    hidden = torch.relu(torch.relu(x @ w1.T + b1) @ w2.T + b2)
    torch.testing.assert_close(network(x), hidden @ w3.T + b3)
    assert w1.shape == (7, 5)
    assert w2.shape == (7, 7)


def test_linear_variant_is_affine():
    network = WeightNetwork(5, 3, kind="linear", generator=torch.Generator().manual_seed(0))
    a, b = torch.randn(2, 1, 5)
    middle = network((a + b) / 2)
    torch.testing.assert_close(middle, (network(a) + network(b)) / 2)


def test_initial_values_follow_torchs_distribution_and_the_generator_alone():
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    first = WeightNetwork(100, 20, generator=torch.Generator().manual_seed(5))
    assert torch.equal(before, torch.random.get_rng_state())
    torch.manual_seed(2)
    second = WeightNetwork(100, 20, generator=torch.Generator().manual_seed(5))
    for a, b in zip(first.parameters(), second.parameters()):
        assert torch.equal(a, b)
    # torch.nn.Linear draws from U(-1/sqrt(in), 1/sqrt(in)): bound .1, deviation .1 / sqrt(3).
    weight = next(first.parameters())
    assert weight.abs().max() <= 0.1
    assert abs(weight.std().item() - 0.1 / 3**0.5) < 2e-3


@pytest.mark.parametrize(
    ("field", "blind", "watching"),
    [
        ("translation", {}, {"translation_input": True}),
        ("rotation", {"pose_input": False}, {}),
    ],
)
def test_psi_sees_rotations_but_not_translation_unless_told(make_avatar, field, blind, watching):
    for changes, sees in ((blind, False), (watching, True)):
        avatar = make_avatar(**changes)
        theta = random_theta(avatar.layout, 2)
        moved = theta.clone()
        moved[:, avatar.layout.slice(field)] += 0.3
        assert torch.equal(avatar.weights(theta), avatar.weights(moved)) is not sees
