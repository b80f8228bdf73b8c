"""Homographies by the normalised direct linear transformation, many at once.

Hartley and Zisserman, Multiple View Geometry (2004), 4.1 (DLT) and 4.4.4 (normalisation).
"""

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

_SINGULAR = 1e-7
"""Of normalised coordinates: determinants and gaps of singular values below this mean that points
determine nothing.
"""


def normalisation(points: Doubles, weights: Doubles) -> Doubles:
    """(M, 3, 3) that move points (M, N, 2) to their weighted centre and to a mean square distance
    of 2.

    NaN where all points coincide.
    """
    w = weights / weights.sum(1, keepdims=True)
    centre = (w[..., None] * points).sum(1)
    spread = (w * ((points - centre[:, None]) ** 2).sum(-1)).sum(1)
    with np.errstate(all="ignore"):
        scale = np.where(spread > 0, np.sqrt(2 / spread), np.nan)
    T = np.zeros((len(points), 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2] = -scale[:, None] * centre
    T[:, 2, 2] = 1
    return T


def homographies(a: Doubles, b: Doubles, weights: Doubles) -> Doubles:
    """b_H_a (M, 3, 3), last element 1, of points (M, N >= 4, 2) and weights (M, N); NaN where
    undetermined.
    """
    Ta, Tb = normalisation(a, weights), normalisation(b, weights)
    na, nb = (p * T[:, :1, :1] + T[:, None, :2, 2] for p, T in ((a, Ta), (b, Tb)))
    with np.errstate(all="ignore"):
        H = _of_four(na, nb) if a.shape[1] == 4 else _of_more(na, nb, weights)
        H = H / np.abs(H).max((1, 2), keepdims=True)
        H[~(np.abs(np.linalg.det(H)) > _SINGULAR)] = np.nan
        back = np.zeros_like(Tb)  # the inverse of a normalisation
        back[:, 0, 0] = back[:, 1, 1] = 1 / Tb[:, 0, 0]
        back[:, :2, 2] = -Tb[:, :2, 2] / Tb[:, :1, 0]
        back[:, 2, 2] = 1
        H = back @ H @ Ta
        H = H / H[:, 2:, 2:]
    H[~np.isfinite(H).all((1, 2))] = np.nan
    return np.asarray(H)


def _of_four(a: Doubles, b: Doubles) -> Doubles:
    """Exactly, over the projective basis that four points are; many times cheaper than the SVD it
    equals.
    """
    basis_a, basis_b = _basis(a), _basis(b)
    cross = [np.cross(basis_a[:, :, i], basis_a[:, :, j]) for i, j in ((1, 2), (2, 0), (0, 1))]
    return np.asarray(basis_b @ np.stack(cross, 1))  # up to a factor the inverse of basis_a


def _basis(p: Doubles) -> Doubles:
    """(M, 3, 3) that takes the unit vectors and their sum to four points (M, 4, 2); NaN if three
    are on a line.
    """
    x = np.concatenate([p, np.ones((*p.shape[:2], 1))], -1)
    coordinates = np.stack(
        [
            _det(x[:, 3], x[:, 1], x[:, 2]),
            _det(x[:, 0], x[:, 3], x[:, 2]),
            _det(x[:, 0], x[:, 1], x[:, 3]),
        ],
        -1,
    )
    whole = _det(x[:, 0], x[:, 1], x[:, 2])
    bad = (np.abs(coordinates).min(-1) < _SINGULAR) | (np.abs(whole) < _SINGULAR)
    basis = np.swapaxes(x[:, :3], 1, 2) * coordinates[:, None, :]
    basis[bad] = np.nan
    return basis


def _det(p: Doubles, q: Doubles, r: Doubles) -> Doubles:
    return np.asarray((p * np.cross(q, r)).sum(-1))


def _of_more(a: Doubles, b: Doubles, weights: Doubles) -> Doubles:
    """The right singular vector of the least singular value of the 2 N weighted equations."""
    x = np.concatenate([a, np.ones((*a.shape[:2], 1))], -1)
    zero = np.zeros_like(x)
    rows = np.concatenate(
        [
            np.concatenate([x, zero, -b[..., :1] * x], -1),
            np.concatenate([zero, x, -b[..., 1:] * x], -1),
        ],
        1,
    )
    rows = rows * np.sqrt(np.concatenate([weights, weights], 1))[..., None]
    usable = np.isfinite(rows).all((1, 2))  # LAPACK raises where a number is not finite
    _, values, vectors = np.linalg.svd(
        np.where(usable[:, None, None], rows, 0.0), full_matrices=False
    )
    H = vectors[:, 8].reshape(-1, 3, 3).copy()
    H[~usable | (values[:, 7] <= _SINGULAR * values[:, 0])] = np.nan
    return H
