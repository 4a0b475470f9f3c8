"""Small corrections to tracked theta, found from the images: while training, or for one avatar.

The paper names tracking errors as its limitation. Corrections are counted in standard deviations
of the errors that a tracker is expected to make, so that one prior and one learning rate fit all.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rgbavatar_ns.avatar.refinement.calibration import fit_ridge
from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.options import CheckedOptions, Counted, Positive, Share, Weight

_BETAS = (0.9, 0.99)
_HEAD_POSE = "rotation"


@dataclass(frozen=True)
class RefinementConfig(CheckedOptions):
    """How far tracked theta may be corrected, and how quickly."""

    start_step: Counted = 50
    """First training step that corrects; before, the avatar explains too little."""
    bases_start: Share = 0.45
    """Share of training (of its steps, or of those over which learning rates fall where they are
    fewer) after which the bases of the blendshapes begin to learn. Sooner, they would learn the
    tracker's errors by heart, frame by frame, and leave nothing to correct."""
    rotation_sigma_rad: Positive = 0.01
    """Expected error of the head's rotation, in radians about each axis."""
    joint_sigma_rad: Positive = 0.01
    """Expected error of neck, jaw and eyes, in radians about each axis."""
    translation_sigma_m: Positive = 0.001
    """Expected error of the head's place in metres, along each axis."""
    expression_sigma: float = 0.05
    """Expected error of the coefficients of expressions and eyelids."""
    learning_rate: Positive = 0.4
    """Largest change in a step, in these standard deviations; falls as a frame is seen again."""
    prior_weight: Weight = 1e-5
    """What a correction of one standard deviation in one number adds to the loss of its frame."""

    def first_step_of(self, group: str, steps: int) -> int:
        """The first of `steps` training steps in which a parameter group of the avatar learns."""
        return int(self.bases_start * steps) if group.startswith("basis_") else 0


