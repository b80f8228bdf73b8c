"""Local adjustment: places a new photo by its links to placed photos and refines its neighbourhood.

The work is bounded whatever the size of the map (part D of the methods): a window with the new
photo, the photos linked to it, and a ring of other photos that are held fixed. Calibrations are not
changed; the adjustment of the whole block in the background does that.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.adjust import adjust
from skyquilt.alignment.determined import lies_elsewhere
from skyquilt.alignment.motion import velocities
from skyquilt.alignment.oblique import told_tilt
from skyquilt.alignment.problem import Problem, State, residuals_px
from skyquilt.alignment.setup import HALF_TURN, TURNED, Setup, pose_records, set_up
from skyquilt.alignment.similarity_graph import fit_similarity
from skyquilt.alignment.stages import prune
from skyquilt.alignment.start import Start
from skyquilt.alignment.tracks import Tracks, build_tracks, thin
from skyquilt.alignment.triangulate import STEADY_HIGH, polish, triangulated
from skyquilt.geometry.camera import rays
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Pose, Prior

HELD_M, HELD_RAD = 1e-3, 1e-5
"""Standard deviations of the poses of held photos."""
STAGES = ((2.0, 20.0, 40.0, 3e-2), (0.8, 6.0, 12.0, 1e-2), (0.0, 2.5, 5.0, 1e-2))
"""Rounds of an adjustment: the median residual in px of the new photo from which the round is
needed, width of the loss in px, residual in px above which observations are removed, and tolerance.
"""
STEEPNESS = 0.1
"""Rays flatter than this (the sine of their angle below the horizon) are taken for as steep."""
UNEVEN = 0.02
"""Deviation of what links show from level ground, as a share of the flying height."""
MOST_WEIGHT = 300.0
"""Matches of a link beyond so many do not make it count more."""


Array = NDArray[np.float64]
Similarity = tuple[complex, complex]


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """A new photo and its neighbourhood, by position in these lists."""

    photos: Sequence[Photo]
    """The photos; the new one is `new`."""
    priors: Sequence[Prior]
    """Priors from their metadata."""
    features: Sequence[Features]
    """Their keypoints."""
    links: Sequence[Link]
    """Links between them."""
    poses: Mapping[int, Pose]
    """Poses of the placed photos."""
    cameras: Mapping[str, Camera]
    """Calibrations known so far, by name."""
    camera_of: Mapping[int, str]
    """Name of the calibration of each placed photo."""
    new: int
    """The photo to place; if it is already placed, the window is only refined."""
    held: frozenset[int]
    """Placed photos that must not move."""
    ground: float
    """Height of the surrounding ground in m."""
    sigma_xy: float
    """Standard deviation of positions in m as estimated by the map, where larger than stated."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AdjustedWindow:
    """A window after its adjustment."""

    poses: dict[int, Pose]
    """New poses of the new photo and of those that were free to move."""
    camera: str
    """Name of the new photo's calibration."""
    observations: int
    """Number of observations of the new photo."""
    xyz: NDArray[np.float64]
    """(P, 3) ground points in m whose heights are told."""
    dropped: tuple[tuple[int, int], ...]
    """Links (a, b) that contradict the others."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NotAdjusted:
    """Why the links do not determine a photo's pose. Its truth value is False."""

    reason: str
    """The reason as a phrase."""

    def __bool__(self) -> bool:
        return False


@dataclass(frozen=True, kw_only=True)
class LocalAdjustment:
    """A similarity from the links, of the photo levelled by the tilt that it reports, followed by a
    bundle adjustment of the window.
    """

    per_photo: int = 120
    """Observations per photo in the adjustment."""
    least: int = 12
    """Fewest observations that determine a photo."""
    disagree: float = 0.12
    """Links that put a photo further apart than this share of the flying height contradict each
    other.
    """
    version: ClassVar[int] = 5

    def __call__(self, window: Window) -> AdjustedWindow | NotAdjusted:
        """Places the new photo and refines the free ones."""
        plane = {i: similarity_of(window, i) for i in window.poses}
        dropped: tuple[tuple[int, int], ...] = ()
        if window.new not in window.poses:
            guess = _guess(window, self.disagree)
            if guess is None:
                return NotAdjusted(reason="its links contradict each other")
            plane[window.new], agreeing = guess
            own = [(k.a, k.b) for k in window.links if window.new in (k.a, k.b)]
            dropped = tuple(key for key in own if key not in agreeing)
        links = [k for k in window.links if (k.a, k.b) not in dropped]
        setup = without_false_positions(held_setup(window, plane, links), window)
        tracks = useful(setup.sensor_tracks(build_tracks(window.features, links)), window)
        sizes = [(p.width, p.height) for p in window.photos]
        problem, state = setup.problem(thin(tracks, sizes, per_photo=self.per_photo))
        if not len(problem.px):
            return NotAdjusted(reason="no observations are left")
        row = int(np.searchsorted(setup.members, window.new))
        problem, state = _adjusted(problem, triangulated(problem, state), row)
        observations = int((problem.photo == row).sum())
        if observations < self.least:
            return NotAdjusted(reason=f"it has only {observations} tie points")
        moved = {i: p for i, p in pose_records(setup, state).items() if i not in window.held}
        key = window.photos[window.new].camera_key
        return AdjustedWindow(
            poses=moved,
            camera=key + TURNED if setup.turned[window.new] else key,
            observations=observations,
            xyz=steady(problem, state),
            dropped=dropped,
        )


