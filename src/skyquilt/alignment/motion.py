"""How cameras move while their photos are taken: velocities from neighbours' positions and times.

A rolling shutter exposes the rows of a photo one after the other while the camera flies on.
"""

from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import angle_difference_deg, commonest_deg
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment

Array = NDArray[np.float64]
Speeds = Callable[[Sequence[int], Array], Array]
"""Velocities (k, 3) in m/s of some photos (indices) at centres (k, 3) in m; zero where unknown."""
FASTEST_MS = 70.0
"""Greater speeds in m/s come from wrong times."""
STRAIGHT_DEG = 30.0
"""A flight that turns by more than this in degrees from one leg to the next is on another line."""
LONGEST_GAP_S = 60.0
"""Photos further apart than this in s do not tell the speed in between."""
LEAST_GAP_S, SPUN_APART_S = 0.05, 2.0
"""Photos nearer to one another than this in s have no rate; those further apart than the second do
not tell how fast the camera turned at each.
"""
SWAYS_RAD_S = np.radians(5.0)
"""Slower turns are those of a camera that sways, whose rate changes from moment to moment."""
HOVERS = 0.3
"""A drone that reports less than this share of its mean speed slows down for its photos."""
FEWEST_HEADED, MOST_ALIKE, AMBIGUOUS_DEG = 4, 0.8, 20.0
"""Photos that tell how a camera is headed as it flies, at least; the share of them that must be
headed alike; and by how many degrees two answers differ from each other.
"""
REACH = 3
"""Neighbours before and after a photo that tell its velocity; twice as many tell its climb, and
where times are given in whole seconds only.
"""


def seconds(photos: Sequence[Photo]) -> Array:
    """Capture times (n,) in s since the first one; NaN for photos without time."""
    plain = [None if p.time is None else p.time.replace(tzinfo=None) for p in photos]
    first = min((t for t in plain if t is not None), default=None)
    return np.array(
        [np.nan if t is None or first is None else (t - first).total_seconds() for t in plain]
    )


def velocities(photos: Sequence[Photo], C: Array) -> Array:
    """Velocities (n, 3) in m/s in the map frame of cameras at C (n, 3); zero where unknown.

    Each is the slope of positions over times along the straight part of the flight around a photo.
    Where a photo reports a speed far below that, its drone slows down for its photos, and the
    reported velocity is taken.
    """
    out = np.zeros((len(photos), 3))
    time = seconds(photos)
    for order in _in_order(photos, time):
        out[order] = _along(time[order], C[order])
    for i, photo in enumerate(photos):
        said = photo.velocity_ned
        if said is None:
            continue
        reported = np.array([said[1], said[0], -said[2]])
        speed = float(np.linalg.norm(out[i]))
        if speed == 0 or np.linalg.norm(reported) < HOVERS * speed:
            out[i] = reported
    return out


def spins(photos: Sequence[Photo], R: Array) -> tuple[Array, Array]:
    """Rates (n, 3) in rad/s at which cameras with rotations R (n, 3, 3) from map to camera turn
    about their axes while photos are taken, as frames of a clip do where the drone turns, and by
    how much each may be off (n,): by the turns from the photo before and to the one after. Zero
    where no photo was taken so near in time, and where they are slow.
    """
    rate, off, time = np.zeros((len(photos), 3)), np.zeros(len(photos)), seconds(photos)
    for order in _in_order(photos, time):
        gap = np.diff(time[order])
        near, leg = (gap > LEAST_GAP_S) & (gap < SPUN_APART_S), np.zeros((len(gap), 3))
        for k in np.flatnonzero(near).tolist():
            turned = R[order[k + 1]] @ R[order[k]].T
            leg[k] = np.asarray(cv2.Rodrigues(turned)[0]).ravel() / gap[k]
        for k, i in enumerate(order):
            known = [leg[n] for n in (k - 1, k) if 0 <= n < len(leg) and near[n]]
            if known:
                rate[i] = np.mean(known, axis=0)
                off[i] = np.linalg.norm(known[0] - (known[1] if known[1:] else 0.0)) / 2
    fast = np.linalg.norm(rate, axis=1) > SWAYS_RAD_S
    return np.where(fast[:, None], rate, 0.0), np.where(fast, off, 0.0)


def _in_order(photos: Sequence[Photo], time: Array) -> Iterator[NDArray[np.int64]]:
    """The photos of each camera that have a time (n,) in s, in order of it."""
    keys: dict[str, list[int]] = {}
    for i, photo in enumerate(photos):
        if np.isfinite(time[i]):
            keys.setdefault(photo.camera_key, []).append(i)
    for group in keys.values():
        yield np.array(sorted(group, key=lambda i: (time[i], photos[i].name)))


def velocities_of(photos: Sequence[Photo], alignment: Alignment) -> dict[int, Array]:
    """Index of each placed photo -> velocity (3,) of its camera in m/s in the map frame."""
    placed = list(alignment.poses)
    C = np.array([alignment.poses[i].map_C for i in placed]).reshape(-1, 3)
    return dict(zip(placed, velocities([photos[i] for i in placed], C), strict=True))


