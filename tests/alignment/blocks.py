"""Simulated blocks: cameras over rolling ground, their observations with noise and lies, and priors
that err.
"""

from dataclasses import dataclass, replace

import numpy as np

from skyquilt.alignment.problem import CAMERA, Problem, State
from skyquilt.alignment.setup import FISHEYE
from skyquilt.geometry.frames import cam_R_map_from_angles, rotation_from_vector

WIDTH, HEIGHT, FOCAL, FLYING = 800, 600, 700.0, 60.0
LENS = np.array([FOCAL, 402.0, 297.0, -0.06, 0.03, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
FREE = np.array([1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0], bool)
SIGMA_K = np.array([10.0, 3.0, 3.0, 0.02, 0.02, 0.01, 1e-3, 1e-3, 3e-3, 1.0, 1e-3])


@dataclass(frozen=True, kw_only=True)
class Block:
    """What an adjustment is given, and what it should find."""

    problem: Problem
    start: State
    truth: State
    wrong: np.ndarray
    """(N,) observations that are lies."""


def seen_by(R, C, K, X):
    """Pixels (n, 2) of points by the textbook formula, apart from the project's own; NaN for those
    behind, and beyond 45 degrees, where the polynomial folds back into the picture.
    """
    local = (X - C) @ R.T
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    r2 = x * x + y * y
    f, cx, cy, k1, k2, k3, p1, p2, aspect = K[:9]
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.where(
        (local[:, 2:] > 1) & (r2[:, None] < 1),
        np.stack([f * xd + cx, f * aspect * yd + cy], 1),
        np.nan,
    )


def ground(xy):
    """Heights (n,) of rolling country, +-4 m."""
    return 3 * np.sin(xy[:, 0] / 17) + np.cos(xy[:, 1] / 11)


def make_block(
    seed=0,
    *,
    lines=3,
    per_line=6,
    points=300,
    noise=0.3,
    lies=0.0,
    gps=1.5,
    tilt_deg=1.0,
    yaw_deg=3.0,
    overlap=0.75,
    sidelap=0.55,
    lens=LENS,
    free=FREE,
    sigma_k=SIGMA_K,
    lens_errs=True,
    loss_px=2.0,
    loss_prior=1e6,
    true_tilt_deg=1.5,
    cameras=1,
    heights=(FLYING,),
):
    """A block of serpentine lines; priors are the truth plus noise of their stated deviations."""
    rng = np.random.default_rng(seed)
    along, across = HEIGHT / FOCAL * FLYING * (1 - overlap), WIDTH / FOCAL * FLYING * (1 - sidelap)
    n = lines * per_line
    column, row = np.divmod(np.arange(n), per_line)
    row = np.where(column % 2 == 1, per_line - 1 - row, row)
    flying = np.array(heights)[column % len(heights)]
    C = np.column_stack([column * across, row * along, flying]) + rng.normal(0, 0.5, (n, 3))
    yaw = np.where(column % 2 == 1, 180.0, 0.0) + rng.normal(0, 2, n)
    tilts = rng.normal(0, true_tilt_deg, (n, 2))
    R = np.array([cam_R_map_from_angles(y, *t) for y, t in zip(yaw, tilts, strict=True)])
    low, high = C[:, :2].min(0) - 30, C[:, :2].max(0) + 30
    X = rng.uniform(low, high, (points, 2))
    X = np.column_stack([X, ground(X)])
    camera = np.arange(n) % cameras
    K0 = np.tile(lens, (cameras, 1))
    K = K0.copy()
    if lens_errs:
        drawn = rng.normal(0, 1, (len(K0), CAMERA - 1))
        K += np.insert(drawn, FISHEYE, 0.0, axis=1) * sigma_k * free
    parts = []
    for i in range(n):
        px = seen_by(R[i], C[i], K[camera[i]], X)
        inside = (px > 2).all(1) & (px[:, 0] < WIDTH - 3) & (px[:, 1] < HEIGHT - 3)
        k = np.flatnonzero(inside)
        parts.append((k, np.full(len(k), i), px[k]))
    point, photo, px = (np.concatenate([p[j] for p in parts]) for j in range(3))
    keep = np.bincount(point, minlength=points)[point] >= 2
    order = np.lexsort((photo[keep], point[keep]))
    point, photo, px = point[keep][order], photo[keep][order], px[keep][order]
    used, point = np.unique(point, return_inverse=True)
    X = X[used]
    px = px + rng.normal(0, noise, px.shape)
    wrong = rng.random(len(px)) < lies
    px[wrong] += rng.uniform(-60, 60, (wrong.sum(), 2))
    sigma_C = np.tile([gps, gps, 2 * gps], (n, 1))
    sigma_R = np.tile(np.radians([tilt_deg, tilt_deg, yaw_deg]), (n, 1))
    C0 = C + rng.normal(0, 1, C.shape) * sigma_C
    R0 = rotation_from_vector(rng.normal(0, 1, (n, 3)) * sigma_R) @ R
    problem = Problem(
        point=point.astype(np.int64),
        photo=photo.astype(np.int64),
        px=px,
        sigma_px=np.full(len(px), noise or 0.3),
        camera=camera,
        free=np.tile(free, (cameras, 1)),
        K0=K0,
        sigma_K=np.tile(sigma_k, (cameras, 1)),
        C0=C0,
        sigma_C=sigma_C,
        R0=R0,
        sigma_R=sigma_R,
        last_row=np.full(n, HEIGHT - 1.0),
        velocity=np.zeros((n, 3)),
        X0=np.full(X.shape, np.nan),
        sigma_X=np.ones(X.shape),
        loss_px=loss_px,
        loss_C=loss_prior,
        loss_R=loss_prior,
    )
    still = np.zeros((n, 3))
    start = State(R=R0, C=C0, K=K0.copy(), X=X + rng.normal(0, 2, X.shape), turn=still)
    truth = State(R=R, C=C, K=K, X=X, turn=still)
    return Block(problem=problem, start=start, truth=truth, wrong=wrong)


def least_squares_only(problem):
    """The problem with plain squares everywhere."""
    return replace(problem, loss_px=1e6, loss_C=1e6, loss_R=1e6)


def dense_matrix(matrix):
    """All rows and columns of a matrix of blocks."""
    pat = matrix.pattern
    p, photos = pat.size, pat.count * pat.size
    out = np.zeros((photos + pat.border,) * 2)
    for a, b, block in zip(pat.first, pat.second, matrix.blocks, strict=True):
        out[b * p : b * p + p, a * p : a * p + p] = block.T
        out[a * p : a * p + p, b * p : b * p + p] = block
    beside = matrix.beside.reshape(photos, -1)
    out[:photos, photos:], out[photos:, :photos], out[photos:, photos:] = (
        beside,
        beside.T,
        matrix.corner,
    )
    return out


def dense_covariance(found):
    """(6n + 10m) square, in the order of the system; zero where all intrinsics are fixed."""
    out = found.factor.solve(np.eye(found.factor.total))
    border = found.inverse.pattern.border
    return np.pad(out, (0, 0 if border else len(found.cameras)))
