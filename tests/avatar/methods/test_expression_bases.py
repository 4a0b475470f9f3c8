import pytest
import torch

from rgbavatar_ns.avatar.methods.expression_bases import ExpressionBases

COUNT, LEARNED, COEFFICIENTS = 7, 5, 4


def made() -> ExpressionBases:
    generator = torch.Generator().manual_seed(0)
    fixed = torch.randn(COUNT, 7, 6, generator=generator, dtype=torch.float64)
    chosen = torch.randint(6, (COUNT, LEARNED), generator=generator)
    mask = torch.rand(COUNT, LEARNED, generator=generator, dtype=torch.float64)
    bases = ExpressionBases(fixed, chosen, mask, COEFFICIENTS)
    with torch.no_grad():
        bases.get_parameter("color").normal_(generator=generator)
    return bases


@pytest.mark.parametrize("images", [1, 3])
@pytest.mark.parametrize("width", [None, 3, 12])
def test_a_residual_and_its_gradients_are_those_of_autograd(images, width):
    bases = made()
    learned = bases.get_parameter("color")
    weights = torch.rand(images, 6, dtype=torch.float64).requires_grad_()
    shown = learned[..., :width]
    expected = torch.einsum("nbm,nmw->bnw", bases.own_weights(weights), shown)
    found = bases.residual("color", bases.own_weights(weights), width)
    torch.testing.assert_close(found, expected)
    factors = torch.randn(expected.shape, dtype=torch.float64)
    own, wanted = (
        torch.autograd.grad((values * factors).sum(), [weights, learned])
        for values in (found, expected)
    )
    for one, other in zip(own, wanted):
        torch.testing.assert_close(one, other)
    # What is not shown has no gradient, rather than none yet.
    assert not own[1][..., shown.shape[2] :].any()


def test_weights_that_nobody_learns_ask_for_no_gradient():
    bases = made()
    own = bases.own_weights(torch.rand(1, 6, dtype=torch.float64))
    bases.residual("color", own).sum().backward()
    assert bases.get_parameter("color").grad is not None
    assert own.grad is None
