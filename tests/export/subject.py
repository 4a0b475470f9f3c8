"""A small avatar on the embedded head, every Gaussian moved, for tests of what leaves it."""

from typing import Any

import numpy as np
import torch

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.head import HeadArrays, HeadModel
from tests.avatar.small_head import randomize


def avatar_of(seed: int = 0, arrays: HeadArrays | None = None, **changes) -> Avatar:
    """An avatar on the embedded head or another one.

    Colours vary smoothly over the head, bases and network are random but of lifelike size.
    """
    settings = {"num_bases": 4, "uv_resolution": 32, "scale_from_texel_spacing": True} | changes
    head = HeadModel.embedded() if arrays is None else HeadModel(arrays)
    generator = torch.Generator().manual_seed(seed)
    identity = 0.5 * torch.randn(head.num_identity, generator=generator)
    avatar = Avatar(head, identity, AvatarConfig(**settings), seed=seed)
    randomize(avatar, seed)
    with torch.no_grad():
        place = avatar.anchors.origins(head(torch.zeros(1, head.layout.size), identity))[0]
        avatar.blendshapes.color_feature.copy_(torch.sin(40 * place))
        avatar.blendshapes.opacity_logit.fill_(2.0)
    return avatar


def lively_theta(avatar: Avatar, count: int, seed: int = 0) -> torch.Tensor:
    """Expressions in [0, 1], turns of some ten degrees, shifts of centimetres."""
    generator = torch.Generator().manual_seed(seed)
    parts = {}
    for field in avatar.layout.fields:
        drawn = torch.rand(count, field.size, generator=generator)
        scale = {"linear": 0.6, "axis_angle": 0.3, "translation": 0.02}[field.form]
        parts[field.name] = scale * (drawn if field.form == "linear" else drawn - 0.5)
    return avatar.layout.join(parts)


def camera_path(poses: torch.Tensor, **changes: Any) -> dict[str, Any]:
    """nerfstudio's export of a path of cameras [C, 4, 4], 64 x 48 pixels."""
    frames = [{"camera_to_world": p.flatten().tolist(), "fov": 40.0, "aspect": 1} for p in poses]
    described = {"camera_type": "perspective", "render_height": 48, "render_width": 64}
    return described | {"camera_path": frames, "fps": 24, "seconds": 2.0} | changes


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """Of two pictures in [0, 1]."""
    return float(-10 * np.log10(np.mean((first - second) ** 2) + 1e-12))
