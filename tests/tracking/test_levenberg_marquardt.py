import numpy as np
import pytest
from scipy.optimize import lsq_linear

from rgbavatar_ns.tracking.fit.levenberg_marquardt import (
    Evaluation,
    QuadraticModel,
    levenberg_marquardt,
    minimize_box_quadratic,
)


@pytest.mark.parametrize("seed", range(20))
def test_box_quadratic_agrees_with_scipy(seed: int) -> None:
    random = np.random.default_rng(seed)
    size = int(random.integers(1, 30))
    matrix = random.normal(size=(size + 10, size)) * random.uniform(0.1, 3, size)
    target = random.normal(size=size + 10)
    lower, upper = -random.uniform(0, 0.3, size), random.uniform(0, 0.3, size)
    step = minimize_box_quadratic(matrix.T @ matrix, -matrix.T @ target, lower, upper)
    expected = lsq_linear(matrix, target, (lower, upper + 1e-12), tol=1e-14).x
    assert (step >= lower).all()
    assert (step <= upper).all()
    np.testing.assert_allclose(step, expected, atol=1e-6)


def test_levenberg_marquardt_finds_the_bounded_minimum_of_a_curved_valley() -> None:
    # Rosenbrock's valley cut at x <= .5: the minimum lies at (.5, .25) by hand.
    def model_at(point: np.ndarray) -> QuadraticModel:
        x, y = point
        residual = np.array([10 * (y - x * x), 1 - x])
        jacobian = np.array([[-20 * x, 10.0], [-1.0, 0.0]])
        return QuadraticModel(
            0.5 * float(residual @ residual), jacobian.T @ residual, jacobian.T @ jacobian
        )

    best = levenberg_marquardt(
        lambda point: Evaluation(model_at(point).cost, lambda: model_at(point)),
        np.array([-1.2, 1.0]),
        np.array([-2.0, -2.0]),
        np.array([0.5, 2.0]),
        iterations=200,
        tolerance=0.0,
    )
    np.testing.assert_allclose(best, [0.5, 0.25], atol=1e-5)
    assert model_at(best).cost == pytest.approx(0.125, abs=1e-6)


def test_a_point_is_evaluated_once_and_its_model_made_only_where_a_step_is_taken() -> None:
    evaluated, modelled = [], []

    def evaluate(point: np.ndarray) -> Evaluation:
        evaluated.append(tuple(point))

        def model() -> QuadraticModel:
            modelled.append(tuple(point))
            return QuadraticModel(0.5 * float(point @ point), point, np.eye(2))

        return Evaluation(0.5 * float(point @ point), model)

    free = np.full(2, np.inf)
    levenberg_marquardt(evaluate, np.array([3.0, 4.0]), -free, free, iterations=1)
    assert modelled == [(3.0, 4.0)]
    assert len(evaluated) == len(set(evaluated)) == 2
