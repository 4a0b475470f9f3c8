import math

import pytest
import torch

from rgbavatar_ns.avatar.methods import fields
from rgbavatar_ns.avatar.methods.fields import (
    MLP,
    multiplied_in,
    positional_encoding,
    sharp_softplus,
)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*shape, generator=seeded(seed), dtype=torch.float64)


def test_encoding_by_hand() -> None:
    code = positional_encoding(torch.tensor([[math.pi / 2, 0.0]]), 2)
    wanted = [math.pi / 2, 0, 1, 0, 0, 1, 0, 0, -1, 1]
    torch.testing.assert_close(code, torch.tensor([wanted]), atol=1e-6, rtol=0)
    # FlashAvatar's: 8 octaves of three numbers.
    assert positional_encoding(torch.zeros(4, 5, 3), 8).shape == (4, 5, 51)


@pytest.mark.parametrize("activation", ["relu", "softplus"])
@pytest.mark.parametrize("skip_at", [None, 2])
def test_parts_give_what_their_concatenation_does(skip_at, activation) -> None:
    network = MLP(
        (3, 4), 8, 3, 2, generator=seeded(), skip_at=skip_at, activation=activation
    ).double()
    places, thetas = normal(1, 5, 3), normal(2, 1, 4, seed=2)
    joined = torch.cat([places.expand(2, 5, 3), thetas.expand(2, 5, 4)], -1)
    act = torch.nn.ReLU() if activation == "relu" else torch.nn.Softplus(beta=100)
    values = joined
    for index, layer in enumerate(network.hidden):
        values = torch.cat([values, joined], -1) if index == skip_at else values
        values = act(layer(values))
    torch.testing.assert_close(network(places, thetas), network.output(values))


def test_sharp_softplus_is_softplus_without_its_tail() -> None:
    x = torch.linspace(-2, 2, 4001, dtype=torch.float64).requires_grad_()
    found, wanted = sharp_softplus(x), torch.nn.functional.softplus(x, beta=100)
    torch.testing.assert_close(found, wanted, atol=1e-10, rtol=0)
    slopes = [torch.autograd.grad(values.sum(), x)[0] for values in (found, wanted)]
    torch.testing.assert_close(*slopes, atol=1e-8, rtol=0)
    assert not slopes[0][x < -0.2].any()
    assert float(found.detach().min()) > 1e-12


def test_gradients_agree_with_differences() -> None:
    network = MLP((3, 2), 6, 3, 2, generator=seeded(), skip_at=1, activation="softplus").double()
    places, thetas = normal(1, 4, 3).requires_grad_(), normal(2, 1, 2, seed=2).requires_grad_()
    weights = tuple(network.parameters())

    def values(places, thetas, *_):
        return network(positional_encoding(places, 0), thetas)

    assert torch.autograd.gradcheck(values, (places, thetas, *weights), fast_mode=True)
    encoded = lambda x: positional_encoding(x, 3)  # noqa: E731
    assert torch.autograd.gradcheck(encoded, (places,))


def test_the_seed_alone_decides_and_no_global_randomness_moves() -> None:
    torch.manual_seed(3)
    before = torch.get_rng_state()
    first, same, other = (MLP((3,), 8, 2, 4, generator=seeded(s)) for s in (5, 5, 6))
    assert torch.equal(before, torch.get_rng_state())
    x = torch.ones(2, 3)
    assert torch.equal(first(x), same(x))
    assert not torch.equal(first(x), other(x))


def test_a_field_may_begin_at_nothing_and_still_learn() -> None:
    network = MLP((3,), 8, 2, 4, generator=seeded(), last_scale=0.0)
    values = network(torch.ones(2, 3))
    assert not values.any()
    values.sum().backward()
    assert network.output.weight.grad is not None
    assert network.output.weight.grad.any()


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="skip_at is 2 of 2"):
        MLP((3,), 8, 2, 4, generator=seeded(), skip_at=2)
    with pytest.raises(ValueError, match=r"\(4,\) wide"):
        MLP((3,), 8, 2, 4, generator=seeded())(torch.zeros(2, 4))


