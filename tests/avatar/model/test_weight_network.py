import pytest
import torch

from rgbavatar_ns.avatar import Avatar, WeightNetwork
from rgbavatar_ns.avatar.model.weight_network import softly_within
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


def test_within_the_film_theta_is_itself_and_beyond_it_goes_ever_less_far():
    low, high = torch.tensor([-0.2, 0.0, torch.inf]), torch.tensor([0.3, 0.0, -torch.inf])
    line = torch.linspace(-4, 4, 801, dtype=torch.float64)
    theta = line[:, None].expand(-1, 3).clone().requires_grad_()
    within = softly_within(theta, low.double(), high.double())
    inside = (line >= low[0]) & (line <= high[0])
    assert torch.equal(within[inside, 0], theta[inside, 0])
    # At most as far again as the range is wide, and .05; what is not known stays.
    assert float(within[-1, 0]) == pytest.approx(0.3 + 0.55, abs=1e-5)
    assert float(within[0, 0]) == pytest.approx(-0.2 - 0.55, abs=1e-5)
    assert float(within[-1, 1]) == pytest.approx(0.05, abs=1e-5)
    assert torch.equal(within[:, 2], theta[:, 2])
    within.sum().backward()
    slope = theta.grad
    assert slope is not None
    assert (slope >= 0).all()
    assert (slope <= 1 + 1e-12).all()
    # No jump where the film ends: just beyond it theta is nearly followed.
    beyond = int((line > high[0]).nonzero()[0])
    assert float(slope[beyond, 0]) > 0.99


def test_weights_of_what_training_never_saw_stay_near_what_it_saw(make_avatar):
    avatar = make_avatar()
    seen = 0.1 * random_theta(avatar.layout, 16)
    before = avatar.weights(seen), avatar.weights(20 * seen)
    avatar.widen_film_range(seen[:8])
    avatar.widen_film_range(seen[8:])
    assert torch.equal(avatar.theta_low, seen.amin(0))
    assert torch.equal(avatar.theta_high, seen.amax(0))
    assert torch.equal(avatar.weights(seen), before[0])
    away, left_to_chance = (
        (psi - before[0].mean(0)).abs().max() for psi in (avatar.weights(20 * seen), before[1])
    )
    assert away < left_to_chance / 3


def test_what_training_saw_is_kept_in_the_file(make_avatar, tmp_path):
    avatar = make_avatar()
    avatar.widen_film_range(random_theta(avatar.layout, 4))
    avatar.save(tmp_path / "me")
    assert torch.equal(Avatar.load(tmp_path / "me").theta_high, avatar.theta_high)
