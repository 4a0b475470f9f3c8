"""A performance as it comes, as the avatar's theta: calibrated, relative, held, smoothed."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.model.weight_network import softly_within
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics, expressive_numbers
from rgbavatar_ns.driving.one_euro import OneEuroFilter, OneEuroOptions
from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead
from rgbavatar_ns.driving.theta_map import MappedTheta, arkit_theta, theta_map
from rgbavatar_ns.driving.transfer import (
    DrivenPose,
    DrivingOptions,
    Reference,
    own_reference,
    relative_theta,
)
from rgbavatar_ns.head import turn_seen
from rgbavatar_ns.head.arkit import head_carrier
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.options import CheckedOptions, Weight

_CALMEST = 0.25
"""Share of the calibration's frames that count as rest: people talk and blink meanwhile."""
_GAP_S = 0.5
"""After a longer gap the performer may be anywhere: nothing is smoothed across it."""
_MOST_FRAMES = 600
"""A calibration keeps no more: ten seconds of the quickest senders."""


@dataclass(frozen=True)
class LiveOptions(CheckedOptions):
    """How a live performance becomes the avatar's."""

    calibrate_s: Weight = 1.0
    """For so many seconds the performer's rest is learnt; 0 takes the numbers as they are."""
    pose: DrivenPose = "relative"
    """Of the head's turns and place: departures from the performer's, as they are, or none."""
    keep_range: bool = True
    """Hold expressions softly to the film's range, and turns to where the avatar holds."""
    smooth: bool = True
    """Filter jitter with a one-euro filter."""
    filter: OneEuroOptions = field(default_factory=OneEuroOptions)
    """The filter's settings."""


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
        avatar: Avatar,
        own: TrainingStatistics,
        head: PerformerHead | None,
        camera: PinholeCameras,
        options: LiveOptions | None = None,
    ) -> None:
        self.options = options = LiveOptions() if options is None else options
        self._avatar, self._own, self._layout = avatar, own, avatar.layout
        self._map = None if head is None else theta_map(head.layout, head.arrays, avatar)
        if self._map is None:
            _ = avatar.arkit  # takes seconds for FLAME: now, not with the first frame
        self._world_to_camera = camera.world_to_camera[:1]
        relative = "neutral" if options.calibrate_s > 0 else "off"
        self._driving = DrivingOptions(relative=relative, pose=options.pose)
        self._carrier = head_carrier(avatar.head.arrays.expression_names)
        self._expressive = expressive_numbers(avatar.layout)
        self._filter = OneEuroFilter(options.filter)
        self._reference: Reference | None = None
        self._seen: list[Tensor] = []
        self._began_s: float | None = None
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

    def __call__(self, frame: PerformanceFrame) -> Float[Tensor, "H"]:
        """The avatar's theta for a frame."""
        mapped = self._mapped(frame)
        theta = mapped.theta[0]
        if self._learning:
            self._learn(theta, frame.time_s)
        driver = self._reference or Reference(theta, theta)
        result = relative_theta(
            mapped.theta,
            driver,
            own_reference(self._own),
            mapped.known,
            self._own,
            self._layout,
            self._driving,
        )[0]
        if self.options.keep_range:
            result = self._held(result)
        return self._smoothed(result, frame.time_s) if self.options.smooth else result

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
        if self._began_s is None or time_s < self._began_s:
            self._began_s = time_s
        self._seen.append(theta)
        over = time_s - self._began_s >= self.options.calibrate_s or len(self._seen) >= _MOST_FRAMES
        if over or not self._calibrated:
            self._reference = self._reference_of(torch.stack(self._seen))
        if over:
            self._learning, self._calibrated, self._seen = False, True, []

    def _reference_of(self, theta: Float[Tensor, "F H"]) -> Reference:
        """Rest: the mean of the calmest frames; the pose: the mean of all."""
        activity = theta[:, self._expressive].abs().sum(1)
        calmest = activity.argsort()[: max(1, round(_CALMEST * len(theta)))]
        return Reference(theta[calmest].mean(0), theta.mean(0))

    def _held(self, theta: Float[Tensor, "H"]) -> Float[Tensor, "H"]:
        """The expression within the film's range, the head's turn where the avatar holds."""
        own = self._own
        theta = torch.where(self._expressive, softly_within(theta, *own.film_range()), theta)
        low, high = own.turn_reach()
        seen = self._turn(theta)
        rest = torch.minimum(torch.maximum(self._turn(own.theta_mean), low), high)
        beyond = seen - torch.minimum(torch.maximum(seen, low), high)
        share = float((1 - beyond.abs() / (seen - rest).abs().clamp(min=1e-3)).clamp(0, 1).min())
        if share == 1.0:
            return theta
        carrier = self._layout.slice(self._carrier)
        start, end = (axis_angle_to_matrix(part[carrier]) for part in (own.theta_mean, theta))
        held = axis_angle_to_matrix(share * matrix_to_axis_angle(end @ start.mT)) @ start
        theta = theta.clone()
        theta[carrier] = matrix_to_axis_angle(held)
        return theta

    def _turn(self, theta: Float[Tensor, "H"]) -> Float[Tensor, "2"]:
        """Yaw and pitch in degrees as the camera sees the head."""
        return turn_seen(theta[None], self._world_to_camera, self._layout)[0, :2]

    def _smoothed(self, theta: Float[Tensor, "H"], time_s: float) -> Float[Tensor, "H"]:
        seconds = None if self._last_s is None else time_s - self._last_s
        self._last_s = time_s
        if seconds is None or not 0 < seconds < _GAP_S:
            self._filter = OneEuroFilter(self.options.filter)
            return self._filter(theta, 0.0)
        return self._filter(theta, seconds)
