"""What a head model's expressions do to Gaussians that lie on it, and what they learn to do."""

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from rgbavatar_ns.avatar.methods.carriers import SmoothSurface
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.rotations import axis_angle_to_matrix

_POSED = ("neck", "jaw", "left_eye", "right_eye")
"""Theta's rotations that move pose blendshapes, in the order of `HeadArrays.posedirs`."""
_LINEAR = ("expression", "eyelids")
_WIDTHS = {"position": 3, "rotation_wxyz": 4, "log_scale": 3, "opacity_logit": 1}


class ExpressionBases(nn.Module):
    """Bases of N Gaussians: fixed by the head model, plus a masked residual of each attribute.

    Of P weights (`basis_weights`) each Gaussian has M whose residual it can learn, those that its
    mask lets through; the others' would stay 0. Every tensor has a row for each Gaussian. Residuals
    begin with 0. Source: GaussianBlendshapes (Ma et al. 2024, sec. 3.3; `face_gs_model.py`).

    Args:
        fixed: displacements in metres and changes of the quaternion a unit of weight.
        chosen: which weights.
        mask: what their residuals are multiplied by.
        num_coefficients: how many harmonics of a colour have residuals.
    """

    fixed: Float[Tensor, "N 7 P"]
    chosen: Int[Tensor, "N M"]
    mask: Float[Tensor, "N M"]

    def __init__(
        self,
        fixed: Float[Tensor, "N 7 P"],
        chosen: Int[Tensor, "N M"],
        mask: Float[Tensor, "N M"],
        num_coefficients: int,
    ) -> None:
        super().__init__()
        for name, values in (("fixed", fixed), ("chosen", chosen), ("mask", mask)):
            self.register_buffer(name, values)
        for name, width in (_WIDTHS | {"color": 3 * num_coefficients}).items():
            zeros = fixed.new_zeros(*chosen.shape, width)
            self.register_parameter(name, nn.Parameter(zeros))
        self.register_load_state_dict_post_hook(lambda module, _: module._require_known())

    def _require_known(self) -> None:
        """Raise UserError where what was loaded names weights that there are not."""
        if self.chosen.numel() and not (
            int(self.chosen.min()) >= 0 and int(self.chosen.max()) < self.fixed.shape[2]
        ):
            raise UserError(
                "A Gaussian has a basis of an expression that the head does not have.",
                "Use another copy of the avatar or checkpoint.",
            )

    @classmethod
    def of_head(
        cls,
        head: HeadModel,
        identity: Float[Tensor, "I"],
        faces: Int[Tensor, "F 3"],
        at_points: Callable[[Tensor], Tensor],
        num_bases: int,
        num_coefficients: int,
    ) -> "ExpressionBases":
        """Bases of points on some of a head's triangles; `at_points` gives them vertices' values.

        The first `num_bases` expressions have residuals, or as many as the head has. A residual's
        mask grows linearly with how far its expression moves the point: from 0 at a tenth of what
        the weakest of them moves any vertex by, to 1 at what the strongest does. (The release has
        both as numbers of FLAME's first and 50th expression.)
        """
        deformation = _deformation(head, identity)
        num_bases = min(num_bases, head.arrays.num_expressions)
        distance = deformation[:, :3, :num_bases].norm(dim=1)
        farthest = distance.amax(0)[distance.amax(0) > 0].tolist()
        least, largest = (0.1 * min(farthest), max(farthest)) if farthest else (0.0, 1.0)
        # No point is moved by an expression that moves none of its triangle's corners.
        most = int((distance > least)[faces].any(1).sum(1).max())
        fixed = at_points(deformation)
        distance = fixed[:, :3, :num_bases].norm(dim=1)
        mask = ((distance - least) / (largest - least)).clamp(min=0).topk(most, dim=1)
        return cls(fixed, mask.indices, mask.values, num_coefficients)

    def displaced(
        self, weights: Float[Tensor, "B P"]
    ) -> tuple[Float[Tensor, "B N 3"], Float[Tensor, "B N 4"]]:
        """Displacements in metres, and changes of quaternions, that the head model knows of."""
        moved = torch.matmul(self.fixed.flatten(0, 1), weights.mT)
        position, rotation = moved.unflatten(0, (-1, 7)).movedim(-1, 0).split([3, 4], -1)
        return position, rotation

    def own_weights(self, weights: Float[Tensor, "B P"]) -> Float[Tensor, "N B M"]:
        """Each Gaussian's weights times its mask."""
        return (weights[:, self.chosen] * self.mask).transpose(0, 1)

    def residual(
        self, name: str, own: Float[Tensor, "N B M"], width: int | None = None
    ) -> Float[Tensor, "B N W"]:
        """What was learned of an attribute, or of its first `width` numbers, for `own_weights`."""
        bases = self.get_parameter(name)
        width = bases.shape[2] if width is None else width
        return _Weighted.apply(own, bases, width).transpose(0, 1)


