"""What an avatar has seen in training: ranges of theta, psi and views, its space of expressions."""

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import ThetaLayout, turn_range, turn_seen
from rgbavatar_ns.head.arrays import NECK_SHIFTS
from rgbavatar_ns.head.layout import RIGID_FIELDS

_AXES = {
    **{f"theta_{kind}": "H" for kind in ("mean", "std", "min", "max", "neutral")},
    **{f"psi_{kind}": "K" for kind in ("mean", "std", "min", "max")},
    "expressive": "H",
    "components": "CH",
    "component_min": "C",
    "component_max": "C",
    "turn_low": "3",
    "turn_high": "3",
}
_EXPLAINED = 0.999
_NOTHING = 1e-8
_UNKNOWN_TURN_DEGREES = 15.0
"""Either way where the cameras were not kept, as people turn who talk to a camera."""
_SAME_SHARE, _SAME, _SAME_DEGREES = 0.1, 0.02, 5.0
"""Beyond is farther than this: of a number's range, in its own unit, of a turn."""
_REACH_DEGREES = 30.0
_CALM = 1.35
"""Times the smallest expression: of GRID's speakers half to two thirds of the frames, none of
which blinks."""


@dataclass(frozen=True)
class TrainingStatistics:
    """Of F training frames. Source: ours, after complaints of drivers that leave what was seen."""

    num_frames: int
    theta_mean: Float[Tensor, "H"]
    theta_std: Float[Tensor, "H"]
    theta_min: Float[Tensor, "H"]
    theta_max: Float[Tensor, "H"]
    theta_neutral: Float[Tensor, "H"]
    """The frame whose expression is nearest to rest."""
    psi_mean: Float[Tensor, "K"]
    psi_std: Float[Tensor, "K"]
    psi_min: Float[Tensor, "K"]
    psi_max: Float[Tensor, "K"]
    expressive: Bool[Tensor, "H"]
    """Which numbers of theta make the expression (all but the head's rigid motion)."""
    components: Float[Tensor, "C H"]
    """Orthonormal principal components of the expression that hold .999 of its variance."""
    component_min: Float[Tensor, "C"]
    component_max: Float[Tensor, "C"]
    turn_low: Float[Tensor, "3"] = field(default_factory=lambda: _unknown_turn(-1))
    """Yaw, pitch and roll in degrees as the cameras saw the head (`turn_seen`)."""
    turn_high: Float[Tensor, "3"] = field(default_factory=lambda: _unknown_turn(1))

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        theta: Float[Tensor, "F H"],
        psi: Float[Tensor, "F K"],
        layout: ThetaLayout,
        world_to_camera: Float[Tensor, "#F 4 4"] | None = None,
        expression_names: Sequence[str] = (),
    ) -> "TrainingStatistics":
        """Statistics of training frames; raises UserError where there are none.

        Without cameras the views are taken to be those of most films. `expression_names` as in
        `neutral_frame`.
        """
        if len(theta) == 0:
            raise UserError("There are no training frames.", "Give a dataset with frames.")
        expressive = expressive_numbers(layout)
        mean = theta.mean(0)
        centred = (theta - mean) * expressive
        _, strengths, directions = torch.linalg.svd(centred.double(), full_matrices=False)
        share = strengths.square().cumsum(0) / strengths.square().sum().clamp(min=_NOTHING**2)
        count = int((share < _EXPLAINED).sum()) + 1 if strengths.max() > _NOTHING else 0
        components = directions[:count].to(theta.dtype)
        along = centred @ components.T
        turns = {}
        if world_to_camera is not None:
            low, high = turn_range(turn_seen(theta, world_to_camera, layout))
            turns = {"turn_low": low, "turn_high": high}
        return cls(
            num_frames=len(theta),
            theta_mean=mean,
            theta_std=theta.std(0, unbiased=False),
            theta_min=theta.amin(0),
            theta_max=theta.amax(0),
            theta_neutral=neutral_frame(theta, layout, expression_names),
            psi_mean=psi.mean(0),
            # Of no weights torch would warn.
            psi_std=psi.std(0, unbiased=False) if psi.shape[1] else psi[0],
            psi_min=psi.amin(0),
            psi_max=psi.amax(0),
            expressive=expressive,
            components=components,
            component_min=along.amin(0),
            component_max=along.amax(0),
            **turns,
        )

    def film_range(self) -> tuple[Float[Tensor, "H"], Float[Tensor, "H"]]:
        """What of theta still counts as seen, lowest and highest: a little more than the film."""
        same = _SAME_SHARE * (self.theta_max - self.theta_min) + _SAME
        return self.theta_min - same, self.theta_max + same

    def filmed_turns(self) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
        """Yaw and pitch in degrees that still count as seen, lowest and highest.

        Without roll, since pictures can be turned.
        """
        return self.turn_low[:2] - _SAME_DEGREES, self.turn_high[:2] + _SAME_DEGREES

    def beyond(
        self, theta: Float[Tensor, "#F H"], turns_degrees: Float[Tensor, "#F 3"]
    ) -> tuple[Bool[Tensor, "#F H"], Bool[Tensor, "#F"]]:
        """Which numbers of the expression, and which views of the head, the film did not show.

        turns_degrees: `turn_seen`.
        """
        low, high = self.film_range()
        leftmost, rightmost = self.filmed_turns()
        middle = (leftmost + rightmost) / 2
        away = ((turns_degrees[:, :2] - middle + 180) % 360 - 180).abs()
        outside = (away > rightmost - middle).any(1)
        return ((theta < low) | (theta > high)) & self.expressive, outside

    def turn_reach(self) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
        """Yaw and pitch in degrees, lowest and highest, from where an avatar is shown unasked.

        30 degrees beyond what was filmed, and at least so far from the front.
        """
        low, high = self.turn_low[:2].clamp(max=0), self.turn_high[:2].clamp(min=0)
        return low - _REACH_DEGREES, high + _REACH_DEGREES

    def project(self, theta: Float[Tensor, "F H"]) -> Float[Tensor, "F H"]:
        """The nearest expression in the span and range of the components; rigid motion stays."""
        along = (theta - self.theta_mean) @ self.components.T
        held = torch.minimum(torch.maximum(along, self.component_min), self.component_max)
        return torch.where(self.expressive, self.theta_mean + held @ self.components, theta)

    def to_state(self) -> dict[str, Any]:
        """Tensors and numbers by field."""
        return {part.name: getattr(self, part.name) for part in fields(self)}

    @classmethod
    def from_state(cls, state: Any, layout: ThetaLayout) -> "TrainingStatistics":
        """Inverse of `to_state`; raises UserError where a field is missing, or is none of this."""
        remedy = "Export the avatar again."
        if not isinstance(state, dict):
            raise UserError("The training statistics are none.", remedy)
        # What was written before the film's turns were kept has none.
        wanted = [f for f in fields(cls) if f.name in state or f.default_factory is MISSING]
        missing = [part.name for part in wanted if part.name not in state]
        if missing:
            raise UserError(f"The training statistics lack {', '.join(missing)}.", remedy)
        values = {part.name: state[part.name] for part in wanted}
        sizes = {"H": layout.size, "3": 3}
        for name, axes in _AXES.items():
            if name not in values:
                continue
            value = values[name]
            fits = isinstance(value, Tensor) and value.ndim == len(axes)
            if fits and name == "expressive":
                fits = value.dtype == torch.bool
            elif fits:
                fits = value.is_floating_point()
            if not fits or any(
                sizes.setdefault(axis, size) != size for axis, size in zip(axes, value.shape)
            ):
                raise UserError(f"The training statistics' {name} does not fit in.", remedy)
        if type(values["num_frames"]) is not int or values["num_frames"] < 1:
            raise UserError("The training statistics are of no frames.", remedy)
        return cls(**values)


