"""Least squares with bounds: Levenberg-Marquardt whose steps solve the bounded problem.

Clamping an unbounded step afterwards is not enough: the other unknowns would still count on the
part that was cut off. Each step here is the minimum of the quadratic model inside the bounds.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, get_lapack_funcs

Vector = Float[np.ndarray, "P"]
Matrix = Float[np.ndarray, "P P"]
_BOX_STEPS = 50
# LAPACK itself: scipy's wrappers take longer than these matrices do.
(_solve_positive,) = get_lapack_funcs(("posv",), dtype=np.float64)


@dataclass(frozen=True)
class QuadraticModel:
    """Cost, gradient and Gauss-Newton Hessian of a least-squares problem at one point."""

    cost: float
    gradient: Vector
    hessian: Matrix


@dataclass(frozen=True)
class Evaluation:
    """The cost at one point; `model` goes on from what the cost was found with."""

    cost: float
    model: Callable[[], QuadraticModel]


def minimize_box_quadratic(
    hessian: Matrix, gradient: Vector, lower: Vector, upper: Vector
) -> Vector:
    """Minimum of 1/2 d'Hd + g'd over lower <= d <= upper, H positive definite, 0 inside.

    Projected Newton with an active set (Bertsekas 1982): unknowns at a bound whose gradient
    pushes outwards are held, the rest takes a Newton step with a projected line search.
    """
    step = np.zeros_like(gradient)
    value = 0.0
    for _ in range(_BOX_STEPS):
        slope = gradient + hessian @ step
        held = ((step <= lower) & (slope > 0)) | ((step >= upper) & (slope < 0))
        free = np.flatnonzero(~held)
        if free.size == 0 or np.abs(slope[free]).max() <= 1e-10 * (1 + np.abs(gradient).max()):
            break
        direction = np.zeros_like(step)
        _, solved, failed = _solve_positive(hessian[np.ix_(free, free)], slope[free])
        if failed:
            raise LinAlgError("the matrix is not positive definite")
        direction[free] = -solved
        length = 1.0
        while True:
            trial = np.clip(step + length * direction, lower, upper)
            trial_value = float(gradient @ trial + 0.5 * trial @ hessian @ trial)
            if trial_value <= value + 1e-4 * float(slope @ (trial - step)):
                break
            length *= 0.5
            if length < 1e-8:
                return step
        settled = value - trial_value <= 1e-13 * (1 + abs(value))
        step, value = trial, trial_value
        if settled:
            break
    return step


def levenberg_marquardt(
    evaluate: Callable[[Vector], Evaluation],
    start: Vector,
    lower: Vector,
    upper: Vector,
    *,
    iterations: int,
    tolerance: float = 1e-4,
) -> Vector:
    """Minimise inside the bounds, from `start`; the damping follows whether steps succeed.

    A model is asked for only where a step is taken from. Returns the best point.
    Stops when a step lowers the cost by less than `tolerance` of it. Deterministic.
    """
    point, damping = np.clip(start, lower, upper), 1e-4
    here, model = evaluate(point), None
    for _ in range(iterations):
        model = here.model() if model is None else model
        damped = model.hessian.copy()
        diagonal = np.einsum("ii->i", damped)
        diagonal += damping * np.maximum(diagonal, 1e-9) + 1e-12
        try:
            step = minimize_box_quadratic(damped, model.gradient, lower - point, upper - point)
        except LinAlgError:
            damping = max(damping, 1e-6) * 10
            continue
        trial = np.clip(point + step, lower, upper)
        there = evaluate(trial)
        if there.cost < here.cost:
            gained = here.cost - there.cost
            point, here, model, damping = trial, there, None, max(damping / 5, 1e-9)
            if gained < tolerance * (here.cost + 1e-12):
                break
        else:
            damping = max(damping, 1e-6) * 10
            if damping > 1e6:
                break
    return point