class TrackingRefinement(nn.Module):
    """Corrections to the theta of F frames, with the optimiser's state that belongs to them.

    Adam, one frame a row: a frame's moments move only when it is seen, and count its own visits.
    The second moment is shared by each field, so that what hardly shows in the image hardly moves.
    Numbers that the tracker left constant over all frames stay: an avatar that answered to them
    would miss them in new frames. Linear fields stay in the range that the tracker used.

    Args:
        centered: keep each number's mean correction at zero, so that an avatar trained with the
            corrected frames fits a tracker's new ones.
        reference: theta that says which numbers move, and in which range; by default `tracked`.
    """

    tracked: Float[Tensor, "F H"]
    correction: Float[Tensor, "F H"]
    first_moment: Float[Tensor, "F H"]
    second_moment: Float[Tensor, "F H"]
    visits: Int[Tensor, "F"]
    _sigma: Float[Tensor, "H"]
    _field_of: Int[Tensor, "H"]
    _low: Float[Tensor, "H"]
    _high: Float[Tensor, "H"]

    def __init__(
        self,
        tracked: Float[Tensor, "F H"],
        layout: ThetaLayout,
        config: RefinementConfig | None = None,
        *,
        centered: bool = True,
        reference: Float[Tensor, "R H"] | None = None,
    ) -> None:
        super().__init__()
        self.layout, self.centered = layout, centered
        self.config = RefinementConfig() if config is None else config
        sigma, field_of = _widths(layout, self.config)
        known = tracked if reference is None else reference
        moving = (known != known[:1]).any(0)
        self.register_buffer("tracked", tracked.detach().clone(), persistent=False)
        self.register_buffer("_sigma", sigma.to(tracked) * moving, persistent=False)
        self.register_buffer("_field_of", field_of.to(tracked.device), persistent=False)
        linear = torch.cat(
            [torch.full((f.size,), f.form == "linear", dtype=torch.bool) for f in layout.fields]
        ).to(tracked.device)
        infinite = torch.full_like(tracked[0], torch.inf)
        low = torch.where(linear, known.amin(0), -infinite)
        high = torch.where(linear, known.amax(0), infinite)
        self.register_buffer("_low", low, persistent=False)
        self.register_buffer("_high", high, persistent=False)
        for name in ("correction", "first_moment", "second_moment"):
            self.register_buffer(name, torch.zeros_like(tracked))
        self.register_buffer(
            "visits", torch.zeros(len(tracked), dtype=torch.int64, device=tracked.device)
        )

    def theta(self, rows: Int[Tensor, "B"] | None = None) -> Float[Tensor, "B H"]:
        """The corrected theta of these frames, or of all."""
        tracked, correction = self.tracked, self.correction
        if rows is not None:
            tracked, correction = tracked[rows], correction[rows]
        corrected = tracked + correction * self._sigma
        return corrected.clamp(self._low, self._high)

    @torch.no_grad()
    def calibrated(self, theta: Float[Tensor, "B H"]) -> Float[Tensor, "B H"]:
        """Theta of new frames of the same tracker, without the errors that all its frames have.

        The corrections found so far, as far as a linear map predicts them from the tracked theta,
        of which it knows no more than their range; none larger than in the frames that it was
        learnt from. What a bound cut off is none.
        """
        middle, spread = self.tracked.mean(0), self.tracked.std(0)
        steady = self._sigma == 0
        found = (self.theta() - self.tracked) / self._sigma.masked_fill(steady, 1)

        def standardized(values: Float[Tensor, "B H"]) -> Float[Tensor, "B H"]:
            return ((values - middle) / spread.clamp(min=1e-9)).masked_fill(steady, 0)

        mean = found.mean(0)
        learnt = fit_ridge(standardized(self.tracked), found - mean)
        # A number that hardly moved would else be a thousand of its widths away as soon as it does.
        known = theta.clamp(self.tracked.amin(0), self.tracked.amax(0))
        correction = standardized(known) @ learnt + mean
        correction = correction.clamp(found.amin(0), found.amax(0))
        return theta + correction * self._sigma

    @torch.no_grad()
    def step(self, rows: Int[Tensor, "B"], gradient: Float[Tensor, "B H"]) -> None:
        """Correct different frames by the gradient of each one's own loss by its theta."""
        config, (beta1, beta2) = self.config, _BETAS
        correction = self.correction[rows]
        slope = gradient * self._sigma + 2 * config.prior_weight * correction
        visits = self.visits[rows] + 1
        first = torch.lerp(slope, self.first_moment[rows], beta1)
        second = torch.lerp(self._field_mean(slope.square()), self.second_moment[rows], beta2)
        seen = visits[:, None].to(slope)
        size = (second / (1 - beta2**seen)).sqrt() + 1e-12
        rate = config.learning_rate / (1 + seen / 20)
        correction = correction - rate * first / (1 - beta1**seen) / size
        self.correction[rows] = correction
        self.first_moment[rows], self.second_moment[rows] = first, second
        self.visits[rows] = visits
        if self.centered:
            self.correction -= self.correction.mean(0)

    def _field_mean(self, values: Float[Tensor, "B H"]) -> Float[Tensor, "B H"]:
        """Each number's mean over those of its field that move."""
        fields = len(self.layout.fields)
        index = self._field_of.expand_as(values)
        total = values.new_zeros(len(values), fields).scatter_add_(1, index, values)
        moving = (self._sigma > 0).to(values)
        count = values.new_zeros(fields).scatter_add_(0, self._field_of, moving)
        return (total / count.clamp(min=1)).gather(1, index)


def _widths(
    layout: ThetaLayout, config: RefinementConfig
) -> tuple[Float[Tensor, "H"], Int[Tensor, "H"]]:
    """Each number's expected error, and the place of its field."""
    of_form = {
        "linear": config.expression_sigma,
        "axis_angle": config.joint_sigma_rad,
        "translation": config.translation_sigma_m,
    }
    widths = [
        config.rotation_sigma_rad if field.name == _HEAD_POSE else of_form[field.form]
        for field in layout.fields
    ]
    place = torch.cat([torch.full((f.size,), n) for n, f in enumerate(layout.fields)])
    return torch.tensor(widths)[place], place
