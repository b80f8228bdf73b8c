"""Control points are observations in the adjustment and tie the block to the ground. Check points
are not adjusted; they measure its accuracy.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from skyquilt.alignment.adjust import Covariance, adjust
from skyquilt.alignment.deviations import point_deviations
from skyquilt.alignment.heights import control_height
from skyquilt.alignment.problem import Problem, State, residuals_px
from skyquilt.alignment.setup import Setup
from skyquilt.alignment.triangulate import polish, triangulated
from skyquilt.errors import AlignmentError
from skyquilt.model.photo import ControlPoint, Photo
from skyquilt.model.poses import ControlResidual, MapFrame

Array = NDArray[np.float64]


MARKED_PX = 0.5
"""Deviation in px of a point that was marked in a photo."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Control:
    """A control or check point in the map frame."""

    name: str
    """Label."""
    check: bool
    """True: kept out of the adjustment."""
    xyz: Array
    """(3,) in m, z NaN where unknown."""
    sigma_m: float
    """Deviation of each coordinate in m."""
    photo: NDArray[np.int64]
    """(k,) photos in which it is visible."""
    px: Array
    """(k, 2) image coordinates in file pixels."""


def control_in_frame(
    points: Sequence[ControlPoint], photos: Sequence[Photo], frame: MapFrame
) -> tuple[Control, ...]:
    """Control points in map coordinates; observations in unknown photos and points without
    observations are left out.
    """
    index = {p.name: i for i, p in enumerate(photos)} | {
        p.path.name: i for i, p in enumerate(photos)
    }
    found = []
    for point in points:
        seen = [(index[o.photo], o.x, o.y) for o in point.observations if o.photo in index]
        if not seen or frame.crs is None:
            continue
        x, y = Transformer.from_crs(point.crs, frame.crs, always_xy=True).transform(
            point.x, point.y
        )
        at = Transformer.from_crs(frame.crs, 4326, always_xy=True).transform(x, y)
        z = control_height(point, frame.control_datum, *at)
        xyz = np.array([x - frame.origin[0], y - frame.origin[1], z])
        photo, px = np.array([s[0] for s in seen]), np.array([s[1:] for s in seen], float)
        found.append(
            Control(
                name=point.name,
                check=point.check,
                xyz=xyz,
                sigma_m=point.sigma_m,
                photo=photo,
                px=px,
            )
        )
    return tuple(found)


def placed_in(control: Control, setup: Setup) -> tuple[NDArray[np.int64], Array]:
    """Rows and sensor pixels of the observations in placed photos."""
    mine = np.isin(control.photo, setup.members)
    photo = control.photo[mine]
    return np.searchsorted(setup.members, photo), setup.file_px(photo, control.px[mine])


