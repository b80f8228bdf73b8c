"""Plane transformations between two images, as matrices b_H_a that take a's pixels to b's.

Four models: translation (2 degrees of freedom), similarity (4), affine (6), homography (8), each
fitted by a normalised direct linear transform. All functions take one set of points or many sets at
once, because a random search in Python is fast only when it tries hundreds of samples per call.
"""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Model = Literal["translation", "similarity", "affine", "homography"]
Doubles = NDArray[np.float64]

MODELS: tuple[Model, ...] = ("translation", "similarity", "affine", "homography")
"""From the fewest to the most degrees of freedom."""
MINIMAL: dict[str, int] = {"translation": 1, "similarity": 2, "affine": 3, "homography": 4}
"""Smallest number of correspondences that determines each model."""
_FLAT = 1e-9
"""Ratio of the variances across and along a line below which points count as collinear."""


def fit(model: str, a: ArrayLike, b: ArrayLike, weights: ArrayLike | None = None) -> Doubles | None:
    """The b_H_a (3, 3) that best takes points a (N, 2) to b (N, 2), N at least MINIMAL[model].

    Least squares of the distances in b; for a homography the algebraic error of the normalised DLT
    (Hartley and Zisserman, Multiple View Geometry, 4.1, 4.4). `weights` (N,), not negative,
    multiply the squares; None weights all equally. None where the points do not determine the model
    (too few, coincident, collinear) or are not finite.
    """
    a, b = np.asarray(a, np.float64).reshape(-1, 2), np.asarray(b, np.float64).reshape(-1, 2)
    if weights is None:
        weights = np.ones(len(a))
    weights = np.asarray(weights, np.float64)
    used = weights > 0
    a, b, weights = a[used], b[used], weights[used]
    if len(a) < MINIMAL[model] or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return None
    H = fit_many(model, a[None], b[None], weights[None])[0]
    return H if np.isfinite(H).all() else None


def fit_many(model: str, a: Doubles, b: Doubles, weights: Doubles | None = None) -> Doubles:
    """b_H_a (M, 3, 3) for M sets of points, a and b (M, N, 2), weights (M, N) or None; NaN where
    undetermined.
    """
    if model not in MINIMAL:
        raise ValueError(f"one of {', '.join(MODELS)} expected, got '{model}'")
    if a.shape != b.shape or a.ndim != 3 or a.shape[1] < MINIMAL[model]:
        raise ValueError(
            f"two equal (M, at least {MINIMAL[model]}, 2) expected, got {a.shape} and {b.shape}"
        )
    w = np.ones(a.shape[:2]) if weights is None else weights
    if model == "homography":
        return homographies(a, b, w)
    w = w / w.sum(1, keepdims=True)
    centre_a, centre_b = (w[..., None] * a).sum(1), (w[..., None] * b).sum(1)
    linear = _LINEAR[model](a - centre_a[:, None], b - centre_b[:, None], w)
    H = np.zeros((len(a), 3, 3))
    H[:, :2, :2] = linear
    H[:, :2, 2] = centre_b - (linear @ centre_a[..., None])[..., 0]
    H[:, 2, 2] = 1
    H[~np.isfinite(linear).all((1, 2))] = np.nan
    return H


def _identity(a: Doubles, b: Doubles, w: Doubles) -> Doubles:
    return np.broadcast_to(np.eye(2), (len(a), 2, 2))


def _similarity(a: Doubles, b: Doubles, w: Doubles) -> Doubles:
    """(M, 2, 2) rotation times scale about the centroids, in closed form: sum conj(a) b / sum
    |a|^2.
    """
    za, zb = a[..., 0] + 1j * a[..., 1], b[..., 0] + 1j * b[..., 1]
    spread = (w * np.abs(za) ** 2).sum(1)
    with np.errstate(all="ignore"):
        s = np.where(spread > 0, (w * np.conj(za) * zb).sum(1) / spread, np.nan)
    s = np.where(np.abs(s) > _FLAT, s, np.nan)  # all points of a fall on one point of b
    return np.stack([s.real, -s.imag, s.imag, s.real], -1).reshape(-1, 2, 2)


def _affine(a: Doubles, b: Doubles, w: Doubles) -> Doubles:
    """(M, 2, 2) linear part about the centroids, from the normal equations."""
    aw = w[..., None] * a
    aa, ba = np.swapaxes(aw, 1, 2) @ a, np.swapaxes(b, 1, 2) @ aw
    determinant = aa[:, 0, 0] * aa[:, 1, 1] - aa[:, 0, 1] ** 2
    flat = determinant <= _FLAT * (aa[:, 0, 0] + aa[:, 1, 1]) ** 2
    turned = np.stack([aa[:, 1, 1], -aa[:, 0, 1], -aa[:, 1, 0], aa[:, 0, 0]], -1).reshape(-1, 2, 2)
    with np.errstate(all="ignore"):
        linear = ba @ turned / determinant[:, None, None]
    linear[flat] = np.nan
    size = np.abs(linear).max((1, 2))
    linear[~(np.abs(_det2(linear)) > _FLAT * size**2)] = np.nan
    return linear


def _det2(m: Doubles) -> Doubles:
    return m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]


_LINEAR = {"translation": _identity, "similarity": _similarity, "affine": _affine}


def transfer(H: Doubles, xy: ArrayLike) -> Doubles:
    """Transforms points (N, 2) by H (..., 3, 3): (..., N, 2). A point on the horizon goes to
    infinity.
    """
    xy = np.asarray(xy, np.float64)
    p = xy @ np.swapaxes(H[..., :2], -1, -2) + H[..., None, :, 2]
    with np.errstate(all="ignore"):
        return np.asarray(p[..., :2] / p[..., 2:])


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def inverse(H: Doubles) -> Doubles:
    """Inverses of (..., 3, 3), in closed form; not finite where there is none. The last element is
    not scaled to 1.
    """
    # the cross products of its rows; NumPy's own function takes five times as long for few matrices
    a, b = H[..., _NEXT, :], H[..., _LAST, :]
    rows = a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]
    with np.errstate(all="ignore"):
        return np.asarray(
            np.swapaxes(rows, -1, -2) / (H[..., 0, :] * rows[..., 0, :]).sum(-1)[..., None, None]
        )


def symmetric_transfer_errors(H: Doubles, a: ArrayLike, b: ArrayLike) -> Doubles:
    """(..., N) px^2: d(a, H^-1 b)^2 + d(b, H a)^2 of b_H_a (..., 3, 3) and points (N, 2) [A (8)].

    Infinite where a matrix is NaN or singular, or a point lies on the horizon.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    with np.errstate(all="ignore"):
        there, back = transfer(H, a) - b, transfer(inverse(H), b) - a
        errors = np.einsum("...i,...i", there, there) + np.einsum("...i,...i", back, back)
    return np.where(np.isfinite(errors), errors, np.inf)


_SINGULAR = 1e-7
"""For normalised coordinates: if a determinant or a gap between singular values is below this, the
points do not determine the model.
"""


def normalisation(points: Doubles, weights: Doubles) -> Doubles:
    """(M, 3, 3) that move points (M, N, 2) to their weighted centroid and scale them to a mean
    square distance of 2.

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
    """Exact solution from the projective bases of four points; many times faster than the SVD with
    the same result.
    """
    basis_a, basis_b = _basis(a), _basis(b)
    cross = [np.cross(basis_a[:, :, i], basis_a[:, :, j]) for i, j in ((1, 2), (2, 0), (0, 1))]
    return np.asarray(basis_b @ np.stack(cross, 1))  # the inverse of basis_a, up to a factor


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
