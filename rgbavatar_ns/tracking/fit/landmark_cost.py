"""How badly a pose of the head explains one frame's landmarks, with derivatives."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.linalg import get_lapack_funcs

from rgbavatar_ns.head.landmarks import LandmarkNoise
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead, PosedLandmarks
from rgbavatar_ns.tracking.fit.levenberg_marquardt import Evaluation, QuadraticModel
from rgbavatar_ns.tracking.fit.parameters import FitParameters

_Values = Float[np.ndarray, "P"]
_Theta = Float[np.ndarray, "H"]
_Identity = Float[np.ndarray, "I"]
_Distances = Float[np.ndarray, "R"]

# Huber's loss finds the head from afar; then points beyond `_REDESCENDING_SIGMAS` (a hand, a slip)
# count ever less: Geman and McClure's loss. Sigmas are of a landmark's own error.
_HUBER_SIGMAS = 2.5
_REDESCENDING_SIGMAS = 3.0

# LAPACK itself: scipy's wrappers take longer than these matrices do.
_solve_positive, _solve_triangular = get_lapack_funcs(("posv", "trtrs"), dtype=np.float64)


@dataclass(frozen=True)
class Target:
    """One frame's landmarks in pixels (those of the landmark head, in its order).

    `own_share` is how much each errs by itself across and along the upright face, as shares of
    its height.
    """

    points_px: Float[np.ndarray, "L 2"]
    own_share: Float[np.ndarray, "L 2"]
    face_height_px: float
    to_upright: Float[np.ndarray, "2 2"]
    """Rotation of the image after which the forehead is straight above the chin."""
    seen: Float[np.ndarray, "L"]
    """How much each landmark counts, 0 to 1: irises fade behind closing lids, and FaceMesh's count
    only where none are found."""


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
    """Of the landmarks, row for row of `head`; a target's own share differs where modes are 0."""
    parameters: FitParameters
    identity_columns: int = 0
    """How many identity coefficients are unknown too."""

    def __post_init__(self) -> None:
        self._unknowns = self.head.unknowns(self.parameters.columns, self.identity_columns)
        self._prior_precision = self.parameters.prior_precision()
        self._prior_pull = self.parameters.prior_pull()
        # Residuals go by direction in the upright face, then by landmark.
        scaled = self.noise.modes / self.noise.own_share[:, None, None]
        self._modes = scaled.transpose(1, 0, 2).copy()
        self._no_modes = np.eye(scaled.shape[2])

    def theta(self, values: _Values) -> _Theta:
        """theta with these fitted entries, and 0 elsewhere."""
        theta = np.zeros(self.head.layout.size)
        theta[self.parameters.columns] = values
        return theta

    def at(self, values: _Values, identity: _Identity, frame: FrameTerms) -> Evaluation:
        """The cost of a frame's values; its model's last entries are identity's first columns."""
        theta = self.theta(values)
        posed = self.head.posed(theta, identity, frame.camera.eye_m)
        found = self._explained(posed.points_m, frame)
        weighed = self._prior_precision @ values
        pull = weighed - self._prior_pull
        # But for the constant by which the prior's mean costs nothing.
        cost = found.cost + float(values @ (0.5 * weighed - self._prior_pull))
        closeness, apart = None, values
        if frame.neighbours is not None and frame.temporal_weight > 0:
            closeness = frame.temporal_weight * self.parameters.temporal_width**-2.0
            apart = values - frame.neighbours
            cost += 0.5 * float(closeness @ apart**2)

        def model() -> QuadraticModel:
            data = self._model(posed, found, frame)
            own = slice(len(values))
            data.gradient[own] += pull
            data.hessian[own, own] += self._prior_precision
            if closeness is not None:
                data.gradient[own] += closeness * apart
                data.hessian[own, own] += np.diag(closeness)
            return replace(data, cost=cost)

        return Evaluation(cost, model)

    def data_at(self, theta: _Theta, identity: _Identity, frame: FrameTerms) -> Evaluation:
        """What the landmarks alone cost."""
        posed = self.head.posed(theta, identity, frame.camera.eye_m)
        found = self._explained(posed.points_m, frame)
        return Evaluation(found.cost, partial(self._model, posed, found, frame))

    def _model(
        self, posed: PosedLandmarks, found: "_Explanation", frame: FrameTerms
    ) -> QuadraticModel:
        """What the landmarks cost around a pose."""
        target = frame.target
        own_px = target.face_height_px * target.own_share
        slope = (target.to_upright / own_px[..., None]) @ frame.camera.image_slope(posed.points_m)
        rows = (slope @ self.head.derivative(posed, self._unknowns)).transpose(1, 0, 2)
        weighted = (rows * found.root_weight[:, None]).reshape(len(found.pull), -1)
        rows = rows.reshape(weighted.shape)
        # numpy knows the product of a matrix with its own transpose, and does half the work.
        left = _solve_triangular(found.factor, found.modes.T @ weighted, lower=1)[0]
        hessian = weighted.T @ weighted - left.T @ left
        return QuadraticModel(found.cost, rows.T @ found.pull, hessian)

    def _explained(self, points: Float[np.ndarray, "L 3"], frame: FrameTerms) -> "_Explanation":
        """The cheapest explanation: modes of the detector's noise, and what is left robustly.

        Found by reweighting, from Huber's loss on, since the other one has many minima. Residuals
        are in the upright face, in standard deviations of a landmark's own error.
        """
        target, losses = frame.target, _REDESCENDING if frame.redescending else _FROM_AFAR
        away_px = frame.camera.project(points) - target.points_px
        own_px = target.face_height_px * target.own_share
        residual = target.to_upright @ away_px.T / own_px.T
        left, weighted, factor = residual, self._modes, self._no_modes
        amounts, root = np.zeros(len(factor)), target.seen
        for robust in losses:
            root = np.sqrt(robust(np.square(left).sum(0))[1] * target.seen)
            weighted = (self._modes * root[:, None]).reshape(-1, len(factor))
            normal = weighted.T @ weighted + self._no_modes
            factor, amounts, _ = _solve_positive(
                normal, weighted.T @ (root * residual).reshape(-1), lower=1
            )
            left = residual - self._modes @ amounts
        loss, soften = losses[-1](np.square(left).sum(0))
        cost = float(loss @ target.seen + 0.5 * amounts @ amounts)
        pull = (left * (soften * target.seen)).reshape(-1)
        return _Explanation(cost, pull, root, weighted, factor)


