"""How badly a pose of the head explains one frame's landmarks, with derivatives."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from rgbavatar_ns.head.landmarks import LandmarkNoise
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead
from rgbavatar_ns.tracking.fit.levenberg_marquardt import QuadraticModel
from rgbavatar_ns.tracking.fit.parameters import FitParameters

# Huber's loss finds the head from afar; then points beyond `_REDESCENDING_SIGMAS` (a hand, a slip)
# count ever less: Geman and McClure's loss. Sigmas are of a landmark's own error.
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
    to_upright: Float[np.ndarray, "2 2"]
    """Rotation of the image after which the forehead is straight above the chin."""


@dataclass(frozen=True)
class Linearized:
    """Robust cost with gradient and Gauss-Newton Hessian to frame (P) and identity (I)."""

    cost: float
    gradient: Float[np.ndarray, "PI"]
    hessian: Float[np.ndarray, "PI PI"]


@dataclass(frozen=True)
class _Explained:
    """Residuals taken apart: cost, its gradient `pull` to them, weights of their coordinates, and
    the factor of I + modes' weights modes."""

    cost: float
    pull: Float[np.ndarray, "R"]
    weight: Float[np.ndarray, "R"]
    factor: tuple[Float[np.ndarray, "K K"], bool]


@dataclass
class FrameCost:
    """Reprojection of landmarks, weighed by how they err together, plus priors; for all frames."""

    head: LandmarkHead
    noise: LandmarkNoise
    """Of the landmarks, row for row of `head`."""
    parameters: FitParameters
    identity_columns: int = 0
    """How many identity coefficients are unknown too."""

    def __post_init__(self) -> None:
        self._unknowns = self.head.unknowns(self.parameters.columns, self.identity_columns)
        self._prior_precision = self.parameters.prior_precision()
        scaled = self.noise.modes / self.noise.own_share[:, None, None]
        self._modes = scaled.reshape(-1, scaled.shape[2])

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
        found = self._explained(self._residual(derivatives.points, camera, target), redescending)
        turn = target.to_upright / (target.face_height_px * self.noise.own_share[:, None, None])
        rows = (turn @ jacobian).reshape(len(found.pull), -1)
        weighted = rows * found.weight[:, None]
        shared = self._modes.T @ weighted
        hessian = rows.T @ weighted - shared.T @ cho_solve(found.factor, shared)
        return Linearized(found.cost, rows.T @ found.pull, hessian)

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
        return self._explained(self._residual(points, camera, target), redescending).cost

    def _residual(
        self, points: Float[np.ndarray, "L 3"], camera: StillCamera, target: Target
    ) -> Float[np.ndarray, "L 2"]:
        """In the upright face, in standard deviations of a landmark's own error."""
        away_px = camera.project(points) - target.points_px
        own_px = target.face_height_px * self.noise.own_share
        return away_px @ target.to_upright.T / own_px[:, None]

    def _explained(self, residual: Float[np.ndarray, "L 2"], redescending: bool) -> "_Explained":
        """The cheapest explanation: modes of the detector's noise, and what is left robustly.

        Found by reweighting, from Huber's loss on, since the other one has many minima.
        """
        losses = _REDESCENDING if redescending else _FROM_AFAR
        found = self._reweighted(residual, np.zeros(self._modes.shape[1]), losses[0])
        for robust in losses[1:]:
            found = self._reweighted(residual, found[0], robust)
        amounts, weight, factor = found
        left = residual - (self._modes @ amounts).reshape(-1, 2)
        loss, soften = losses[-1](np.linalg.norm(left, axis=1))
        cost = float(loss.sum() + 0.5 * amounts @ amounts)
        return _Explained(cost, (left * soften[:, None]).reshape(-1), weight, factor)

    def _reweighted(
        self, residual: Float[np.ndarray, "L 2"], amounts: Float[np.ndarray, "K"], loss: RobustLoss
    ) -> tuple[
        Float[np.ndarray, "K"],
        Float[np.ndarray, "R"],
        tuple[Float[np.ndarray, "K K"], bool],
    ]:
        """The modes' amounts that suit the weights that the last ones leave; weights, factor."""
        left = residual - (self._modes @ amounts).reshape(-1, 2)
        weight = np.repeat(loss(np.linalg.norm(left, axis=1))[1], 2)
        weighted = self._modes * weight[:, None]
        normal = weighted.T @ self._modes + np.eye(len(amounts))
        factor = cho_factor(normal, check_finite=False)
        return (
            cho_solve(factor, weighted.T @ residual.reshape(-1), check_finite=False),
            weight,
            factor,
        )

    def prior_value(
        self,
        values: Float[np.ndarray, "P"],
        neighbours: Float[np.ndarray, "P"] | None,
        temporal_weight: float,
    ) -> float:
        """The cost that `add_priors` adds."""
        cost = 0.5 * float(values @ self._prior_precision @ values)
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
        """The frame's own prior and the temporal one to its neighbours' mean."""
        precision = self._prior_precision
        pull = precision @ values
        if neighbours is not None and temporal_weight > 0:
            closeness = temporal_weight * self.parameters.temporal_width**-2.0
            pull = pull + closeness * (values - neighbours)
            precision = precision + np.diag(closeness)
        cost = model.cost + self.prior_value(values, neighbours, temporal_weight)
        return QuadraticModel(cost, model.gradient + pull, model.hessian + precision)


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


_FROM_AFAR: tuple[RobustLoss, ...] = (_huber,) * 3
_REDESCENDING: tuple[RobustLoss, ...] = (_huber, _huber, *(_geman_mcclure,) * 3)