class _Weighted(torch.autograd.Function):
    """own @ bases[..., :width], whose gradient for the bases is written once, as they lie.

    Autograd's own goes through memory three times as often, and for these is most of a step.
    """

    @staticmethod
    def forward(
        ctx: Any, own: Float[Tensor, "N B M"], bases: Float[Tensor, "N M C"], width: int
    ) -> Float[Tensor, "N B W"]:
        ctx.save_for_backward(own, bases)
        return torch.bmm(own, bases[..., :width])

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Tensor
    ) -> tuple[Tensor | None, Tensor | None, None]:
        (own, bases), (gradient,) = ctx.saved_tensors, grad_outputs
        width = gradient.shape[2]
        of_own = of_bases = None
        if ctx.needs_input_grad[0]:
            of_own = torch.bmm(gradient, bases[..., :width].mT)
        if ctx.needs_input_grad[1]:
            of_bases = torch.empty_like(bases)
            of_bases[..., width:] = 0
            if own.shape[1] == 1:
                # A product of two vectors for each Gaussian, which bmm is slow at.
                torch.mul(own.mT, gradient, out=of_bases[..., :width])
            else:
                of_bases[..., :width] = torch.bmm(own.mT, gradient)
        return of_own, of_bases, None


def basis_weights(head: HeadModel, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B P"]:
    """Expressions, eyelids, and of a head with pose blendshapes the 36 numbers of R - I."""
    parts = head.layout.split(theta)
    pieces = [parts[name] for name in _LINEAR if name in parts]
    if head.arrays.posedirs.any():
        turns = axis_angle_to_matrix(torch.stack([parts[name] for name in _POSED], 1))
        pieces.append((turns - torch.eye(3).to(turns)).flatten(1))
    return torch.cat(pieces, 1)


@torch.no_grad()
def _deformation(head: HeadModel, identity: Float[Tensor, "I"]) -> Float[Tensor, "V 7 P"]:
    """What a unit of each weight does to vertices: displacements, and changes of quaternions.

    Only expressions turn, as in the release.
    """
    layout = head.layout
    rest = head(identity.new_zeros(layout.size), identity)
    linear = [layout.slice(name) for name in _LINEAR if name in layout.names]
    posed = head(torch.cat([torch.eye(layout.size)[part] for part in linear]).to(rest), identity)
    expressions = head.arrays.num_expressions
    turned = rest.new_zeros(len(posed), len(rest), 4)
    if expressions:
        quats = SmoothSurface(rest, head.faces).vertex_quats_wxyz(posed[:expressions])
        # Of both quaternions of a turn the one near that of none.
        turned[:expressions] = torch.where(quats[..., :1] < 0, -quats, quats)
        turned[:expressions, :, 0] -= 1
    found = torch.cat([posed - rest, turned], -1).permute(1, 2, 0)
    if head.arrays.posedirs.any():
        pose = torch.from_numpy(head.arrays.posedirs.copy()).to(rest)
        found = torch.cat([found, F.pad(pose, (0, 0, 0, 4))], 2)
    return found
