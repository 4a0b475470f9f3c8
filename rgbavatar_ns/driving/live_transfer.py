"""A performance as it comes, as the avatar's theta: calibrated, relative, held, smoothed."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
import tyro
from jaxtyping import Bool, Float
from torch import Tensor

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics, expressive_numbers
from rgbavatar_ns.driving.closed_lips import ClosedLips
from rgbavatar_ns.driving.one_euro import GAP_S, OneEuroFilter, OneEuroOptions
from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead
from rgbavatar_ns.driving.theta_map import MappedTheta, arkit_theta, theta_map
from rgbavatar_ns.driving.transfer import (
    DrivenPose,
    DrivingOptions,
    Reference,
    own_reference,
    relative_theta,
)
from rgbavatar_ns.head import ThetaLayout, turn_seen
from rgbavatar_ns.head.arkit import head_carrier
from rgbavatar_ns.head.layout import CARRIER_FIELDS
from rgbavatar_ns.head.lips import LipGap
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.options import CheckedOptions, Weight
from rgbavatar_ns.threads import using_threads

_LOWEST = 0.1
"""Of a calibration's frames this share may lie below rest, as a tracker's noise does."""
_ROOM_SHARE = 0.5
"""How far expressions may go beyond the film, of its range."""
_NONE_BELOW = 0.05
"""FLAME's components go to both sides; named expressions at most by a tracker's noise."""
_TURN_ROOM_DEGREES = 20.0
"""How far the head may turn beyond the film. A viewer goes 30 degrees (`turn_reach`) because who
turns there knows; a performer's every turn would show what nobody filmed."""
_SETTLES_IN_S = 0.3
"""Rest comes down within so many seconds to where a calmer face stays, and hardly for one frame."""
_LEAST_UNIT = 0.3
"""Of smoothing: what hardly moved in the film trembles all the more in another's performance."""
_MOST_TURNS_BACK, _SAME_DEGREES = 4, 0.5
_LEAST_FRAMES = 10
"""Fewer say too little of who performs, however long they took."""
_MOST_FRAMES = 600
"""A calibration keeps no more: ten seconds of the quickest senders."""


@dataclass(frozen=True)
class LiveOptions(CheckedOptions):
    """How a live performance becomes the avatar's."""

    calibrate_s: Annotated[Weight, tyro.conf.arg(aliases=("--calibrate",))] = 1.0
    """For so many seconds the performer's rest is learnt; 0 takes the numbers as they are."""
    pose: DrivenPose = "relative"
    """Of the head's turns and place: departures from the performer's, as they are, or none."""
    keep_range: bool = True
    """Hold expressions softly to the film's range, and turns to where the avatar holds."""
    smooth: bool = True
    """Filter jitter with a one-euro filter."""
    filter: OneEuroOptions = field(default_factory=lambda: OneEuroOptions(2.0, 15.0))
    """The filter's settings; speeds count in each number's range in the film."""


