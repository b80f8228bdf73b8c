import numpy as np
import pytest

from skyquilt.geometry.levenberg_marquardt import levenberg_marquardt


def equations(residuals):
    """Of residuals (n,) with numerical derivatives."""

    def linearise(x):
        r = residuals(x)
        J = np.stack([(residuals(x + 1e-6 * e) - r) / 1e-6 for e in np.eye(len(x))], 1)

        def step(damping):
            return x - np.linalg.solve(J.T @ J * (1 + damping * np.eye(len(x))), J.T @ r)

        return float(r @ r), step

    return linearise, lambda x: float((residuals(x) ** 2).sum())


def rosenbrock(x):
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def test_a_curved_valley_is_followed_to_its_end():
    found = levenberg_marquardt(
        np.array([-1.2, 1.0]), *equations(rosenbrock), iterations=100, tolerance=1e-12
    )
    assert found.state == pytest.approx([1, 1], abs=1e-5)
    assert found.converged and found.cost < 1e-10 and found.iterations < 40


def test_too_few_steps_are_told_and_never_make_it_worse():
    linearise, cost = equations(rosenbrock)
    costs = [
        levenberg_marquardt(
            np.array([-1.2, 1.0]), linearise, cost, iterations=n, tolerance=1e-12
        ).state
        for n in range(1, 8)
    ]
    costs = [cost(x) for x in costs]
    assert (np.diff(costs) <= 0).all() and costs[0] < cost(np.array([-1.2, 1.0]))
    few = levenberg_marquardt(np.array([-1.2, 1.0]), linearise, cost, iterations=3, tolerance=1e-12)
    assert (few.converged, few.iterations) == (False, 3)


def test_where_no_step_helps_it_stays():
    here = np.array([3.0])

    def stuck(x):
        raise np.linalg.LinAlgError

    found = levenberg_marquardt(
        here, lambda x: (9.0, lambda damping: stuck(x)), lambda x: 9.0, iterations=5, tolerance=0.1
    )
    assert found.state is here and found.converged and found.iterations == 0
