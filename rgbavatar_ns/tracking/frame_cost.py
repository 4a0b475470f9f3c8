"""How badly a pose of the head explains one frame's landmarks, with derivatives."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.tracking.bounded import QuadraticModel
from rgbavatar_ns.tracking.camera import StillCamera
from rgbavatar_ns.tracking.landmark_head import LandmarkHead
from rgbavatar_ns.tracking.parameters import FitParameters

# Pairs of landmarks whose distance says how far lips and lids are open: their difference counts
# by itself, so that a bias of both points does not hide a closed mouth or eye.
LIP_PAIRS = ((13, 14), (82, 87), (312, 317), (81, 178), (311, 402), (80, 88), (310, 318))
LID_PAIRS = ((159, 145), (158, 153), (160, 144), (386, 374), (385, 380), (387, 373))
# One standard deviation of a landmark is this share of the face's height. Neighbouring landmarks
# err together: the sum over all counts as about `_INDEPENDENT` independent points.
_SIGMA_SHARE = 0.01
_INDEPENDENT = 120.0
_PAIR_WEIGHT = 3.0
# Huber's loss finds the head from afar; then points beyond `_REDESCENDING_SIGMAS` (a hand, a slip)
# count ever less: Geman and McClure's loss.
_HUBER_SIGMAS = 2.5
_REDESCENDING_SIGMAS = 3.0


RobustLoss = Callable[
    [Float[np.ndarray, "R"]], tuple[Float[np.ndarray, "R"], Float[np.ndarray, "R"]]
]


@dataclass(frozen=True)
class Target:
    """One frame's landmarks in pixels (those of the landmark head, in its order)."""

    points_px: Float[np.ndarray, "L 2"]
    face_height_px: float


@dataclass(frozen=True)
class Linearized:
    """Robust cost with gradient and Gauss-Newton Hessian to frame (P) and identity (I)."""

    cost: float
    gradient: Float[np.ndarray, "PI"]
    hessian: Float[np.ndarray, "PI PI"]


