"""The compiled loops for harmonics beside their readable path in float64."""

import inspect

import pytest
import torch

from rgbavatar_ns.avatar.methods.sh import sh_colors
from rgbavatar_ns.kernels import harmonic_colors
from rgbavatar_ns.threads import using_threads


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("sets", [1, 3])
def test_colours_and_gradients_are_those_in_double_precision(degree: int, sets: int) -> None:
    # More Gaussians than a thread takes at once; a third of the colours would be below 0.
    coefficients = normal(sets, 600, 16, 3)
    directions = torch.nn.functional.normalize(normal(3, 600, 3, seed=1), dim=-1)
    weights = normal(3, 600, 3, seed=2)
    exact = [x.clone().requires_grad_() for x in (coefficients, directions)]
    single = [x.float().requires_grad_() for x in (coefficients, directions)]
    found = []
    for pair in (exact, single):
        colors = sh_colors(*pair, degree)
        gradients = torch.autograd.grad((colors * weights.to(colors)).sum(), pair)
        found.append((colors.detach(), *gradients))
    assert 0.1 < float((found[0][0] == 0).double().mean()) < 0.5
    for wanted, own in zip(*found):
        torch.testing.assert_close(own.double(), wanted, atol=2e-5, rtol=1e-5)


def test_they_are_the_same_over_threads_and_in_another_order_of_memory() -> None:
    coefficients = normal(2000, 16, 3).float().requires_grad_()
    directions = torch.nn.functional.normalize(normal(3, 2, 2000, seed=1).float(), dim=0)
    found = []
    for threads in (1, 2, 5):
        with using_threads(threads):
            colors = sh_colors(coefficients, directions.movedim(0, -1), 3)
            found.append((colors, *torch.autograd.grad(colors.square().sum(), coefficients)))
    for others in found[1:]:
        assert all(torch.equal(*pair) for pair in zip(others, found[0]))


@pytest.mark.parametrize(
    "shapes",
    [
        ((1, 5, 7, 3), (2, 5, 3)),
        ((1, 5, 9, 3), (2, 6, 3)),
        ((2, 5, 9, 3), (3, 5, 3)),
        ((1, 5, 9, 2), (2, 5, 3)),
        ((1, 5, 9, 3), (2, 5, 2)),
        ((1, 5, 9, 3), (5, 3)),
    ],
)
def test_what_does_not_fit_is_refused_before_loops_read_it(shapes) -> None:
    # As users have it, without the tests' checks of shapes.
    unchecked = inspect.unwrap(harmonic_colors)
    with pytest.raises(ValueError, match="one of 4, 9 and 16"):
        unchecked(*(torch.zeros(*shape) for shape in shapes))


def test_a_backend_without_loops_says_so() -> None:
    given = torch.zeros(1, 5, 9, 3), torch.zeros(2, 5, 3)
    assert harmonic_colors(*given, backend="reference") is None
