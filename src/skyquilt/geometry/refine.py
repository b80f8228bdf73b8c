"""Least symmetric transfer error: a transformation refined over all of its matches [A (7),
(12)].
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyquilt.geometry.levenberg_marquardt import levenberg_marquardt
from skyquilt.geometry.transforms import inverse, normalisation, symmetric_transfer_errors

Doubles = NDArray[np.float64]


def _directions(*places: tuple[tuple[int, int, float], ...]) -> Doubles:
    """(K, 3, 3): derivative of a model's matrix with respect to each parameter."""
    G = np.zeros((len(places), 3, 3))
    for k, place in enumerate(places):
        for i, j, value in place:
            G[k, i, j] = value
    return G


_SHIFT = (((0, 2, 1.0),), ((1, 2, 1.0),))
_LINEAR = (((0, 0, 1.0),), ((0, 1, 1.0),), ((1, 0, 1.0),), ((1, 1, 1.0),))
_DIRECTIONS = {
    "translation": _directions(*_SHIFT),
    "similarity": _directions(*_SHIFT, ((0, 0, 1.0), (1, 1, 1.0)), ((0, 1, -1.0), (1, 0, 1.0))),
    "affine": _directions(*_SHIFT, *_LINEAR),
    "homography": _directions(*_SHIFT, *_LINEAR, ((2, 0, 1.0),), ((2, 1, 1.0),)),
}


def refine(model: str, H: Doubles, a: ArrayLike, b: ArrayLike, *, steps: int = 20) -> Doubles:
    """b_H_a (3, 3) of `model` with a local minimum of the sum of symmetric transfer errors over
    points a, b (N, 2).

    Levenberg-Marquardt with analytic derivatives, at most `steps` steps, starting from H, which
    must be of the model; the error never increases. The points are centred and scaled, both images
    by one factor, so that errors keep their ratio.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    both = normalisation(np.stack([a, b]), np.ones((2, len(a))))
    both[:, :2] *= (np.sqrt(both[0, 0, 0] * both[1, 0, 0]) / both[:, 0, 0])[:, None, None]
    if not np.isfinite(both).all() or not np.isfinite(H).all():
        return H
    Ta, Tb = both
    na, nb = a * Ta[0, 0] + Ta[:2, 2], b * Tb[0, 0] + Tb[:2, 2]
    start = Tb @ H @ inverse(Ta)
    before = symmetric_transfer_errors(H, a, b).sum()
    if not (abs(start[2, 2]) > 1e-9 and np.isfinite(before)):
        return H
    found = _descend(_DIRECTIONS[model], start / start[2, 2], na, nb, steps)
    refined = inverse(Tb) @ found @ Ta
    refined = refined / refined[2, 2]
    better = symmetric_transfer_errors(refined, a, b).sum() <= before
    return np.asarray(refined) if better else H


def _descend(G: Doubles, H: Doubles, a: Doubles, b: Doubles, steps: int) -> Doubles:
    def cost(H: Doubles) -> float:
        return float(symmetric_transfer_errors(H, a, b).sum())

    def linearise(H: Doubles) -> tuple[float, Callable[[float], Doubles]]:
        J, r = _linearised(G, H, a, b)
        JJ, Jr = J.T @ J, J.T @ r

        def step(damping: float) -> Doubles:
            damped = JJ + np.diag(damping * np.diag(JJ) + 1e-12)
            return np.asarray(H + np.tensordot(np.linalg.solve(damped, -Jr), G, 1))

        return float(r @ r), step

    return levenberg_marquardt(H, linearise, cost, iterations=steps, tolerance=1e-8).state


def _linearised(G: Doubles, H: Doubles, a: Doubles, b: Doubles) -> tuple[Doubles, Doubles]:
    """Jacobian (4 N, K) and residuals (4 N,) of both transfers."""
    M = inverse(H)
    x, y = (np.column_stack([p, np.ones(len(p))]) for p in (a, b))
    p, q = x @ H.T, y @ M.T
    dp = np.tensordot(x, G, (1, 2))  # (N, K, 3)
    dq = -np.tensordot(q, G, (1, 2)) @ M.T  # derivative of the inverse: -M G M
    J, r = [], []
    for value, derivative, target in ((p, dp, b), (q, dq, a)):
        with np.errstate(all="ignore"):
            u = value[:, :2] / value[:, 2:]
            J.append((derivative[..., :2] - u[:, None] * derivative[..., 2:]) / value[:, None, 2:])
        r.append(u - target)
    jacobian = np.concatenate(J).transpose(0, 2, 1).reshape(-1, len(G))
    return jacobian, np.concatenate(r).ravel()
