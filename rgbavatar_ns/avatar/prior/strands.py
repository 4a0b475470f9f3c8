"""Hair where nobody filmed it: strands, the stronger the film's are, in the colour of hair."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.model.blendshapes import color_from_feature, feature_from_color
from rgbavatar_ns.avatar.prior.mesh_field import MeshField, ramp
from rgbavatar_ns.avatar.prior.nape import Nape

_EARS_ASIDE_M = 0.05
"""Ears, and what lies behind them, are farther than so from the middle."""
_STRAND_M, _LOCK_M = 3e-3, 9e-3
"""How far apart strands of hair lie, and locks."""
_DISCS = 1.5
"""Distances between texels that a strand is wide at least: discs show nothing finer."""
_LONG = 5
"""How many times longer than apart both look."""
_LOCKS = 0.4
"""Contrast of locks beside that of strands."""
_MOST = 2.0
"""No strand stands out by more deviations than so."""
_DRAWN = 0.8
"""The film's contrast over that of discs. Pictures keep less of it, .4, since discs overlap; but
their strands are wider than the film's, and look stronger."""
_WAVES_RAD, _WAVE_M = 0.5, 0.03
"""How far strands turn aside, and over how long a way."""
_SAMPLES = 9
_CROWN = (0.0, 0.08, -0.06)
"""From the middle of what may have hair to where it begins to part, in metres: up, and behind."""
_ROOM_M = 0.4
"""Side of a cube of noise, which goes on mirrored."""
_GRAZING = 0.1
"""What a pixel seen aside tells of hair's colour beside one seen in front: it shows several
strands at once."""
_TELLS_FROM, _TELLS_AT = 0.25, 0.5
"""Shares of a vertex behind an ear that are seen clearly, below which it tells no colour, and from
which it does: what shines there is the ear's skin."""


@dataclass(frozen=True)
class Strands:
    """The strands of hair of N Gaussians. Ours, because plain backs of heads look like caps."""

    haired: Float[Tensor, "N"]
    """1 where hair may be."""
    pattern: Float[Tensor, "N"]
    """How much lighter or darker each is than hair on average, for a contrast of 1: at most 3."""
    beside_ears: Bool[Tensor, "V"]
    """Vertices of the scalp where ears are before it, seen from in front."""
    nape: Nape

    @classmethod
    def of(cls, avatar: Avatar, field: MeshField) -> "Strands":
        """Noise drawn out along hair that falls from the crown, the same for everybody.

        A line integral convolution (Cabral and Leedom 1993).
        """
        aside = field.rest_m[:, 0].abs() > _EARS_ASIDE_M
        beside_ears = field.scalp & ~field.above_ears & aside
        haired = field.at_gaussians(field.haired.to(field.rest_m)[:, None])[:, 0]
        if not bool(field.haired.any()):
            plain = torch.zeros_like(haired)
            return cls(haired, plain, beside_ears, Nape.of(field, plain))
        normals = F.normalize(field.at_gaussians(field.normals), dim=-1)
        places_m = field.at_gaussians(field.rest_m - field.rest_m[field.haired].mean(0))
        falls = places_m - places_m.new_tensor(_CROWN)
        along = F.normalize(falls - (falls * normals).sum(-1, keepdim=True) * normals, dim=-1)
        turn_rad = _WAVES_RAD * _noise(places_m, _WAVE_M, 0)[:, None]
        across = torch.linalg.cross(normals, along)
        along = along * turn_rad.cos() + across * turn_rad.sin()
        spacing_m = avatar.anchors.texel_spacing()[haired > 0.5]
        finest_m = _DISCS * float(spacing_m.median()) if len(spacing_m) else 0.0
        pattern = torch.zeros_like(haired)
        for seed, (apart_m, contrast) in enumerate(((_STRAND_M, 1.0), (_LOCK_M, _LOCKS)), 1):
            apart_m = max(apart_m, finest_m)
            reach_m = 0.5 * _LONG * apart_m
            drawn = torch.zeros_like(haired)
            for step_m in torch.linspace(-reach_m, reach_m, _SAMPLES).tolist():
                drawn += _noise(places_m + step_m * along, apart_m, seed)
            pattern += contrast * _standardized(drawn, haired)
        pattern = _MOST * (_standardized(pattern, haired) / _MOST).tanh()
        nape = Nape.of(field, _standardized(pattern, haired))
        haired = torch.lerp(haired, nape.hair, nape.near)
        return cls(haired, haired * _standardized(pattern, haired) / _DRAWN, beside_ears, nape)

    def known(self, confidence: Float[Tensor, "V"], most: Float[Tensor, "V"]) -> Float[Tensor, "V"]:
        """How much of vertices' colours is known, without skin that shines beside ears; `most` is
        their confidence where all is seen."""
        tells = ramp(confidence / most.clamp(min=1e-12), _TELLS_FROM, _TELLS_AT)
        return torch.where(self.beside_ears, tells * confidence, confidence)

    def drawn(
        self, feature: Float[Tensor, "N 3"], contrast: Float[Tensor, ""]
    ) -> Float[Tensor, "N 3"]:
        """Colour features with strands of this contrast, a share of their light."""
        lighter = 1 + contrast * self.pattern[:, None]
        return feature_from_color(lighter * color_from_feature(feature))

    def colored_px(
        self,
        seen_px: Float[Tensor, "N"],
        clear_px: Float[Tensor, "N"],
        grazing_px: Float[Tensor, "N"],
    ) -> Float[Tensor, "N"]:
        """Pixels that tell of each one's colour."""
        return seen_px.lerp(clear_px + _GRAZING * grazing_px, self.haired)


def _standardized(values: Float[Tensor, "N"], weight: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """With a weighted mean of 0 and a deviation of 1."""
    share = weight / weight.sum().clamp(min=1e-6)
    centred = values - (values * share).sum()
    return centred / (centred.square() * share).sum().sqrt().clamp(min=1e-6)


def _noise(places_m: Float[Tensor, "N 3"], cell_m: float, seed: int) -> Float[Tensor, "N"]:
    """Smooth noise in space, from -1 to 1, whose cells are so large."""
    size = math.ceil(_ROOM_M / cell_m)
    generator = torch.Generator().manual_seed(seed)
    cells = 2 * torch.rand(1, 1, size, size, size, generator=generator) - 1
    at = (places_m / (0.5 * size * cell_m)).cpu().float().view(1, 1, 1, -1, 3)
    found = F.grid_sample(cells, at, padding_mode="reflection", align_corners=False)
    return found.view(-1).to(places_m)