@pytest.mark.parametrize("alive", [0.0, 0.3, 1.0])
def test_rows_without_a_gradient_are_left_out_of_it_exactly(alive):
    generator = torch.Generator().manual_seed(0)
    field = MLP([3, 2], 7, 3, 4, generator=generator).double()
    place = torch.randn(1, 1500, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    theta = torch.randn(2, 1, 2, generator=generator, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(2, 1500, 4, generator=generator, dtype=torch.float64)
    weight *= torch.rand(2, 1500, 1, generator=generator, dtype=torch.float64) < alive
    inputs = [place, theta, *field.parameters()]
    found = torch.autograd.grad((field(place, theta) * weight).sum(), inputs)
    values = torch.cat([place.expand(2, -1, -1), theta.expand(-1, 1500, -1)], -1)
    for layer in field.hidden:
        values = torch.relu(values @ layer.weight.mT + layer.bias)
    values = values @ field.output.weight.mT + field.output.bias
    torch.testing.assert_close(field(place, theta), values)
    for own, expected in zip(found, torch.autograd.grad((values * weight).sum(), inputs)):
        torch.testing.assert_close(own, expected)


@pytest.mark.parametrize("activation", ["relu", "softplus"])
def test_half_as_long_numbers_give_nearly_the_same_values_and_gradients(activation):
    made = [
        MLP([3, 2], 32, 3, 4, generator=seeded(), activation=activation, precision=precision)
        for precision in ("float32", "bfloat16")
    ]
    place, theta = normal(1, 1500, 3).float(), normal(2, 1, 2, seed=2).float()
    weight = normal(2, 1500, 4, seed=3).float().abs()
    found = []
    for network in made:
        inputs = [place.clone().requires_grad_(), theta.clone().requires_grad_()]
        values = network(*inputs)
        wanted = [*inputs, *network.parameters()]
        found.append([values, *torch.autograd.grad((values * weight).sum(), wanted)])
    # Where a unit is just on or just off, the gradient of a single place leaps.
    allowed = [0.01, 0.1, *[0.02] * (len(found[0]) - 2)]
    off = [float((b - a).detach().norm() / a.detach().norm()) for a, b in zip(*found)]
    assert all(share < most for share, most in zip(off, allowed))
    assert off[0] > 1e-5, "and are not the same"
    assert all(narrow.dtype == torch.float32 for narrow in found[1])


def test_an_output_that_is_narrower_than_its_layers_is_not_rounded():
    for outputs in (4, 32):
        network = MLP([3], 32, 2, outputs, generator=seeded(), precision="bfloat16")
        values = network(normal(500, 3).float()).detach()
        rounded = (values == values.bfloat16().float()).float().mean()
        assert (float(rounded) > 0.99) == (outputs == 32)


def test_the_precision_follows_the_processor_unless_it_is_asked_for(monkeypatch):
    single, double = torch.zeros(1), torch.zeros(1, dtype=torch.float64)
    for known in (True, False):
        monkeypatch.setattr(fields, "_has_bfloat16", lambda known=known: known)
        assert multiplied_in("auto", single) == (torch.bfloat16 if known else torch.float32)
        assert multiplied_in("bfloat16", single) == torch.bfloat16
        assert multiplied_in("float32", single) == torch.float32
        assert multiplied_in("auto", double) == multiplied_in("bfloat16", double) == torch.float64
    on_a_gpu = torch.zeros(1, device="meta")
    monkeypatch.setattr(fields, "_has_bfloat16", lambda: True)
    assert multiplied_in("auto", on_a_gpu) == torch.float32


@pytest.mark.parametrize("alive", [0, 1, 128, 129, 950, 1000])
def test_a_gradients_rows_are_few_different_numbers_and_none_is_missing(alive):
    gradient = torch.zeros(1000, 3)
    chosen = torch.randperm(1000, generator=seeded())[:alive]
    gradient[chosen, 1] = 1.0
    rows = fields._rows_of(gradient)
    assert len(rows.unique()) == len(rows)
    assert set(chosen.tolist()) <= set(rows.tolist())
    # A multiple of 128, or all there are.
    assert len(rows) == min(-(-alive // 128) * 128, 1000)
