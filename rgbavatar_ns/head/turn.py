"""How a camera sees a head, whether head, neck or camera has turned."""

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.head.layout import CARRIER_FIELDS, ThetaLayout
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_view_degrees


def turn_seen(
    theta: Float[Tensor, "#F H"], world_to_camera: Float[Tensor, "#F 4 4"], layout: ThetaLayout
) -> Float[Tensor, "F 3"]:
    """Yaw, pitch and roll in degrees of the head as each frame's camera sees it.

    0 from the front; positive yaw shows the head's left side, positive pitch looks from below.
    """
    parts = layout.split(theta)
    seen = world_to_camera[:, :3, :3].to(theta)
    turns = [parts[n] for n in CARRIER_FIELDS if n in parts and parts[n].shape[1] == 3]
    if turns:
        for turn in axis_angle_to_matrix(torch.stack(turns)):
            seen = seen @ turn
    return matrix_to_view_degrees(seen)


def turn_range(turns: Float[Tensor, "F 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Lowest and highest turns in degrees: the percentiles 2 and 98, for the sake of bad frames.

    Counted from a median frame, so that the back of the head is no jump; a range may reach beyond
    +-180.
    """
    middle = turns.median(0).values
    away = (turns - middle + 180) % 360 - 180
    low, high = torch.quantile(away, away.new_tensor([0.02, 0.98]), dim=0)
    return middle + low, middle + high