def steady(problem: Problem, state: State) -> Array:
    """The points (P, 3) whose rays tell their height; of what only photos of one place show (a
    hover, a bracket, copies), rays meet anywhere.
    """
    _, sigma_z = polish(problem, state, iterations=1)
    high = abs(float(np.median(state.C[:, 2]) - np.median(state.X[:, 2])))
    return np.asarray(state.X[sigma_z < STEADY_HIGH * high])


def without_false_positions(setup: Setup, window: Window) -> Setup:
    """The setup without reported positions of photos that start elsewhere, by their links or by
    their former pose, beside what those of held photos are off that agree with theirs: one
    that is off by ten flying heights would bend all around it. Where all held ones are off alike,
    the map has drifted, not a receiver.
    """
    base = setup.base
    C0, start = base.C0.copy(), setup.start_C
    off = (start - C0)[:, :2]
    held = np.isin(setup.members, list(window.held))
    told = np.array([window.priors[m].map_C[:2] for m in setup.members.tolist()])
    high = np.abs(start[:, 2] - window.ground)
    sigma = np.maximum(base.sigma_C[:, 0], window.sigma_xy)
    known = held & np.isfinite(told).all(1)
    common = start[:, :2] - told
    right = known & ~lies_elsewhere(np.linalg.norm(common, axis=1), np.array(window.sigma_xy), high)
    common = common[right if right.any() else known]
    away = np.linalg.norm(off - (np.median(common, axis=0) if len(common) else 0.0), axis=1)
    C0[lies_elsewhere(away, sigma, high) & ~held, :2] = np.nan
    return replace(setup, base=replace(base, C0=C0))


def useful(tracks: Tracks, window: Window) -> Tracks:
    """Tracks with an observation in a photo that may move; tracks in held photos only have no
    effect.
    """
    free = np.array([i not in window.held for i in range(len(window.photos))])
    seen = np.bincount(tracks.point, weights=free[tracks.photo], minlength=tracks.count) > 0
    return tracks.only(seen[tracks.point])


def _adjusted(problem: Problem, state: State, new: int) -> tuple[Problem, State]:
    """Adjusts with ever narrower losses and removes outliers in between. The wide losses are used
    only if the new photo (row `new`) starts far off.
    """
    off = np.hypot(*residuals_px(problem, state)[problem.photo == new].T)
    start = float(np.nanmedian(off)) if np.isfinite(off).any() else np.inf
    for beyond, loss, limit, tolerance in STAGES:
        if not start < beyond:
            state = adjust(
                problem.with_loss(loss), state, iterations=8, tolerance=tolerance, damping=1e-5
            ).state
            problem, state = prune(problem, state, limit)
    return problem, adjust(
        problem.with_loss(2.0), state, iterations=6, tolerance=3e-3, damping=1e-6
    ).state


def similarity_of(window: Window, i: int) -> tuple[complex, complex]:
    """a and t of the similarity x + iy = a p + t that approximates a placed photo near its centre
    (see `similarity_graph`).
    """
    photo = window.photos[i]
    centre = np.array([[(photo.width - 1) / 2, (photo.height - 1) / 2]])
    step = np.array([[photo.focal.px / 4, 0.0]])
    z = _on_ground(window, i, np.concatenate([centre, centre + step, centre - step]))
    a = (z[1] - z[2]) / 0.5
    # for an ideal lens the centre has photo coordinates 0
    return complex(a), complex(z[0])


def _on_ground(window: Window, i: int, px: Array) -> NDArray[np.complex128]:
    """Where pixels (n, 2) of a placed photo show level ground, as x + iy in m."""
    pose = window.poses[i]
    camera = window.cameras.get(window.camera_of.get(i, "")) or window.photos[i].lens
    direction = rays(camera, px) @ pose.cam_R_map
    down = np.minimum(direction[:, 2], -STEEPNESS)
    reach = (window.ground - pose.map_C[2]) / down
    xy = pose.map_C[:2] + direction[:, :2] * reach[:, None]
    return np.asarray(xy[:, 0] + 1j * xy[:, 1])


