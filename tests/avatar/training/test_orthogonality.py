import pytest
import torch

from rgbavatar_ns.avatar.model.blendshapes import TangentBlendshapes
from rgbavatar_ns.avatar.training.orthogonality import (
    orthogonality_error,
    orthogonality_loss,
    orthogonalize,
)


def _shapes(num_bases: int = 4, num_gaussians: int = 30) -> TangentBlendshapes:
    shapes = TangentBlendshapes(num_gaussians, num_bases).double()
    generator = torch.Generator().manual_seed(3)
    for name, parameter in shapes.named_parameters():
        if name.startswith("basis"):
            parameter.data = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
    return shapes


def _vectors(shapes: TangentBlendshapes) -> torch.Tensor:
    return torch.cat(
        [p.flatten(1) for n, p in shapes.named_parameters() if n.startswith("basis")], 1
    )


def test_the_error_by_hand():
    shapes = TangentBlendshapes(1, 2)
    with torch.no_grad():
        shapes.basis_position[0, 0] = torch.tensor([3.0, 0.0, 0.0])
        shapes.basis_position[1, 0] = torch.tensor([0.6, 0.8, 0.0])
    # Unit rows (1, 0), (.6, .8): V V^T - I = [[0, .6], [.6, 0]].
    assert orthogonality_error(shapes).item() == pytest.approx(0.6)
    assert orthogonality_loss(shapes).item() == pytest.approx(0.72)


@pytest.mark.parametrize("method", ["qr", "gram_schmidt"])
def test_orthogonal_bases_keep_lengths_span_and_the_first_direction(method):
    shapes = _shapes()
    before = _vectors(shapes).detach().clone()
    assert orthogonality_error(shapes) > 0.05
    orthogonalize(shapes, method)
    after = _vectors(shapes).detach()
    assert orthogonality_error(shapes) < 1e-12
    torch.testing.assert_close(after.norm(dim=1), before.norm(dim=1))
    torch.testing.assert_close(after[0], before[0])
    assert torch.linalg.matrix_rank(torch.cat([before, after]), atol=1e-9) == 4
    assert ((before * after).sum(1) > 0).all()


def test_both_methods_agree_and_leave_empty_bases_alone():
    one, other = _shapes(), _shapes()
    for shapes in (one, other):
        shapes.basis_position.data[2] = 0
        shapes.basis_rotation_wxyz.data[2] = 0
        shapes.basis_color_feature.data[2] = 0
    orthogonalize(one, "qr")
    orthogonalize(other, "gram_schmidt")
    torch.testing.assert_close(_vectors(one), _vectors(other))
    assert not _vectors(one)[2].any()


def test_descending_the_loss_makes_bases_orthogonal():
    shapes = _shapes()
    bases = [p for n, p in shapes.named_parameters() if n.startswith("basis")]
    optimizer = torch.optim.Adam(bases, lr=0.02)
    start = orthogonality_error(shapes).item()
    for _ in range(100):
        optimizer.zero_grad()
        orthogonality_loss(shapes).backward()
        optimizer.step()
    assert orthogonality_error(shapes).item() < 0.1 * start


def test_untrained_bases_and_none_give_finite_values():
    fresh = TangentBlendshapes(5, 3)
    orthogonality_loss(fresh).backward()
    assert fresh.basis_position.grad is not None
    assert torch.isfinite(fresh.basis_position.grad).all()
    assert orthogonality_error(TangentBlendshapes(5, 0)).item() == 0