def _observations(
    control: Sequence[Control], setup: Setup
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Point numbers, rows and sensor pixels of all observations."""
    parts = [placed_in(c, setup) for c in control]
    point = np.repeat(np.arange(len(parts)), [len(row) for row, _ in parts])
    row = np.concatenate([row for row, _ in parts] or [np.zeros(0, int)])
    return point, row, np.concatenate([px for _, px in parts] or [np.zeros((0, 2))])


def _alone(
    control: Sequence[Control], setup: Setup, problem: Problem, state: State
) -> tuple[Problem, State]:
    """A problem with the control points alone, intersected from their rays with the current
    poses.
    """
    point, row, px = _observations(control, setup)
    empty = np.full((len(control), 3), np.nan)
    own_problem = replace(
        problem,
        point=point,
        photo=row,
        px=px,
        sigma_px=np.ones(len(px)),
        shared=1.0,
        relative=1.0,
        X0=empty,
        sigma_X=np.ones_like(empty),
    )
    return own_problem, polish(own_problem, triangulated(own_problem, state))[0]


def intersected(
    control: Sequence[Control], setup: Setup, problem: Problem, state: State
) -> tuple[Array, Array]:
    """The points intersected with the current poses, (k, 3) in m, and the RMS reprojection error of
    each in px.
    """
    own, solved = _alone(control, setup, problem, state)
    error = (residuals_px(own, solved) ** 2).sum(1)
    count = np.maximum(np.bincount(own.point, minlength=len(control)), 1)
    return solved.X, np.sqrt(np.bincount(own.point, error, len(control)) / count)


def fit_similarity_3d(x: Array, y: Array) -> tuple[float, Array, Array]:
    """s, R, t that minimise |y - (s R x + t)|^2 (Umeyama 1991); points (k, 3), k >= 3, not on a
    line.
    """
    xm, ym = x.mean(0), y.mean(0)
    U, D, Vt = np.linalg.svd((y - ym).T @ (x - xm))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ np.diag(sign) @ Vt
    s = float((D * sign).sum() / ((x - xm) ** 2).sum())
    return s, R, ym - s * R @ xm


def _moved(problem: Problem, state: State, s: float, R: Array, t: Array) -> tuple[Problem, State]:
    """State and positions under y = s R x + t."""
    moved = replace(state, R=state.R @ R.T, C=s * state.C @ R.T + t, X=s * state.X @ R.T + t)
    there = replace(
        problem,
        C0=s * problem.C0 @ R.T + t,
        sigma_C=problem.sigma_C * s,
        R0=problem.R0 @ R.T,
        velocity=s * problem.velocity @ R.T,
    )
    return there, moved


def hold_to_control(
    problem: Problem, state: State, frame: MapFrame, setup: Setup, control: Sequence[Control]
) -> tuple[Problem, State, MapFrame, Sequence[Control]]:
    """Repeats the adjustment with control points as observations.

    GPS positions share an offset (height datum, base station), which is one of the unknowns.

    Raises:
        AlignmentError: no position and fewer than three usable control points.
    """
    usable = [c for c in control if len(placed_in(c, setup)[0]) >= 2]
    fit = [c for c in usable if not c.check]
    if not setup.georeferenced and frame.crs is not None and len(fit) < 3:
        raise AlignmentError(
            "photos without positions need 3 control points seen in 2 placed photos each,"
            f" the file gives {len(fit)}"
        )
    if not fit:
        return problem, state, frame, usable
    surveyed = np.array([c.xyz for c in fit])
    seen, _ = intersected(fit, setup, problem, state)
    if not setup.georeferenced:
        level = np.nan_to_num(
            surveyed,
            nan=float(np.nanmean(surveyed[:, 2])) if np.isfinite(surveyed).all(1).any() else 0.0,
        )
        problem, state = _moved(problem, state, *fit_similarity_3d(seen, level))
    else:
        known = (d[np.isfinite(d)] for d in (surveyed - seen).T)
        shift = np.array([np.median(d) if len(d) else 0.0 for d in known])
        problem, state = _moved(problem, state, 1.0, np.eye(3), shift)
    problem, state = with_points(problem, state, setup, fit)
    if not setup.georeferenced:
        problem = replace(problem, sigma_C=np.full_like(problem.sigma_C, 1e4))
    problem = replace(problem, offset=setup.georeferenced)
    state = adjust(problem, state, iterations=40, tolerance=1e-5).state
    heights = np.isfinite(surveyed[:, 2]).any()
    return (
        problem,
        state,
        replace(frame, vertical_datum=frame.control_datum, metric=True) if heights else frame,
        usable,
    )


def with_points(
    problem: Problem, state: State, setup: Setup, fit: Sequence[Control]
) -> tuple[Problem, State]:
    """The problem with tie points and control points."""
    point, row, px = _observations(fit, setup)
    P = len(state.X)
    surveyed = np.array([c.xyz for c in fit])
    X, _ = intersected(fit, setup, problem, state)
    joined = replace(
        problem,
        point=np.concatenate([problem.point, P + point]),
        photo=np.concatenate([problem.photo, row]),
        px=np.concatenate([problem.px, px]),
        sigma_px=np.concatenate([problem.sigma_px, np.full(len(px), MARKED_PX)]),
        relative=np.concatenate(
            [np.broadcast_to(problem.relative, len(problem.px)), np.ones(len(px))]
        ),
        shared=np.concatenate([np.broadcast_to(problem.shared, len(problem.px)), np.ones(len(px))]),
        # what was marked in photos by hand errs independently of the tie points
        trust=np.concatenate([np.broadcast_to(problem.trust, len(problem.px)), np.ones(len(px))]),
        X0=np.concatenate([problem.X0, surveyed]),
        sigma_X=np.concatenate([problem.sigma_X, np.array([[c.sigma_m] * 3 for c in fit])]),
    )
    return joined, replace(state, X=np.concatenate([state.X, X]))


def residuals_of_control(
    control: Sequence[Control],
    frame: MapFrame,
    setup: Setup,
    problem: Problem,
    state: State,
    covariance: Covariance | None = None,
) -> tuple[ControlResidual, ...]:
    """Errors of all control and check points at the solution, intersected from the final poses
    alone.
    """
    if not control or frame.crs is None:
        return ()
    X, rms = intersected(control, setup, problem, state)
    sigma = np.full(X.shape, np.nan)
    if covariance is not None:
        own, solved = _alone(control, setup, problem, state)
        own = replace(own, sigma_px=np.full(len(own.px), MARKED_PX))
        seen = np.flatnonzero(np.bincount(own.point, minlength=len(X)) >= 2)
        sigma[seen] = point_deviations(own, solved, covariance, seen)
        sigma = np.hypot(sigma, [[c.sigma_m] for c in control])
    return tuple(
        ControlResidual(
            name=c.name,
            check=c.check,
            error_m=x - c.xyz,
            reprojection_px=float(r),
            observations=len(placed_in(c, setup)[0]),
            sigma_m=None if np.isnan(s).any() else s,
        )
        for c, x, r, s in zip(control, X, rms, sigma, strict=True)
    )
