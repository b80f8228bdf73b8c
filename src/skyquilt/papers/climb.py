"""Registration by local maximisation of any similarity score of two images, over a similarity
transform near a start, from coarse to fine.
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from skyquilt.papers.picture_similarity import warped

Doubles = NDArray[np.float64]
Score = Callable[[NDArray[Any], NDArray[Any], NDArray[np.bool_]], float]


def motion(parameters: Doubles, shape: tuple[int, ...]) -> Doubles:
    """(3, 3) transform from (dx, dy[, rad, log scale]) about the centre of an image of `shape`, in
    its pixels.
    """
    dx, dy, angle, log_scale = (*parameters, 0.0, 0.0)[:4]
    c, s = np.exp(log_scale) * np.cos(angle), np.exp(log_scale) * np.sin(angle)
    x, y = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    return np.array([[c, -s, x + dx - c * x + s * y], [s, c, y + dy - s * x - c * y], [0, 0, 1]])


def reduced(image: NDArray[Any], factor: int) -> NDArray[np.float32]:
    """Area means of factor x factor pixels (H // factor, W // factor)."""
    h, w = image.shape[0] // factor, image.shape[1] // factor
    whole = image[: h * factor, : w * factor].astype(np.float32)
    return np.asarray(cv2.resize(whole, (w, h), interpolation=cv2.INTER_AREA), np.float32)


def at_level(H: Doubles, factor: float) -> Doubles:
    """b_H_a for images that are both reduced by `factor` (or enlarged, for its inverse), pixel
    centres at integers.
    """
    D = np.array([[factor, 0, (factor - 1) / 2], [0, factor, (factor - 1) / 2], [0, 0, 1]])
    return np.asarray(np.linalg.inv(D) @ H @ D)


def climb(
    score: Score,
    a: NDArray[Any],
    b: NDArray[Any],
    start: Doubles,
    *,
    similarity: bool,
    overlap: float,
    factors: tuple[int, ...],
) -> tuple[Doubles, float, float]:
    """(b_H_a, score, overlap): a local maximum near `start` by the simplex method of Nelder and
    Mead, at each reduction in turn.

    The first simplex has a size of 2 px at each level; for rotation and scale, the change that
    moves a corner by 2 px.
    """
    H, value, share = start, -np.inf, 0.0
    for factor in factors:
        small = [reduced(p, factor) for p in (a, b)]
        base = at_level(H, factor)
        reach = 2 / (0.5 * np.hypot(*small[0].shape))
        steps = np.array([2.0, 2.0, reach, reach][: 4 if similarity else 2])

        def loss(p: Doubles, base: Doubles = base, small: list[NDArray[Any]] = small) -> float:
            seen, inside = warped(small[1], base @ motion(p, small[0].shape), small[0].shape)
            return -score(small[0], seen, inside) if inside.mean() >= overlap else 1.0

        simplex = np.vstack([np.zeros(len(steps)), np.diag(steps)])
        options = {
            "initial_simplex": simplex,
            "xatol": 1e-2 * reach,
            "fatol": 1e-7,
            "maxiter": 60 * len(steps),
        }
        found = minimize(loss, simplex[0], method="Nelder-Mead", options=options)
        H = at_level(base @ motion(found.x, small[0].shape), 1 / factor)
        H, value = H / H[2, 2], -float(found.fun)
    share = float(warped(b, H, a.shape)[1].mean())
    return H, value, share


def levels(shape: tuple[int, ...], *, coarsest: int, finest: int = 1) -> tuple[int, ...]:
    """Reductions from the coarsest, whose longer side is at most `coarsest` px, to `finest`, by
    halves.
    """
    factor = finest
    while max(shape) / factor > coarsest:
        factor *= 2
    return tuple(factor >> k for k in range(factor.bit_length()) if factor >> k >= finest)