@dataclass
class FrameCost:
    """Reprojection of landmarks and of their pairs, plus priors; shared by all frames."""

    head: LandmarkHead
    facemesh_index: Int[np.ndarray, "L"]
    landmark_weight: Float[np.ndarray, "L"]
    parameters: FitParameters
    identity_columns: int = 0
    """How many identity coefficients are unknown too."""

    def __post_init__(self) -> None:
        self._unknowns = self.head.unknowns(self.parameters.columns, self.identity_columns)
        place = {int(index): row for row, index in enumerate(self.facemesh_index)}
        pairs = [
            (place[a], place[b]) for a, b in LIP_PAIRS + LID_PAIRS if a in place and b in place
        ]
        self._pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        scale = _INDEPENDENT / max(float((self.landmark_weight**2).sum()), 1e-9)
        pair_weight = np.full(len(self._pairs), _PAIR_WEIGHT * np.sqrt(scale))
        self._all_weights = np.concatenate([self.landmark_weight * np.sqrt(scale), pair_weight])

    def theta(
        self, values: Float[np.ndarray, "P"], base: Float[np.ndarray, "H"]
    ) -> Float[np.ndarray, "H"]:
        """theta with the fitted entries replaced."""
        theta = base.copy()
        theta[self.parameters.columns] = values
        return theta

    def linearize(
        self,
        theta: Float[np.ndarray, "H"],
        identity: Float[np.ndarray, "I"],
        camera: StillCamera,
        target: Target,
        *,
        redescending: bool = False,
    ) -> Linearized:
        """The data terms at theta; derivatives to identity's first columns come last.

        With `redescending` far-off landmarks lose their pull; otherwise they keep an even one.
        """
        derivatives = self.head.jacobian(theta, identity, self._unknowns, camera.eye_m)
        jacobian = camera.image_derivative(derivatives.points, derivatives.derivative)
        unit = _SIGMA_SHARE * target.face_height_px
        first, second = self._pairs.T
        return _robust_normal_equations(
            self._residual(derivatives.points, camera, target),
            np.concatenate([jacobian, jacobian[first] - jacobian[second]]) / unit,
            self._all_weights,
            _geman_mcclure if redescending else _huber,
        )

    def value(
        self,
        theta: Float[np.ndarray, "H"],
        identity: Float[np.ndarray, "I"],
        camera: StillCamera,
        target: Target,
        *,
        redescending: bool = False,
    ) -> float:
        """The cost of `linearize` alone, in a fraction of its time."""
        points = self.head.points(theta, identity, camera.eye_m)
        away = np.linalg.norm(self._residual(points, camera, target), axis=1)
        loss, _ = (_geman_mcclure if redescending else _huber)(away)
        return float(self._all_weights**2 @ loss)

    def _residual(
        self, points: Float[np.ndarray, "L 3"], camera: StillCamera, target: Target
    ) -> Float[np.ndarray, "R 2"]:
        """Of landmarks and pairs, in standard deviations of a landmark."""
        unit = _SIGMA_SHARE * target.face_height_px
        residual = (camera.project(points) - target.points_px) / unit
        first, second = self._pairs.T
        return np.concatenate([residual, residual[first] - residual[second]])

    def prior_value(
        self,
        values: Float[np.ndarray, "P"],
        neighbours: Float[np.ndarray, "P"] | None,
        temporal_weight: float,
    ) -> float:
        """The cost that `add_priors` adds."""
        cost = 0.5 * float(self.parameters.prior_width**-2.0 @ values**2)
        if neighbours is not None and temporal_weight > 0:
            closeness = temporal_weight * self.parameters.temporal_width**-2.0
            cost += 0.5 * float(closeness @ (values - neighbours) ** 2)
        return cost

    def add_priors(
        self,
        values: Float[np.ndarray, "P"],
        model: QuadraticModel,
        neighbours: Float[np.ndarray, "P"] | None,
        temporal_weight: float,
    ) -> QuadraticModel:
        """The frame's own prior to 0 and the temporal one to its neighbours' mean."""
        precision = self.parameters.prior_width**-2.0
        pull = precision * values
        if neighbours is not None and temporal_weight > 0:
            closeness = temporal_weight * self.parameters.temporal_width**-2.0
            pull = pull + closeness * (values - neighbours)
            precision = precision + closeness
        cost = model.cost + self.prior_value(values, neighbours, temporal_weight)
        return QuadraticModel(cost, model.gradient + pull, model.hessian + np.diag(precision))


def _huber(
    distance: Float[np.ndarray, "R"],
) -> tuple[Float[np.ndarray, "R"], Float[np.ndarray, "R"]]:
    """Loss and weight (its derivative by distance^2 / 2): far-off points pull evenly."""
    far = distance > _HUBER_SIGMAS
    loss = np.where(far, _HUBER_SIGMAS * (distance - 0.5 * _HUBER_SIGMAS), 0.5 * distance**2)
    return loss, np.where(far, _HUBER_SIGMAS / np.maximum(distance, 1e-12), 1.0)


def _geman_mcclure(
    distance: Float[np.ndarray, "R"],
) -> tuple[Float[np.ndarray, "R"], Float[np.ndarray, "R"]]:
    """Loss and weight: far-off points cost a constant and hardly pull."""
    share = 1 / (1 + (distance / _REDESCENDING_SIGMAS) ** 2)
    return 0.5 * distance**2 * share, share**2


def _robust_normal_equations(
    residual: Float[np.ndarray, "R 2"],
    jacobian: Float[np.ndarray, "R 2 Q"],
    weight: Float[np.ndarray, "R"],
    robust: RobustLoss,
) -> Linearized:
    loss, soften = robust(np.linalg.norm(residual, axis=1))
    root = (weight * np.sqrt(soften))[:, None]
    scaled = (jacobian * root[..., None]).reshape(-1, jacobian.shape[-1])
    return Linearized(
        float((weight**2) @ loss),
        scaled.T @ (residual * root).reshape(-1),
        scaled.T @ scaled,
    )
