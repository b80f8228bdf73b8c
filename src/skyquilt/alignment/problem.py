"""A bundle adjustment problem: unknowns, observations, and priors with their deviations."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import pixels, project_with_derivatives
from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.model.camera import PARAMETERS

Array = NDArray[np.float64]
Index = NDArray[Any]
READOUT = len(PARAMETERS)
"""Column of a camera's readout time in s, after the intrinsics."""
CAMERA = READOUT + 1
"""Unknowns of a camera."""
PART = 8192
"""Observations that are computed at once, about: what a computation holds then stays small, however
large the survey.
"""


def _of_points(values: Array, some: Index | slice) -> Array:
    """What belongs to some points (P, 3); what is the same for all stays one row."""
    if len(values) and values.strides[0] == 0:
        number = len(range(len(values))[some]) if isinstance(some, slice) else len(some)
        return np.broadcast_to(values[0], (number, values.shape[1]))
    return values[some]


def of_some(values: Array | float, some: NDArray[np.bool_] | Index | slice) -> Array | float:
    """What belongs to some observations, of a value for all or of one for each."""
    return values[some] if isinstance(values, np.ndarray) else values


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """The unknowns: n photos, m cameras, P points."""

    R: Array
    """(n, 3, 3) map to camera."""
    C: Array
    """(n, 3) centres in m."""
    K: Array
    """(m, 11) intrinsics in the order of `model.camera.PARAMETERS`, then the readout time in s."""
    X: Array
    """(P, 3) points in m."""
    turn: Array
    """(n, 3) rotation of each camera while it is read out, first row to last, in rad about the
    camera's axes; zero where the rows are exposed at once.
    """

    def moved(self, photo_step: Array, camera_step: Array, point_step: Array) -> "State":
        """The state after a step of the solver: photos (n, 6) = rotation vector then centre, or
        (n, 9) with the turn, cameras (m, 11), points (P, 3).
        """
        turns = photo_step.shape[1] == 9
        return State(
            R=rotation_from_vector(photo_step[:, :3]) @ self.R,
            C=self.C + photo_step[:, 3:6],
            K=self.K + camera_step,
            X=self.X + point_step,
            turn=self.turn + photo_step[:, 6:] if turns else self.turn,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class InCommon:
    """What intrinsics of several cameras have in common: linear combinations that are zero."""

    rows: Array
    """(r, 11 m) factors of the intrinsics of all cameras, one after the other, over the deviation
    of their sum.
    """
    zero: Array
    """(r,) what the sums are expected to be, over that deviation."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Observations and priors. Observations are sorted by point. Of large surveys they fill the
    memory: their numbers are of 32 bits, and those of `parts` of 64.
    """

    point: Index
    """(N,) point of each observation, ascending."""
    photo: Index
    """(N,) photo of each observation."""
    px: Array
    """(N, 2) in px."""
    sigma_px: Array
    """(N,) standard deviation of each observation in px."""
    camera: Index
    """(n,) camera of each photo."""
    free: NDArray[np.bool_]
    """(m, 11) which intrinsics, and whether the readout time, are estimated."""
    K0: Array
    """(m, 11) prior of the intrinsics and the readout time."""
    sigma_K: Array
    """(m, 11) deviations of that prior."""
    common: InCommon | None = None
    """What cameras have in common that are one lens; None = each is its own."""
    C0: Array
    """(n, 3) measured centres; NaN where unknown."""
    sigma_C: Array
    """(n, 3) deviations."""
    R0: Array
    """(n, 3, 3) measured attitudes, map to camera."""
    sigma_R: Array
    """(n, 3) deviations in rad about the map's x, y, z axes; infinite where unknown. A compass
    errs about the vertical, and what tells the tilt errs about level axes, wherever a camera looks.
    """
    X0: Array
    """(P, 3) surveyed coordinates of control points; NaN for tie points and unknown axes."""
    sigma_X: Array
    """(P, 3) deviations of `X0`."""
    loss_px: float
    """Scale of the Cauchy loss on observations, in units of their deviation."""
    loss_C: float = 3.0
    """Scale of the pseudo-Huber loss on positions, in units of their deviation, since GPS positions
    may contain gross errors.
    """
    loss_R: float = 2.0
    """Scale of the pseudo-Huber loss on attitudes, since gimbal angles may contain gross errors."""
    design_effect: float = 1.0
    """How many observations tell as much as one with errors independent of all others."""
    trust: Array | float = 1.0
    """Factor on the cost of observations, of all or of each (N,): the reciprocal of their design
    effect and of their variance over the assumed one (`alignment.deviations`).
    """
    shared: Array | float = 1.0
    """What observations count for, of all or of each (N,), beside those of the same point by other
    photos of the same place (`alignment.same_place`).
    """
    relative: Array | float = 1.0
    """Deviation of all observations or of each (N,) over that of a usual one. What is too far off
    is judged by `sigma_px` alone; `alignment.stages.weighed` multiplies it in.
    """
    offset: bool = False
    """Whether all measured centres share an unknown shift (height datum, base station), as where
    control points tie the block to the ground. It is estimated along with the other unknowns.
    """
    last_row: Array
    """(n,) number of the last row of each photo."""
    velocity: Array
    """(n, 3) velocity of each camera in m/s in the map frame; zero where unknown."""
    sigma_turn: Array | None = None
    """(n,) deviations of `State.turn` from `turn0` in rad; None = turns are not estimated."""
    turn0: Array | None = None
    """(n, 3) what `State.turn` is expected to be in rad; None = zero."""

    @property
    def share(self) -> Array:
        """(N,) place of each observation's row in the photo, -0.5 at the first and 0.5 at the
        last.
        """
        return np.asarray(self.px[:, 1] / self.last_row[self.photo] - 0.5)

    @property
    def photo_unknowns(self) -> int:
        """Unknowns of a photo: 6, or 9 with its turn."""
        return 6 if self.sigma_turn is None else 9

    def with_loss(self, loss_px: float) -> "Problem":
        """The same problem with another scale of the loss on observations."""
        return replace(self, loss_px=loss_px)

    def at(self, observations: NDArray[np.bool_] | slice) -> "Problem":
        """The problem with some of its observations; points keep their numbers."""
        return replace(
            self,
            point=self.point[observations],
            photo=self.photo[observations],
            px=self.px[observations],
            sigma_px=self.sigma_px[observations],
            trust=of_some(self.trust, observations),
            shared=of_some(self.shared, observations),
            relative=of_some(self.relative, observations),
        )

    def only(self, observations: NDArray[np.bool_]) -> tuple["Problem", Index]:
        """The problem with some of its observations and with the points that these show,
        renumbered; and the numbers these points had.
        """
        thinner = self.at(observations)
        first = np.r_[True, thinner.point[1:] != thinner.point[:-1]][: len(thinner.point)]
        points = thinner.point[first]
        thinner = replace(
            thinner,
            point=np.cumsum(first, dtype=thinner.point.dtype) - 1,
            X0=_of_points(self.X0, points),
            sigma_X=_of_points(self.sigma_X, points),
        )
        return thinner, points

    def among(self, photos: Index, state: State) -> tuple["Problem", State]:
        """The problem of some of its photos, renumbered, with the points that two of them show; and
        its state.
        """
        number = np.full(len(self.camera), -1, self.photo.dtype)
        number[photos] = np.arange(len(photos))
        inside = number[self.photo] >= 0
        seen = np.bincount(self.point[inside], minlength=len(self.X0))
        part, points = self.only(inside & (seen >= 2)[self.point])
        problem = replace(
            part,
            photo=number[part.photo],
            camera=self.camera[photos],
            last_row=self.last_row[photos],
            C0=self.C0[photos],
            sigma_C=self.sigma_C[photos],
            R0=self.R0[photos],
            sigma_R=self.sigma_R[photos],
            velocity=self.velocity[photos],
            sigma_turn=None if self.sigma_turn is None else self.sigma_turn[photos],
            turn0=None if self.turn0 is None else self.turn0[photos],
        )
        R, C, turn = state.R[photos], state.C[photos], state.turn[photos]
        return problem, State(R=R, C=C, K=state.K, X=state.X[points], turn=turn)

    def cuts(self, about: int) -> list[int]:
        """Borders of ranges of about so many observations, each of whole points."""
        if len(self.point) <= about:
            return [0, len(self.point)]
        wanted = self.point[about::about]
        inner = np.unique(np.searchsorted(self.point, wanted))
        return [0, *inner[inner > 0].tolist(), len(self.point)]

    def pieces(self) -> list[tuple[int, int]]:
        """First observation, and that after the last, of each part."""
        return [(lo, hi) for lo, hi in pairwise(self.cuts(PART)) if lo < hi]

    def points_of(self, piece: tuple[int, int]) -> slice:
        """The points of a part."""
        return slice(int(self.point[piece[0]]), int(self.point[piece[1] - 1]) + 1)

    def part(self, piece: tuple[int, int]) -> "Problem":
        """A part of the problem, its points renumbered."""
        points, some = self.points_of(piece), self.at(slice(*piece))
        return replace(
            some,
            point=some.point.astype(np.int64) - points.start,
            photo=some.photo.astype(np.int64),
            X0=_of_points(self.X0, points),
            sigma_X=_of_points(self.sigma_X, points),
        )

    def parts(self, state: "State") -> Iterator[tuple["Problem", "State", slice]]:
        """The problem in parts of whole points, with the state of those points and which they
        are.
        """
        for piece in self.pieces():
            points = self.points_of(piece)
            yield self.part(piece), replace(state, X=state.X[points]), points


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearised:
    """Whitened residuals and Jacobians of the observations."""

    residual: Array
    """(N, 2) in units of the standard deviation."""
    J_photo: Array
    """(N, 2, 6), or (N, 2, 9) where turns are estimated."""
    J_camera: Array
    """(N, 2, 11), fixed intrinsics zeroed; (N, 2, 0) where all are fixed."""
    J_point: Array
    """(N, 2, 3)."""
    behind: NDArray[np.bool_]
    """(N,) observations whose point lies behind its camera: ignored."""


class _Seen(NamedTuple):
    """Points of N observations in the coordinates of their cameras."""

    local: Array
    """(N, 3) as the camera stood when their row was exposed."""
    middle: Array
    """(N, 3) the same for the middle row."""
    share: Array
    """(N,) place of their row in the photo, -0.5 at the first and 0.5 at the last."""
    pace: Array | None
    """(N, 3) how far they move from the first row to the last; None where nothing moves."""
    behind: NDArray[np.bool_]
    """(N,) which points lie behind."""
    k: Array
    """(N, 10) intrinsics of their cameras."""


def _seen(problem: Problem, state: State) -> _Seen:
    """Points of all observations in coordinates of their cameras.

    A row is exposed from its own place: local(s) = L + s (turn x L - R velocity readout), where L
    belongs to the middle row and s is the row's share of the photo. Linear in s: turns are some
    hundredths of a radian at most.

    The row is the one in which the point is seen, found from the observed one in one step. An
    observation's error moves the observed row, too: residuals from there would shrink with the
    readout, and the one that makes them smallest would be too long.
    """
    photo = problem.photo
    middle = np.einsum("nij,nj->ni", state.R[photo], state.X[problem.point] - state.C[photo])
    pace = None
    if (state.K[:, READOUT] != 0).any() and problem.velocity.any():
        pace = -swept(problem, state)[photo]
    if state.turn.any():
        turned = np.cross(state.turn[photo], middle)
        pace = turned if pace is None else pace + turned
    share, local, k = problem.share, middle.copy(), state.K[problem.camera[photo], :READOUT]
    if pace is not None:
        local += share[:, None] * pace
        behind = local[:, 2] < 1e-6
        ahead = np.where(behind[:, None], (0.0, 0.0, 1.0), local)
        off = pixels(ahead[:, :2] / ahead[:, 2:], k)[:, 1] - problem.px[:, 1]
        share = share + np.where(behind, 0.0, off / problem.last_row[photo])
        local = middle + share[:, None] * pace
    behind = local[:, 2] < 1e-6
    local[behind] = middle[behind] = (0.0, 0.0, 1.0)
    return _Seen(local, middle, share, pace, behind, k)


def _with_row(problem: Problem, seen: _Seen, *values: Array) -> Iterator[Array]:
    """Derivatives (N, 2, k), first those by the point, that take into account that the row moves as
    well.
    """
    if seen.pace is None:
        yield from values
        return
    per_row = (values[0] @ seen.pace[..., None]) / problem.last_row[problem.photo, None, None]
    for value in values:
        yield value + per_row * value[:, 1:2]


def swept(problem: Problem, state: State) -> Array:
    """How far each camera moves while it is read out: (n, 3) in m in the camera's axes."""
    moved = problem.velocity * state.K[problem.camera, READOUT, None]
    return np.asarray(np.einsum("nij,nj->ni", state.R, moved))


def linearise(problem: Problem, state: State) -> Linearised:
    """Residuals and Jacobians at a state."""
    seen, some = _seen(problem, state), bool(problem.free.any())
    local = seen.local
    p = project_with_derivatives(seen.k, local, intrinsics=some)
    d_point, d_intrinsics = _with_row(problem, seen, p.d_point, p.d_intrinsics)
    w = (~seen.behind / problem.sigma_px)[:, None]
    d_point = d_point * w[..., None]
    J_photo = np.empty((len(local), 2, problem.photo_unknowns))
    J_photo[:, :, :3] = np.cross(local[:, None, :], d_point)  # d . (w x local) = (local x d) . w
    J_point = d_point @ state.R[problem.photo]
    J_photo[:, :, 3:6] = -J_point
    if problem.sigma_turn is not None:
        turned = np.cross(seen.middle[:, None, :], d_point)
        J_photo[:, :, 6:] = seen.share[:, None, None] * turned
    J_camera = d_intrinsics
    if some:
        pace = np.einsum("nki,ni->nk", J_point, problem.velocity[problem.photo])
        J_camera = np.concatenate(
            [d_intrinsics * w[..., None], -(seen.share[:, None] * pace)[..., None]], 2
        )
        J_camera *= problem.free[problem.camera[problem.photo]][:, None, :]
    return Linearised(
        residual=(p.px - problem.px) * w,
        J_photo=J_photo,
        J_camera=J_camera,
        J_point=J_point,
        behind=seen.behind,
    )


def linearised_points(problem: Problem, state: State) -> tuple[Array, Array]:
    """`residual` (N, 2) and `J_point` (N, 2, 3) of `linearise` alone."""
    seen = _seen(problem, state)
    p = project_with_derivatives(seen.k, seen.local, intrinsics=False)
    (d_point,) = _with_row(problem, seen, p.d_point)
    w = (~seen.behind / problem.sigma_px)[:, None]
    return (p.px - problem.px) * w, (d_point * w[..., None]) @ state.R[problem.photo]


def residuals_px(problem: Problem, state: State) -> Array:
    """Image residuals (N, 2) in px, projected minus observed; NaN for points behind their
    camera.
    """
    out = np.empty((len(problem.px), 2))
    for some, residual in _residuals(problem, state):
        out[some] = residual
    return out


def squared_residuals(problem: Problem, state: State) -> Array:
    """Squared lengths (N,) of the residuals in units of the deviation of their observations; NaN
    for points behind their camera.
    """
    out = np.empty(len(problem.px))
    for some, residual in _residuals(problem, state):
        out[some] = ((residual / problem.sigma_px[some, None]) ** 2).sum(1)
    return out


def _residuals(problem: Problem, state: State) -> Iterator[tuple[slice, Array]]:
    """`residuals_px` of parts of the observations, and which they are."""
    for lo in range(0, len(problem.px), PART):
        some = slice(lo, lo + PART)
        part = problem.at(some)
        seen = _seen(part, state)
        px = pixels(seen.local[:, :2] / seen.local[:, 2:], seen.k)
        yield some, np.where(seen.behind[:, None], np.nan, px - part.px)


def attitude_error(R: Array, R0: Array) -> Array:
    """Rotation vectors (n, 3) in rad, in axes of the map, that take R0 to R (rotations from map to
    camera).
    """
    E = R @ np.swapaxes(R0, -1, -2)
    v = (
        np.stack([E[:, 2, 1] - E[:, 1, 2], E[:, 0, 2] - E[:, 2, 0], E[:, 1, 0] - E[:, 0, 1]], -1)
        / 2
    )
    sine = np.linalg.norm(v, axis=-1)
    angle = np.arctan2(sine, (np.trace(E, axis1=1, axis2=2) - 1) / 2)
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 1.0)
    return np.asarray((v * scale[:, None])[:, None] @ R0)[:, 0]