@dataclass(frozen=True)
class _Explanation:
    """A cost, its gradient to the residuals, and what its Gauss-Newton Hessian is made from.

    `root_weight` are square roots of the landmarks' weights, `modes` are scaled by them, and
    `factor` is the lower Cholesky factor of I + modes' weights modes.
    """

    cost: float
    pull: Float[np.ndarray, "R"]
    root_weight: Float[np.ndarray, "L"]
    modes: Float[np.ndarray, "R K"]
    factor: Float[np.ndarray, "K K"]


def _huber(squared: _Distances) -> tuple[_Distances, _Distances]:
    """Loss and weight (its derivative by distance^2 / 2): far-off points pull evenly."""
    distance = np.sqrt(squared)
    # Within, `near` is the distance itself.
    near = np.minimum(distance, _HUBER_SIGMAS)
    loss = near * (distance - 0.5 * near)
    return loss, _HUBER_SIGMAS / np.maximum(distance, _HUBER_SIGMAS)


def _geman_mcclure(squared: _Distances) -> tuple[_Distances, _Distances]:
    """Loss and weight: far-off points cost a constant and hardly pull."""
    share = 1 / (1 + squared / _REDESCENDING_SIGMAS**2)
    return 0.5 * squared * share, share**2


_FROM_AFAR = (_huber,) * 3
_REDESCENDING = (_huber, _huber, *(_geman_mcclure,) * 3)
