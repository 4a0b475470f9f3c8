"""How orthogonal the learned bases are, and ways to keep them so (paper, supplement).

The paper finds that orthogonal bases serve no purpose; these are here to show it again.
"""

from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.model.blendshapes import TangentBlendshapes
from rgbavatar_ns.kernels import BASIS_ATTRIBUTES

ORTHOGONALITY_WEIGHT, ORTHOGONALIZE_EVERY = 10.0, 1000
"""Of the loss, and how many steps lie between two orthogonalizations."""


def orthogonality_error(shapes: TangentBlendshapes) -> Float[Tensor, ""]:
    """Return ||V V^T - I||_2 (spectral), rows of V the K bases at unit length; 0 if K = 0."""
    if shapes.num_bases == 0:
        return shapes.position.new_zeros(())
    return torch.linalg.matrix_norm(_gram_error(shapes), ord=2)


def orthogonality_loss(shapes: TangentBlendshapes) -> Float[Tensor, ""]:
    """Return the squared Frobenius norm of V V^T - I, smooth where e_orth is not (ours)."""
    return _gram_error(shapes).square().sum()


@torch.no_grad()
def orthogonalize(shapes: TangentBlendshapes, method: Literal["qr", "gram_schmidt"]) -> None:
    """Replace the K bases by orthogonal ones of the same lengths, in place; bases of 0 stay 0."""
    bases = _rows(shapes)
    length = bases.norm(dim=1, keepdim=True)
    used = length[:, 0] > 0
    rows = bases[used] / length[used]
    if method == "qr":
        factor, upper = torch.linalg.qr(rows.T)
        signs = torch.where(upper.diagonal() < 0, -1.0, 1.0)
        rows = (factor * signs).T
    else:
        for k in range(len(rows)):
            rows[k] -= rows[:k].T @ (rows[:k] @ rows[k])
            rows[k] = F.normalize(rows[k], dim=0)
    bases[used] = rows * length[used]
    start = 0
    for name in BASIS_ATTRIBUTES:
        parameter = getattr(shapes, name)
        size = parameter[0].numel()
        parameter.copy_(bases[:, start : start + size].view_as(parameter))
        start += size


def _gram_error(shapes: TangentBlendshapes) -> Float[Tensor, "K K"]:
    unit = F.normalize(_rows(shapes), dim=1)
    return unit @ unit.T - torch.eye(len(unit), dtype=unit.dtype, device=unit.device)


def _rows(shapes: TangentBlendshapes) -> Float[Tensor, "K d"]:
    return torch.cat([getattr(shapes, name).flatten(1) for name in BASIS_ATTRIBUTES], dim=1)
