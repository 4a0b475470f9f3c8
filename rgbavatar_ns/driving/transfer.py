"""Another's performance for an avatar: made relative, held to what was seen."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics, neutral_frame
from rgbavatar_ns.driving.one_euro import OneEuroOptions, one_euro
from rgbavatar_ns.driving.theta_map import MappedTheta
from rgbavatar_ns.errors import first_few
from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_axis_angle

DrivenPose = Literal["relative", "absolute", "keep"]


@dataclass(frozen=True)
class DrivingOptions:
    """How a driver's performance becomes the avatar's."""

    relative: Literal["neutral", "mean", "off"] = "neutral"
    """Of the expression: subtract the driver's neutral frame (or mean), add the avatar's own. Off
    takes the driver's numbers as they are, with the other tracker's bias and the other's rest."""
    pose: DrivenPose = "relative"
    """Of the head's turns and place: departures from the driver's mean pose start from the avatar's
    own; absolute takes them as they are; keep holds the avatar's mean pose."""
    project: bool = False
    """Hold the expression to the span and range of those seen in training. Without it the command
    tells how many frames go beyond."""
    smooth: bool = False
    """Filter jitter with a one-euro filter."""
    filter: OneEuroOptions = field(default_factory=OneEuroOptions)
    """The filter's settings."""


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
    turning = [layout.slice(field.name) for field in layout.fields if field.form == "axis_angle"]
    if turning:
        # All at once: single ones are too small for a tensor operation each.
        all_rows = torch.cat([driver_reference[None], own_reference[None], theta])
        turns = axis_angle_to_matrix(torch.stack([all_rows[:, numbers] for numbers in turning], 1))
        turned = matrix_to_axis_angle(turns[2:] @ (turns[0].mT @ turns[1]))
        for numbers, turn in zip(turning, turned.unbind(1)):
            result[:, numbers] = turn
    return result


def drive(
    mapped: MappedTheta,
    layout: ThetaLayout,
    own: TrainingStatistics,
    frames_per_second: float,
    options: DrivingOptions | None = None,
    films: Sequence[Sequence[int]] | None = None,
    moments: Sequence[int] | None = None,
    expression_names: Sequence[str] = (),
) -> MappedTheta:
    """A whole performance as the avatar's theta: smoothed, relative, held.

    `layout` and `own` are the avatar's: what its theta holds, and what it saw in training. films:
    rows that follow one another, a list for each camera; by default all as they come. moments:
    when each row was filmed, in frames, so that nothing is smoothed across a gap; by default one
    after another. `expression_names` are the avatar's, as `neutral_frame` takes them.
    """
    options = DrivingOptions() if options is None else options
    result = mapped.theta
    if options.smooth:
        result = result.clone()
        filmed = range(len(result)) if moments is None else moments
        for rows in [range(len(result))] if films is None else films:
            film, when = mapped.theta[list(rows)], [filmed[row] for row in rows]
            result[list(rows)] = one_euro(film, frames_per_second, options.filter, when)
    references = reference_of(result, layout, expression_names), own_reference(own)
    result = relative_theta(result, *references, mapped.known, own, layout, options)
    return replace(mapped, theta=result)


@dataclass(frozen=True)
class Reference:
    """What departures are counted from, of a driver or an avatar."""

    neutral: Float[Tensor, "H"]
    """At rest."""
    mean: Float[Tensor, "H"]


def reference_of(
    theta: Float[Tensor, "F H"], layout: ThetaLayout, expression_names: Sequence[str] = ()
) -> Reference:
    """A driver's reference over all its frames; `expression_names` as in `neutral_frame`."""
    # Angles of a head are small: their mean is that of their axis-angle vectors.
    return Reference(neutral_frame(theta, layout, expression_names), theta.mean(0))


def own_reference(own: TrainingStatistics) -> Reference:
    """The avatar's reference."""
    return Reference(own.theta_neutral, own.theta_mean)


def relative_theta(
    theta: Float[Tensor, "F H"],
    driver: Reference,
    avatar: Reference,
    known: Bool[Tensor, "H"],
    own: TrainingStatistics,
    layout: ThetaLayout,
    options: DrivingOptions,
) -> Float[Tensor, "F H"]:
    """A driver's theta as departures from its reference, put upon the avatar's own.

    What the driver does not know of the head's place and turn stays the avatar's.
    """
    nothing = Reference(*[torch.zeros_like(own.theta_mean)] * 2)
    theirs, ours = (nothing, nothing) if options.relative == "off" else (driver, avatar)
    expression = (
        (theirs.mean, ours.mean) if options.relative == "mean" else (theirs.neutral, ours.neutral)
    )
    posed = (driver.mean, avatar.mean) if options.pose == "relative" else (nothing.mean,) * 2
    starts = [torch.where(own.expressive, e, p) for e, p in zip(expression, posed)]
    result = make_relative(theta, starts[0], starts[1], layout)
    if options.project:
        result = own.project(result)
    still = ~own.expressive if options.pose == "keep" else ~own.expressive & ~known
    return torch.where(still, own.theta_mean, result)


def told_beyond(
    seen: TrainingStatistics,
    names: Sequence[str],
    theta: Float[Tensor, "#F H"],
    turns_degrees: Float[Tensor, "#F 3"],
    what: str = "pictures",
) -> str:
    """What goes beyond the film that the avatar was trained on, most frequent first; may be empty.

    names: of theta's numbers. turns_degrees: `head.turn_seen` of the frames, which are called
    `what`.
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
    share = f" in {int(beyond.any(1).sum())} of {frames} {what}" if several else ""
    return f"beyond the film{share}: {first_few(told, 6)}"
