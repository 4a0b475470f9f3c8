"""How badly a pose of the head explains one frame's landmarks, with derivatives."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from rgbavatar_ns.head.landmarks import LandmarkNoise
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead
from rgbavatar_ns.tracking.fit.levenberg_marquardt import QuadraticModel
from rgbavatar_ns.tracking.fit.parameters import FitParameters

_Values = Float[np.ndarray, "P"]
_Theta = Float[np.ndarray, "H"]
_Identity = Float[np.ndarray, "I"]
_Distances = Float[np.ndarray, "R"]

# Huber's loss finds the head from afar; then points beyond `_REDESCENDING_SIGMAS` (a hand, a slip)
# count ever less: Geman and McClure's loss. Sigmas are of a landmark's own error.
_HUBER_SIGMAS = 2.5
_REDESCENDING_SIGMAS = 3.0


@dataclass(frozen=True)
class Target:
    """One frame's landmarks in pixels (those of the landmark head, in its order)."""

    points_px: Float[np.ndarray, "L 2"]
    face_height_px: float
    to_upright: Float[np.ndarray, "2 2"]
    """Rotation of the image after which the forehead is straight above the chin."""
    seen: Float[np.ndarray, "L"]
    """How much each landmark counts, 0 to 1: irises fade behind closing lids."""


@dataclass(frozen=True)
class FrameTerms:
    """What one frame's cost depends on beside the fitted entries of theta and the identity.

    With `redescending` far-off landmarks lose their pull; otherwise they keep an even one.
    `neighbours` is the mean that a frame is drawn to by `temporal_weight`; None draws it nowhere.
    """

    target: Target
    camera: StillCamera
    redescending: bool = False
    neighbours: _Values | None = None
    temporal_weight: float = 0.0


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

    def theta(self, values: _Values) -> _Theta:
        """theta with these fitted entries, and 0 elsewhere."""
        theta = np.zeros(self.head.layout.size)
        theta[self.parameters.columns] = values
        return theta

    def value(self, values: _Values, identity: _Identity, frame: FrameTerms) -> float:
        """The cost of `model` alone, in a fraction of its time."""
        return self.data_cost(self.theta(values), identity, frame) + self._prior(values, frame)

    def model(self, values: _Values, identity: _Identity, frame: FrameTerms) -> QuadraticModel:
        """The cost around a frame's values; derivatives to identity's first columns come last."""
        data = self.data_model(self.theta(values), identity, frame)
        own = slice(len(values))
        data.gradient[own] += self._prior_precision @ values
        data.hessian[own, own] += self._prior_precision
        if frame.neighbours is not None and frame.temporal_weight > 0:
            closeness = frame.temporal_weight * self.parameters.temporal_width**-2.0
            data.gradient[own] += closeness * (values - frame.neighbours)
            data.hessian[own, own] += np.diag(closeness)
        return replace(data, cost=data.cost + self._prior(values, frame))

    def _prior(self, values: _Values, frame: FrameTerms) -> float:
        cost = 0.5 * float(values @ self._prior_precision @ values)
        if frame.neighbours is not None and frame.temporal_weight > 0:
            closeness = frame.temporal_weight * self.parameters.temporal_width**-2.0
            cost += 0.5 * float(closeness @ (values - frame.neighbours) ** 2)
        return cost

    def data_cost(self, theta: _Theta, identity: _Identity, frame: FrameTerms) -> float:
        """What the landmarks cost."""
        points = self.head.points(theta, identity, frame.camera.eye_m)
        return self._explained(points, frame)[0]

    def data_model(self, theta: _Theta, identity: _Identity, frame: FrameTerms) -> QuadraticModel:
        """What the landmarks cost around theta."""
        camera, target = frame.camera, frame.target
        points, derivative = self.head.jacobian(theta, identity, self._unknowns, camera.eye_m)
        jacobian = camera.image_derivative(points, derivative)
        cost, pull, weight, factor = self._explained(points, frame)
        turn = target.to_upright / (target.face_height_px * self.noise.own_share[:, None, None])
        rows = (turn @ jacobian).reshape(len(pull), -1)
        weighted = rows * weight[:, None]
        shared = self._modes.T @ weighted
        hessian = rows.T @ weighted - shared.T @ cho_solve(factor, shared)
        return QuadraticModel(cost, rows.T @ pull, hessian)

    def _explained(
        self, points: Float[np.ndarray, "L 3"], frame: FrameTerms
    ) -> tuple[float, _Distances, _Distances, tuple[Float[np.ndarray, "K K"], bool]]:
        """The cheapest explanation: modes of the detector's noise, and what is left robustly.

        Cost, its gradient to the residuals, their weights, the factor of I + modes' weights modes.
        Found by reweighting, from Huber's loss on, since the other one has many minima. Residuals
        are in the upright face, in standard deviations of a landmark's own error.
        """
        target, losses = frame.target, _REDESCENDING if frame.redescending else _FROM_AFAR
        away_px = frame.camera.project(points) - target.points_px
        own_px = target.face_height_px * self.noise.own_share
        residual = away_px @ target.to_upright.T / own_px[:, None]
        amounts, weight, factor = np.zeros(self._modes.shape[1]), residual, None
        for robust in losses:
            left = residual - (self._modes @ amounts).reshape(-1, 2)
            weight = np.repeat(robust(np.linalg.norm(left, axis=1))[1] * target.seen, 2)
            weighted = self._modes * weight[:, None]
            normal = weighted.T @ self._modes + np.eye(len(amounts))
            factor = cho_factor(normal, check_finite=False)
            amounts = cho_solve(factor, weighted.T @ residual.reshape(-1), check_finite=False)
        assert factor is not None
        left = residual - (self._modes @ amounts).reshape(-1, 2)
        loss, soften = losses[-1](np.linalg.norm(left, axis=1))
        cost = float(loss @ target.seen + 0.5 * amounts @ amounts)
        return cost, (left * (soften * target.seen)[:, None]).reshape(-1), weight, factor


def _huber(distance: _Distances) -> tuple[_Distances, _Distances]:
    """Loss and weight (its derivative by distance^2 / 2): far-off points pull evenly."""
    far = distance > _HUBER_SIGMAS
    loss = np.where(far, _HUBER_SIGMAS * (distance - 0.5 * _HUBER_SIGMAS), 0.5 * distance**2)
    return loss, np.where(far, _HUBER_SIGMAS / np.maximum(distance, 1e-12), 1.0)


def _geman_mcclure(distance: _Distances) -> tuple[_Distances, _Distances]:
    """Loss and weight: far-off points cost a constant and hardly pull."""
    share = 1 / (1 + (distance / _REDESCENDING_SIGMAS) ** 2)
    return 0.5 * distance**2 * share, share**2


_FROM_AFAR = (_huber,) * 3
_REDESCENDING = (_huber, _huber, *(_geman_mcclure,) * 3)