def speeds_of(photos: Sequence[Photo]) -> Speeds:
    """The velocities of some of these photos, wherever they are placed."""
    return lambda own, C: velocities([photos[i] for i in own], C)


def headings_by_course(
    photos: Sequence[Photo], C: Array, yaw_deg: Array, *, assumed: bool = False
) -> Array:
    """Headings (n,) in degrees of photos that have none in `yaw_deg` (n,), at C (n, 2) in m, by
    those of the others: cameras turn with the flight, or keep one heading. NaN where the others do
    not tell, where both would be possible and differ, or where a photo's course is not known.

    `assumed`: few of the others are enough, and where there are none, the top of the picture is
    taken to show where the flight goes.
    """
    fewest = 1 if assumed else FEWEST_HEADED
    v = velocities(photos, np.column_stack([C, np.zeros(len(C))]))
    course = np.degrees(np.arctan2(v[:, 0], v[:, 1]))
    course[np.hypot(v[:, 0], v[:, 1]) == 0] = np.nan
    found = np.full(len(photos), np.nan)
    keys = np.array([photo.camera_key for photo in photos])
    for key in dict.fromkeys(keys.tolist()):
        known = (keys == key) & np.isfinite(yaw_deg) & np.isfinite(course)
        wanted = (keys == key) & ~np.isfinite(yaw_deg) & np.isfinite(course)
        aside = 0.0 if assumed and not known.any() else _common((yaw_deg - course)[known], fewest)
        turned = course[wanted] + aside
        kept = np.full(len(turned), _common(yaw_deg[known], fewest))
        apart = np.abs(angle_difference_deg(turned, kept)) > AMBIGUOUS_DEG
        found[wanted] = np.where(
            np.isnan(turned), kept, np.where(apart & np.isfinite(kept), np.nan, turned)
        )
    return np.asarray(angle_difference_deg(found, 0.0))


def _common(angles_deg: Array, fewest: int) -> float:
    """The angle in degrees near which most lie; NaN if too few do, or there are few."""
    if len(angles_deg) < fewest:
        return np.nan
    common, share = commonest_deg(angles_deg)
    return common if share >= MOST_ALIKE else np.nan


def _along(time: Array, C: Array) -> Array:
    """Velocities (n, 3) of one camera's photos in order of time."""
    n = len(time)
    out = np.zeros((n, 3))
    if n < 2:
        return out
    gap, step = np.diff(time), np.diff(C, axis=0)
    leg = np.full((n - 1, 3), np.nan)
    timed = (gap > LEAST_GAP_S) & (gap < LONGEST_GAP_S)
    leg[timed] = step[timed] / gap[timed, None]
    leg[np.linalg.norm(np.nan_to_num(leg), axis=1) > FASTEST_MS] = np.nan
    whole = bool((np.abs(time - np.round(time)) < 1e-6).all())
    reach = 2 * REACH if whole else REACH
    for i in range(n):
        for axes, far in ((slice(0, 2), reach), (slice(2, 3), 2 * reach)):
            line = _line(leg, i, far)
            if len(line) >= 2:
                t = time[line] - time[line].mean()
                out[i, axes] = t @ (C[line] - C[line].mean(0))[:, axes] / (t @ t)
    return out


def _line(leg: Array, i: int, reach: int) -> NDArray[np.int64]:
    """The photos around photo i on the same straight part of the flight, at most `reach` on each
    side; only i itself where no leg is known.
    """
    before = _run(leg, i - 1, -1, reach)
    after = _run(leg, i, 1, reach)
    if before and after and not _agree(leg[i - 1], leg[i]):
        # a turn: the photo belongs to the longer part; the leg between two lines is a part of one
        if len(before) == len(after):
            slow = np.linalg.norm(leg[i - 1]) < np.linalg.norm(leg[i])
            before, after = ([], after) if slow else (before, [])
        elif len(before) > len(after):
            after = []
        else:
            before = []
    return np.array(sorted({i, *(k for k in before), *(k + 1 for k in after)}))


def _run(leg: Array, first: int, step: int, reach: int) -> list[int]:
    """Legs from `first` on that keep their direction and speed."""
    found: list[int] = []
    k = first
    while 0 <= k < len(leg) and len(found) < reach and np.isfinite(leg[k]).all():
        if found and not _agree(leg[found[-1]], leg[k]):
            break
        found.append(k)
        k += step
    return found


def _agree(a: Array, b: Array) -> bool:
    """Whether two velocities are those of one straight flight."""
    la, lb = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    if min(la, lb) < 1e-6:
        return max(la, lb) < 0.2
    alike = float(a @ b) > np.cos(np.radians(STRAIGHT_DEG)) * la * lb
    return alike and max(la, lb) < 2.5 * min(la, lb)
