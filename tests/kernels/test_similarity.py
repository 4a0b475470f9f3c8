"""The compiled loops for DSSIM beside its readable path in float64."""

import inspect

import pytest
import torch

from rgbavatar_ns.avatar.methods.loss_terms import dssim_loss
from rgbavatar_ns.kernels import mean_similarity
from rgbavatar_ns.threads import using_threads

WINDOW = torch.full((11,), 1 / 11)


def picture(*shape: int, seed: int = 0, dtype=torch.float32) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("size", [(70, 33), (11, 12), (12, 11), (43, 48)])
@pytest.mark.parametrize("noise", [0.02, 0.9])
def test_value_and_gradients_are_those_in_double_precision(
    size: tuple[int, int], noise: float
) -> None:
    target = picture(2, *size, 3, dtype=torch.float64)
    image = (target + noise * picture(2, *size, 3, seed=1, dtype=torch.float64)).clamp(max=1)
    exact = [x.clone().requires_grad_() for x in (image, target)]
    single = [x.float().requires_grad_() for x in (image, target)]
    wanted, found = dssim_loss(*exact), dssim_loss(*single)
    assert found.item() == pytest.approx(wanted.item(), abs=1e-5)
    slopes = (torch.autograd.grad(loss, pair) for loss, pair in ((wanted, exact), (found, single)))
    for slope, own in zip(*slopes):
        assert (own - slope).abs().max() < 1e-4 * slope.abs().max()


def test_it_is_the_same_over_threads_and_of_pictures_in_another_order_of_memory() -> None:
    image = picture(2, 90, 40, 3).requires_grad_()
    target = picture(2, 3, 90, 40, seed=1).movedim(1, -1)
    found = []
    for threads, second in ((1, target), (2, target), (5, target.contiguous())):
        with using_threads(threads):
            loss = dssim_loss(image, second)
            found.append((loss, *torch.autograd.grad(loss, image)))
    for loss, gradient in found[1:]:
        assert torch.equal(loss, found[0][0])
        assert torch.equal(gradient, found[0][1])


@pytest.mark.parametrize(
    "shapes",
    [
        ((1, 10, 20, 3), (1, 10, 20, 3)),
        ((1, 12, 12, 3), (2, 12, 12, 3)),
        ((1, 12, 12, 4), (1, 12, 12, 4)),
    ],
)
def test_pictures_that_do_not_fit_are_refused_before_loops_read_them(shapes) -> None:
    image, target = (torch.zeros(*shape) for shape in shapes)
    # As users have it, without the tests' checks of shapes.
    unchecked = inspect.unwrap(mean_similarity)
    with pytest.raises(ValueError, match="11 x 11 pixels or more"):
        unchecked(image, target, WINDOW, (1e-4, 9e-4))
    with pytest.raises(ValueError, match="window"):
        unchecked(*torch.zeros(2, 1, 12, 12, 3), WINDOW[:10], (1e-4, 9e-4))


def test_a_backend_without_loops_says_so_and_an_unknown_one_is_refused() -> None:
    image = torch.zeros(1, 12, 12, 3)
    assert mean_similarity(image, image, WINDOW, (1e-4, 9e-4), backend="reference") is None
    with pytest.raises(ValueError, match="no backend"):
        mean_similarity(image, image, WINDOW, (1e-4, 9e-4), backend="nowhere")