def _unknown_turn(sign: int) -> Float[Tensor, "3"]:
    return torch.full((3,), sign * _UNKNOWN_TURN_DEGREES)


def expressive_numbers(layout: ThetaLayout) -> Bool[Tensor, "H"]:
    """Which numbers of theta make the expression: all but rotation, neck and translation."""
    mask = torch.ones(layout.size, dtype=torch.bool)
    for name in RIGID_FIELDS:
        if name in layout:
            mask[layout.slice(name)] = False
    return mask


def neutral_frame(
    theta: Float[Tensor, "F H"], layout: ThetaLayout, expression_names: Sequence[str] = ()
) -> Float[Tensor, "H"]:
    """The frame whose expression is nearest to rest.

    Of the calm ones, whose sum of absolute values is near the smallest, that with the most closed
    jaw: of people who speak the calmest alone is often one between two words, the mouth ajar.
    `expression_names` are the head's, where they are known: those that carry the head upon a body,
    in centimetres, are no expression.
    """
    told = expressive_numbers(layout)
    for column, name in enumerate(expression_names, layout.slice("expression").start):
        told[column] &= name not in NECK_SHIFTS
    size = theta[:, told].abs().sum(1)
    calm = torch.nonzero(size <= _CALM * size.min())[:, 0]
    jaw = layout.slice("jaw").start
    return theta[calm[theta[calm, jaw].argmin()]]
