"""What a web page is told of an avatar beside its arrays: layout, ranges, camera, film, ARKit."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.stored_array import exact
from rgbavatar_ns.export.web_arrays import Arrays
from rgbavatar_ns.head.arkit import ARKIT_NAMES, ArkitMap
from rgbavatar_ns.kernels import PinholeCameras

_LINEAR_RANGE = (-3.0, 3.0)
_NAMED_RANGE = (0.0, 1.0)
_NONE_BELOW = -0.05
"""Below it a tracker's noise does not bring what only rises from rest."""


def calm_theta(seen: TrainingStatistics | None, posed: Float[Tensor, "H"]) -> Float[Tensor, "H"]:
    """The film's calmest expression in the pose of another frame; that frame's where none is known.

    Zeros are no calm face: what a person's tracked head has at rest is seldom zero.
    """
    return posed if seen is None else torch.where(seen.expressive, seen.theta_neutral, posed)


def driving_arrays(avatar: Avatar, neutral: Float[Tensor, "H"] | None) -> Arrays:
    """The face at rest; what ARKit's coefficients do, if that is known."""
    calm = torch.zeros(avatar.layout.size) if neutral is None else neutral
    arrays = {"neutral_theta": exact(calm.detach().cpu().numpy(), "float32")}
    known = _arkit(avatar)
    if known is not None:
        arrays["arkit_theta"] = exact(known.theta_per_unit, "float32")
    return arrays


def _arkit(avatar: Avatar) -> ArkitMap | None:
    """None of a head on which no face is found; all else works without."""
    try:
        return avatar.arkit
    except UserError:
        return None


@torch.no_grad()
def avatar_manifest(
    avatar: Avatar,
    camera: PinholeCameras,
    theta: Float[Tensor, "F H"],
    seen: TrainingStatistics | None,
    frames_per_second: float,
    background: tuple[float, float, float],
) -> dict[str, Any]:
    """All that is no array; see `write_web_page` for what is given."""
    config, layout = avatar.config, avatar.layout
    rest = theta.new_zeros(1, layout.size)
    shown = torch.cat([rest, theta]).to(avatar.identity)
    expression = shown[:, layout.slice("expression")]
    names = avatar.head.arrays.expression_names
    # Blend shapes named after what they do run from 0 to 1; numbered components, and what goes
    # below zero in the film, as a neck does, to both sides.
    numbered = torch.tensor([name[-1:].isdigit() for name in names]).to(expression.device)
    both = numbered | (expression < _NONE_BELOW).any(0)
    low, high = (torch.where(both, *ends) for ends in zip(_LINEAR_RANGE, _NAMED_RANGE))
    strength = expression.std(0, unbiased=False)
    psi = avatar.weights(shown).abs().amax(0)
    arkit = _arkit(avatar)
    return {
        "num_bases": config.num_bases,
        "variant": config.tangent_variant,
        "carrier": config.carrier,
        "scale_with_triangle": config.scale_with_triangle,
        "pose_input": config.pose_input,
        "translation_input": config.translation_input,
        "layout": layout.to_json(),
        "parents": [int(parent) for parent in avatar.head.arrays.parents],
        "expression_names": list(names),
        "expression_range": [
            torch.minimum(expression.amin(0), low).tolist(),
            torch.maximum(expression.amax(0), high).tolist(),
        ],
        "expression_order": torch.argsort(strength, descending=True, stable=True).tolist(),
        "psi_range": (1.5 * psi).clamp(min=0.1).tolist(),
        "camera": {
            "rotation": camera.world_to_camera[0, :3, :3].flatten().tolist(),
            "translation": camera.world_to_camera[0, :3, 3].tolist(),
            "focal": camera.focal_px[0].tolist(),
            "principal": camera.principal_point_px[0].tolist(),
            "width": camera.width,
            "height": camera.height,
        },
        "arkit": arkit and {"names": list(ARKIT_NAMES), "turns": arkit.turns},
        "background": list(background),
        "frames_per_second": frames_per_second,
        "film": _film(avatar, seen),
    }


def _film(avatar: Avatar, seen: TrainingStatistics | None) -> dict[str, Any]:
    """What counts as filmed: lowest and highest yaw and pitch in radians, lowest and highest theta.

    Of an avatar that brings no statistics, theta's range is None and the turns are those of most
    films.
    """
    rest = torch.zeros(1, avatar.layout.size)
    known = seen or TrainingStatistics.of(rest, torch.zeros(1, 1), avatar.layout)
    turns = (known.filmed_turns(), known.turn_reach())
    turn, reach = ([end.deg2rad().tolist() for end in ends] for ends in turns)
    theta = None if seen is None else [end.tolist() for end in seen.film_range()]
    return {"turn": turn, "turn_reach": reach, "theta": theta}