class LiveTransfer:
    """One frame after the other as the avatar's theta.

    The performer's rest is learnt from the first frames, while the avatar already follows;
    `calibrate` learns it anew from the next ones and keeps the old until then.

    Args:
        avatar: whose theta is wanted.
        own: what it saw in training.
        head: of the source's theta; None where it sends ARKit's coefficients.
        camera: which will see the avatar (C = 1).

    Raises UserError where the avatar's head knows nothing of the source's.
    """

    def __init__(
        self,
        avatar: AvatarMethod,
        own: TrainingStatistics,
        head: PerformerHead | None,
        camera: PinholeCameras,
        options: LiveOptions | None = None,
    ) -> None:
        self.options = options = LiveOptions() if options is None else options
        self._avatar, self._own, self._layout = avatar, own, avatar.layout
        self._map, self.told = None, ""
        if head is None:
            _ = avatar.arkit  # takes seconds for FLAME: now, not with the first frame
        else:
            self._map = theta_map(head.layout, head.arrays, avatar)
            self.told = self._map(torch.zeros(1, head.layout.size)).told
            """What the user should know of the way from the source's head."""
        self._world_to_camera = camera.world_to_camera[:1]
        relative = "neutral" if options.calibrate_s > 0 else "off"
        self._driving = DrivingOptions(relative=relative, pose=options.pose)
        # Shoulders do what they do: only the head upon them is held back.
        upon = head_carrier(avatar.head.arrays.expression_names) == "neck"
        names = ("neck",) if upon else CARRIER_FIELDS
        self._carriers = [avatar.layout.slice(name) for name in names]
        matrix_to_axis_angle(torch.eye(3))  # brings a library within a second: now, not then
        self._start_turns = [axis_angle_to_matrix(own.theta_mean[one]) for one in self._carriers]
        self._start_seen = self._turn(own.theta_mean)
        self._expressive = expressive_numbers(avatar.layout)
        self._low, self._high = own.film_range()
        self._room = _ROOM_SHARE * (self._high - self._low)
        self._unit = (self._high - self._low).clamp(min=_LEAST_UNIT)
        self._lips = LipGap.of(avatar.head, avatar.identity)
        if self._lips is not None:
            self._closed = ClosedLips(self._lips.at_rest_m)
            self._own_closed_m = float(self._lips(own.theta_neutral[None])[0])
        self._rises = _rises(avatar.layout, own)
        self._filter = OneEuroFilter(options.filter)
        self._reference: Reference | None = None
        self._seen: list[Tensor] = []
        self._began_s: float | None = None
        self._learnt_s = 0.0
        self._last_s: float | None = None
        self._learning, self._calibrated = options.calibrate_s > 0, False

    @property
    def calibrating(self) -> bool:
        """Whether the performer's rest is being learnt."""
        return self._learning

    def calibrate(self) -> None:
        """Learn the performer's rest anew, from the next frame on."""
        self._learning, self._seen, self._began_s = True, [], None
        if self._driving.relative == "off":
            self._driving = DrivingOptions(relative="neutral", pose=self.options.pose)

    def learn(self, frame: PerformanceFrame) -> None:
        """Take a frame into the calibration before its turn, as of a recording one can."""
        self._learn(self._mapped(frame).theta[0], frame.time_s)

    def conclude(self) -> None:
        """Take what was learnt so far for the performer's rest, as at a recording's end."""
        if not self._seen:
            return
        seen = torch.stack(self._seen)
        self._reference = self._reference_of(seen)
        if self._lips is not None:
            self._closed.calibrate(self._lips(seen))
        self._learning, self._calibrated, self._seen = False, True, []

    @torch.no_grad()
    def __call__(self, frame: PerformanceFrame) -> Float[Tensor, "H"]:
        """The avatar's theta for a frame."""
        with using_threads(1):  # Numbers are few, and others are busy with faces and pictures.
            return self._transferred(frame)

    def _transferred(self, frame: PerformanceFrame) -> Float[Tensor, "H"]:
        mapped = self._mapped(frame)
        performed = mapped.theta[0]
        seconds = 0.0 if self._last_s is None else frame.time_s - self._last_s
        self._last_s = frame.time_s
        if not 0 < seconds < GAP_S:
            seconds = 0.0  # As if it were the first one.
        if self._learning:
            self._learn(performed, frame.time_s)
        self._settle(performed, seconds)
        theta = relative_theta(
            mapped.theta,
            self._reference or Reference(performed, performed),
            own_reference(self._own),
            mapped.known,
            self._own,
            self._layout,
            self._driving,
        )[0]
        if self.options.keep_range:
            theta = self._held(theta)
        if self._lips is not None and self._driving.relative != "off":
            theta = self._with_lips(self._lips, theta, performed, seconds)
        if self.options.smooth:
            theta = self._filter(theta / self._unit, seconds) * self._unit
        return theta

    def _mapped(self, frame: PerformanceFrame) -> MappedTheta:
        if self._map is not None and frame.theta is not None:
            return self._map(frame.theta[None])
        assert frame.coefficients is not None
        turn = None if frame.head_rotation is None else frame.head_rotation[None]
        return arkit_theta(self._avatar, frame.coefficients[None], turn)

    def _learn(self, theta: Float[Tensor, "H"], time_s: float) -> None:
        """Take one more frame into the calibration.

        The first time the reference is what the frames so far say, so that the avatar follows at
        once; later the old one stays until a new one is known.
        """
        if self._began_s is None:
            self._began_s = self._learnt_s = time_s
        step_s, self._learnt_s = time_s - self._learnt_s, time_s
        # As if it had begun so much later but for `GAP_S`: while nobody is seen, nothing is learnt.
        self._began_s += step_s - min(max(step_s, 0.0), GAP_S)
        self._seen.append(theta)
        long = time_s - self._began_s >= self.options.calibrate_s
        if (long and len(self._seen) >= _LEAST_FRAMES) or len(self._seen) >= _MOST_FRAMES:
            self.conclude()
        elif not self._calibrated:
            self._reference = self._reference_of(torch.stack(self._seen))

    def _settle(self, theta: Float[Tensor, "H"], seconds: float) -> None:
        """Let rest follow down what only rises from it: who talked while being met rests later."""
        if self._reference is None or self._driving.relative == "off":
            return
        rest = self._reference.neutral
        share = 1 - math.exp(-seconds / _SETTLES_IN_S)
        lower = rest + share * (torch.minimum(theta, rest) - rest)
        self._reference = replace(self._reference, neutral=torch.where(self._rises, lower, rest))

    def _reference_of(self, theta: Float[Tensor, "F H"]) -> Reference:
        """Rest, number by number; the pose: the mean of all.

        Who is met talks and blinks: what only ever rises from rest, as an open jaw does, rests
        where it is lowest. What goes to both sides, as a gaze does, rests at its median.
        """
        rest = torch.where(
            self._rises, torch.quantile(theta, _LOWEST, dim=0), theta.median(0).values
        )
        return Reference(rest, theta.mean(0))

    def _held(self, theta: Float[Tensor, "H"]) -> Float[Tensor, "H"]:
        """The expression within the film's range, the head's turn where the avatar holds.

        What only rises from rest never falls below it; everything else goes ever less far beyond
        the film: half the range for expressions, 20 degrees for the head.
        """
        held = _softly(theta, self._low, self._high, self._room)
        held = torch.where(self._rises, torch.maximum(held, self._own.theta_min), held)
        return self._turned_back(torch.where(self._expressive, held, theta))

    def _with_lips(
        self,
        lips: LipGap,
        theta: Float[Tensor, "H"],
        performed: Float[Tensor, "H"],
        seconds: float,
    ) -> Float[Tensor, "H"]:
        """The jaw moved so that the lips are as far apart as the performer's.

        Rest and range are learnt number by number, and small errors of many add up at the lips,
        where everybody looks: closed lips would stand open, and words be said through closed ones.
        """
        gap_m, own_m = lips(torch.stack([performed, theta])).tolist()
        wanted_m = self._own_closed_m + gap_m - self._closed.follow(gap_m, seconds)
        jaw = float(theta[lips.jaw]) + (wanted_m - own_m) / lips.slope_m_per_rad
        if self.options.keep_range:
            low, high = float(self._low[lips.jaw]), float(self._high[lips.jaw])
            jaw = min(max(jaw, low), high + _ROOM_SHARE * (high - low))
        theta = theta.clone()
        theta[lips.jaw] = jaw
        return theta

    def _turned_back(self, theta: Float[Tensor, "H"]) -> Float[Tensor, "H"]:
        """With the head's turn as the camera sees it softly within those filmed."""
        low, high = self._own.filmed_turns()
        room = torch.full_like(low, _TURN_ROOM_DEGREES)
        start_seen, seen = self._start_seen, self._turn(theta)
        wanted = _softly(seen, low, high, room)
        # Angles of large turns do not add: what is left is taken back again.
        for _ in range(_MOST_TURNS_BACK):
            kept = (wanted - start_seen) / torch.where(seen == start_seen, 1.0, seen - start_seen)
            share = float(torch.where((seen - wanted).abs() > _SAME_DEGREES, kept, 1.0).min())
            if share >= 1.0:
                break
            theta = theta.clone()
            for carrier, start in zip(self._carriers, self._start_turns):
                moved = matrix_to_axis_angle(axis_angle_to_matrix(theta[carrier]) @ start.mT)
                held = axis_angle_to_matrix(max(share, 0.0) * moved) @ start
                theta[carrier] = matrix_to_axis_angle(held)
            seen = self._turn(theta)
        return theta

    def _turn(self, theta: Float[Tensor, "H"]) -> Float[Tensor, "2"]:
        """Yaw and pitch in degrees as the camera sees the head."""
        return turn_seen(theta[None], self._world_to_camera, self._layout)[0, :2]


def _rises(layout: ThetaLayout, own: TrainingStatistics) -> Bool[Tensor, "H"]:
    """Which numbers only ever rise from rest: named expressions, lids, and the jaw's opening."""
    rises = torch.zeros(layout.size, dtype=torch.bool)
    for part in layout.fields:
        where = layout.slice(part.name)
        if part.form == "linear":
            rises[where] = own.theta_min[where] > -_NONE_BELOW
        elif part.name == "jaw":
            rises[where.start] = True
    return rises


def _softly(
    values: Float[Tensor, "D"],
    low: Float[Tensor, "D"],
    high: Float[Tensor, "D"],
    room: Float[Tensor, "D"],
) -> Float[Tensor, "D"]:
    """Values as they are within a range; beyond, each goes ever less far, at most by `room`."""
    nearest = torch.minimum(torch.maximum(values, low), high)
    return nearest + room * torch.tanh((values - nearest) / room.clamp(min=1e-6))