def _levelled(window: Window, px: Array) -> NDArray[np.complex128]:
    """Pixels (n, 2) of the new photo as photo coordinates of one that looks straight down, by the
    tilt that it reports.
    """
    photo = window.photos[window.new]
    camera = window.cameras.get(photo.camera_key) or photo.lens
    direction = rays(camera, px) @ told_tilt(window.priors[window.new], 0.0)
    xy = direction[:, :2] / np.maximum(-direction[:, 2:], STEEPNESS)
    return np.asarray(xy[:, 0] + 1j * xy[:, 1])


def _guess(window: Window, disagree: float) -> tuple[Similarity, set[tuple[int, int]]] | None:
    """The similarity of the levelled new photo that most of its links agree with, and those links.
    Each tells one by where the placed photo shows what both see.
    """
    photo = window.photos[window.new]
    middle = np.array([[(photo.width - 1) / 2, (photo.height - 1) / 2]])
    centre = complex(_levelled(window, middle)[0])
    found: list[tuple[complex, complex, float, tuple[int, int]]] = []
    for link in window.links:
        other = link.other(window.new)
        if window.new not in (link.a, link.b) or other not in window.poses:
            continue
        own, theirs = (
            (link.index_b, link.index_a) if link.b == window.new else (link.index_a, link.index_b)
        )
        p = _levelled(window, window.features[window.new].px[own])
        ground = _on_ground(window, other, window.features[other].px[theirs])
        high = abs(float(window.poses[other].map_C[2]) - window.ground)
        a, t, _ = fit_similarity(p, ground, np.full(len(p), UNEVEN * max(high, 1.0)))
        found.append((a, a * centre + t, min(float(len(p)), MOST_WEIGHT), (link.a, link.b)))
    if not found:
        return None

    def near(x: tuple[complex, complex, float, tuple[int, int]]) -> list[int]:
        limit = disagree * abs(x[0])
        return [
            n
            for n, y in enumerate(found)
            if abs(x[1] - y[1]) < limit and abs(x[0] - y[0]) < 2 * limit
        ]

    group = max((near(x) for x in found), key=lambda g: sum(found[n][2] for n in g))
    weight = np.array([found[n][2] for n in group])
    a = complex(
        np.exp(
            np.average(np.log([found[n][0] / found[group[0]][0] for n in group]), weights=weight)
        )
    )
    a *= found[group[0]][0]
    t = complex(np.average([found[n][1] for n in group], weights=weight)) - a * centre
    return (a, t), {found[n][3] for n in group}


def held_setup(
    window: Window,
    plane: Mapping[int, tuple[complex, complex]],
    links: Sequence[Link],
    *,
    distortion: str = "none",
) -> Setup:
    """The arrays of the adjustment: placed photos start at their poses, held ones are fixed there,
    and so are known calibrations; `distortion`: what may change of other cameras.
    """
    members = tuple(sorted(plane))
    start = Start(
        placed=dict(plane),
        blocks=(members,),
        links=tuple(links),
        sigma_xy=dict.fromkeys(members, window.sigma_xy),
        georeferenced=frozenset(members),
        metric=True,
    )
    setup = set_up(window.photos, window.priors, start, distortion=distortion, repair=True)
    turned = setup.turned.copy()
    for i in window.poses:  # a placed photo keeps its detected orientation
        turned[i] = window.camera_of.get(i, "").endswith(TURNED)
    base = setup.base
    R, C = setup.start_R.copy(), setup.start_C.copy()
    R0, C0, sigma_R, sigma_C = (
        base.R0.copy(),
        base.C0.copy(),
        base.sigma_R.copy(),
        base.sigma_C.copy(),
    )
    for row, i in enumerate(setup.members.tolist()):
        C[row, 2] += window.ground - setup.z_ground
        if i in window.poses:
            pose = window.poses[i]
            R[row] = HALF_TURN @ pose.cam_R_map if turned[i] else pose.cam_R_map
            C[row] = pose.map_C
        elif not turned[i]:
            yaw_deg = -float(np.degrees(np.angle(plane[i][0])))
            R[row] = told_tilt(window.priors[i], yaw_deg)
        if i in window.held:
            R0[row], C0[row], sigma_R[row], sigma_C[row] = R[row], C[row], HELD_RAD, HELD_M
    K0, free = base.K0.copy(), base.free.copy()
    if distortion == "none":
        free[:] = False
    for row, key in enumerate(setup.camera_keys):
        if key in window.cameras:
            known = window.cameras[key]
            K0[row] = np.r_[known.vector, known.readout_s]
            free[row] = False
    placed = [window.photos[i] for i in setup.members.tolist()]
    base = replace(base, velocity=velocities(placed, C))
    base = replace(base, R0=R0, C0=C0, sigma_R=sigma_R, sigma_C=sigma_C, K0=K0, free=free)
    return replace(setup, base=base, start_R=R, start_C=C, turned=turned, z_ground=window.ground)
