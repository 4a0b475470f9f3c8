"""Base Gaussians and K Gaussian blendshapes in tangent space, blended before activation."""

import math
from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

_Array = TypeVar("_Array", Tensor, np.ndarray, float)

COLOR_SCALE = 0.28209479177387814
"""The constant of the zeroth spherical harmonic: colour = .5 + COLOR_SCALE * feature."""


@dataclass(frozen=True)
class TangentGaussians:
    """Morphed, not yet activated attributes in each Gaussian's tangent frame.

    `position` is in the frame's units (metres where its columns have unit length);
    `rotation_wxyz` is not normalised. `log_scale` and `opacity_logit` are shared by the batch.
    """

    position: Float[Tensor, "B N 3"]
    rotation_wxyz: Float[Tensor, "B N 4"]
    color_feature: Float[Tensor, "B N 3"]
    log_scale: Float[Tensor, "N 3"]
    opacity_logit: Float[Tensor, "N"]


def color_from_feature(feature: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Activate colour features: colour = .5 + .282 f, not clamped (as GaussianBlendshapes)."""
    half = torch.full((), 0.5, dtype=feature.dtype, device=feature.device)
    return torch.add(half, feature, alpha=COLOR_SCALE)


def feature_from_color(color: _Array) -> _Array:
    """Invert `color_from_feature`: [*n, 3] or one number."""
    return cast(_Array, (color - 0.5) / COLOR_SCALE)


class TangentBlendshapes(nn.Module):
    """A base model G_0 of N Gaussians and K residuals dG_k of position, rotation and colour.

    Initial values: position 0, identity rotation, grey, residuals 0 (paper, sec. 3.2).
    `scale_m` is one length or N of them. Opacity and scale have no residuals (supplement).
    """

    def __init__(
        self,
        num_gaussians: int,
        num_bases: int,
        *,
        scale_m: float | Float[Tensor, "N"] = 8e-4,
        opacity: float = 0.5,
        color: float = 0.5,
    ) -> None:
        super().__init__()
        n, k = num_gaussians, num_bases
        self.num_gaussians, self.num_bases = n, k
        log_scale = torch.as_tensor(scale_m, dtype=torch.float32).log().reshape(-1, 1)
        rotation_wxyz = torch.zeros(n, 4)
        rotation_wxyz[:, 0] = 1
        self.position = nn.Parameter(torch.zeros(n, 3))
        self.rotation_wxyz = nn.Parameter(rotation_wxyz)
        self.log_scale = nn.Parameter(log_scale.expand(n, 3).clone())
        self.opacity_logit = nn.Parameter(torch.full((n,), math.log(opacity / (1 - opacity))))
        self.color_feature = nn.Parameter(torch.full((n, 3), (color - 0.5) / COLOR_SCALE))
        if k > 0:
            self.basis_position = nn.Parameter(torch.zeros(k, n, 3))
            self.basis_rotation_wxyz = nn.Parameter(torch.zeros(k, n, 4))
            self.basis_color_feature = nn.Parameter(torch.zeros(k, n, 3))

    def morph(self, psi: Float[Tensor, "B K"]) -> TangentGaussians:
        """Return base plus weighted residuals, before activation. RGBAvatar eq. 1."""
        blended = {}
        for name in ("position", "rotation_wxyz", "color_feature"):
            base = getattr(self, name)
            if self.num_bases == 0:
                blended[name] = base.expand(len(psi), -1, -1)
                continue
            bases = getattr(self, f"basis_{name}")
            # One matrix product over [K, N * c] runs at the memory's speed.
            flat = torch.addmm(base.flatten(), psi, bases.flatten(1))
            blended[name] = flat.unflatten(1, base.shape)
        return TangentGaussians(
            log_scale=self.log_scale, opacity_logit=self.opacity_logit, **blended
        )
