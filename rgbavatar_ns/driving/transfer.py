"""Another's performance for an avatar: mapped by name, made relative, held to what was seen."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics, neutral_frame
from rgbavatar_ns.driving.one_euro import OneEuroOptions, one_euro
from rgbavatar_ns.errors import UserError, first_few
from rgbavatar_ns.head import HeadArrays, ThetaLayout
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_axis_angle


@dataclass(frozen=True)
class ThetaNames:
    """What each number of theta is called."""

    layout: ThetaLayout
    expression_names: tuple[str, ...]

    @classmethod
    def of(cls, layout: ThetaLayout, arrays: HeadArrays) -> "ThetaNames":
        """The names of a head model's theta."""
        return cls(layout, arrays.expression_names)

    @property
    def numbers(self) -> tuple[str, ...]:
        """A name for each number; the expressions' own, and field and place for the others."""
        names: list[str] = []
        for part in self.layout.fields:
            if part.name == "expression":
                names += self.expression_names
            else:
                names += [f"{part.name}[{i}]" for i in range(part.size)]
        return tuple(names)


@dataclass(frozen=True)
class MappedTheta:
    """A driver's theta in the avatar's layout."""

    theta: Float[Tensor, "F H"]
    known: Bool[Tensor, "H"]
    """Which of the avatar's numbers the driver has; the others are 0."""
    unmapped: tuple[str, ...]
    """The driver's numbers that the avatar does not know."""
    missing: tuple[str, ...]
    """The avatar's numbers that the driver does not know."""


@dataclass(frozen=True)
class DrivingOptions:
    """How a driver's performance becomes the avatar's."""

    relative: Literal["neutral", "mean", "off"] = "neutral"
    """Of the expression: subtract the driver's neutral frame (or mean), add the avatar's own. Off
    takes the driver's numbers as they are, with the other tracker's bias and the other's rest."""
    pose: Literal["relative", "absolute", "keep"] = "relative"
    """Of the head's turns and place: departures from the driver's mean pose start from the avatar's
    own; absolute takes them as they are; keep holds the avatar's mean pose."""
    project: bool = False
    """Hold the expression to the span and range of those seen in training. Without it the command
    tells how many frames go beyond."""
    smooth: bool = False
    """Filter jitter with a one-euro filter."""
    filter: OneEuroOptions = field(default_factory=OneEuroOptions)
    """The filter's settings."""


def map_by_name(theta: Float[Tensor, "F G"], driver: ThetaNames, avatar: ThetaNames) -> MappedTheta:
    """Theta of one head model in the layout of another, number by number by its name.

    Raises UserError where not a single expression has a name that the avatar knows.
    """
    if theta.shape[-1] != driver.layout.size:
        raise UserError(
            f"The driver's theta has {theta.shape[-1]} numbers, its layout {driver.layout.size}.",
            "Write the driver's dataset again.",
        )
    if not set(driver.expression_names) & set(avatar.expression_names):
        raise UserError(
            "The driver has no expression that the avatar knows: the driver's are "
            f"{first_few(driver.expression_names, 4)}, the avatar's "
            f"{first_few(avatar.expression_names, 4)}.",
            "Track the driver's video with the avatar's head model.",
        )
    place_of = {name: place for place, name in enumerate(driver.numbers)}
    result = theta.new_zeros(len(theta), avatar.layout.size)
    wanted = avatar.numbers
    known = torch.tensor([name in place_of for name in wanted])
    result[:, known] = theta[:, [place_of[name] for name in wanted if name in place_of]]
    return MappedTheta(
        result,
        known,
        unmapped=tuple(name for name in driver.numbers if name not in wanted),
        missing=tuple(name for name in wanted if name not in place_of),
    )


def make_relative(
    theta: Float[Tensor, "F H"],
    driver_reference: Float[Tensor, "H"],
    own_reference: Float[Tensor, "H"],
    layout: ThetaLayout,
) -> Float[Tensor, "F H"]:
    """The driver's departures from its reference, from the avatar's own reference.

    Linear and translation fields add; rotations compose, R = R_driver R_reference^-1 R_own, so
    that the reference itself becomes the avatar's own exactly.
    """
    result = own_reference + (theta - driver_reference)
    for part in layout.fields:
        if part.form == "axis_angle":
            numbers = layout.slice(part.name)
            turns, reference, own = (
                axis_angle_to_matrix(values[..., numbers])
                for values in (theta, driver_reference, own_reference)
            )
            result[..., numbers] = matrix_to_axis_angle(turns @ reference.mT @ own)
    return result


def drive(
    theta: Float[Tensor, "F G"],
    driver: ThetaNames,
    avatar: ThetaNames,
    own: TrainingStatistics,
    frames_per_second: float,
    options: DrivingOptions | None = None,
) -> MappedTheta:
    """A driver's performance as the avatar's theta: mapped, smoothed, relative, held.

    `own` is what the avatar saw in training. Raises UserError as `map_by_name`.
    """
    options = DrivingOptions() if options is None else options
    mapped = map_by_name(theta, driver, avatar)
    result = mapped.theta
    if options.smooth:
        result = one_euro(result, frames_per_second, options.filter)
    result = make_relative(result, *_references(result, own, options, avatar.layout), avatar.layout)
    if options.pose == "keep":
        result = torch.where(own.expressive, result, own.theta_mean)
    if options.project:
        result = own.project(result)
    return replace(mapped, theta=result)


def told_beyond(
    seen: TrainingStatistics,
    names: Sequence[str],
    theta: Float[Tensor, "#F H"],
    turns_degrees: Float[Tensor, "#F 3"],
) -> str:
    """What goes beyond the film that the avatar was trained on, most frequent first; may be empty.

    names: of theta's numbers. turns_degrees: `head.turn_seen` of the frames.
    """
    numbers, view = seen.beyond(theta, turns_degrees)
    frames = max(len(numbers), len(view))
    beyond = torch.cat([view[:, None].expand(frames, 1), numbers.expand(frames, -1)], 1)
    counts = beyond.sum(0).tolist()
    found = sorted((-count, place) for place, count in enumerate(counts) if count)
    if not found:
        return ""
    called = ("the head's turn", *names)
    several = frames > 1
    told = [called[place] + (f" ({-count})" if several else "") for count, place in found]
    share = f" in {int(beyond.any(1).sum())} of {frames} pictures" if several else ""
    return f"beyond the film{share}: {first_few(told, 6)}"


def _references(
    theta: Float[Tensor, "F H"],
    own: TrainingStatistics,
    options: DrivingOptions,
    layout: ThetaLayout,
) -> tuple[Float[Tensor, "H"], Float[Tensor, "H"]]:
    """What is subtracted from the driver's theta, and what of the avatar's own is added."""
    nothing = torch.zeros_like(own.theta_mean)
    # Angles of a head are small: their mean is that of their axis-angle vectors.
    mean = (theta.mean(0), own.theta_mean)
    expression = {
        "neutral": (neutral_frame(theta, layout), own.theta_neutral),
        "mean": mean,
        "off": (nothing, nothing),
    }[options.relative]
    pose = mean if options.pose == "relative" else (nothing, nothing)
    driver, avatar = (torch.where(own.expressive, e, p) for e, p in zip(expression, pose))
    return driver, avatar
