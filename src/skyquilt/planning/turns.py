"""Ways that a drone with a least radius of turn can fly: Dubins curves through all places.

L. E. Dubins, "On curves of minimal length with a constraint on average curvature", American Journal
of Mathematics 79 (1957): the shortest way between two places with a course at each is one of six
words of arcs to the left (L), to the right (R), and straight lines (S). A. M. Shkel and
V. Lumelsky, "Classification of the Dubins set", Robotics and Autonomous Systems 34 (2001), give
their lengths.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from shapely import LineString, prepare
from shapely.geometry.base import BaseGeometry

from skyquilt.planning.records import Array

STEP_RAD = np.radians(12.0)
"""Arcs are drawn by places so far apart."""
MET = 1e6
"""Added to the length of what meets a closed place, m."""
_TURNS = {"L": -1, "S": 0, "R": 1}
_TAU = 2 * np.pi
REACH = 4.0
"""No curve leaves the straight way by more radii."""
Blocked = Callable[[Array, float], bool]
"""Whether a way (n, 2) comes as near to a closed place."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One word between two places; angles are courses in radians clockwise from north."""

    word: str
    """Such as `LSR`."""
    parts: tuple[float, float, float]
    """Angles of arcs in radians, and the straight line's length in radii."""

    @property
    def length(self) -> float:
        """In radii."""
        return sum(self.parts)


def curves(a: Array, course_a: float, b: Array, course_b: float, radius: float) -> list[Curve]:
    """All words from a place (2,) with a course to another one, the shortest first."""
    d = (np.asarray(b, np.float64) - a) / radius
    far, to = float(np.hypot(*d)), float(np.arctan2(d[0], d[1]))
    # in the frame in which b lies ahead; mathematical angles grow to the left, courses to the right
    alpha, beta = (to - course_a) % _TAU, (to - course_b) % _TAU
    sa, ca, sb, cb, cab = (
        np.sin(alpha), np.cos(alpha), np.sin(beta), np.cos(beta), np.cos(alpha - beta),
    )  # fmt: skip
    found: list[Curve] = []

    def add(word: str, t: float, p: float, q: float) -> None:
        found.append(Curve(word=word, parts=(_arc(t), float(p), _arc(q))))

    square = 2 + far**2 - 2 * cab + 2 * far * (sa - sb)
    if square >= 0:
        turn = np.arctan2(cb - ca, far + sa - sb)
        add("LSL", turn - alpha, np.sqrt(square), beta - turn)
    square = 2 + far**2 - 2 * cab + 2 * far * (sb - sa)
    if square >= 0:
        turn = np.arctan2(ca - cb, far - sa + sb)
        add("RSR", alpha - turn, np.sqrt(square), turn - beta)
    square = -2 + far**2 + 2 * cab + 2 * far * (sa + sb)
    if square >= 0:
        p = np.sqrt(square)
        turn = np.arctan2(-ca - cb, far + sa + sb) - np.arctan2(-2.0, p)
        add("LSR", turn - alpha, p, turn - beta)
    square = far**2 - 2 + 2 * cab - 2 * far * (sa + sb)
    if square >= 0:
        p = np.sqrt(square)
        turn = np.arctan2(ca + cb, far - sa - sb) - np.arctan2(2.0, p)
        add("RSL", alpha - turn, p, beta - turn)
    share = (6 - far**2 + 2 * cab + 2 * far * (sa - sb)) / 8
    if abs(share) <= 1:
        p = _TAU - np.arccos(share)
        t = alpha - np.arctan2(ca - cb, far - sa + sb) + p / 2
        add("RLR", t, p, alpha - beta - t + p)
    share = (6 - far**2 + 2 * cab + 2 * far * (sb - sa)) / 8
    if abs(share) <= 1:
        p = _TAU - np.arccos(share)
        t = -alpha + np.arctan2(-ca + cb, far + sa - sb) + p / 2
        add("LRL", t, p, beta - alpha - t + p)
    return sorted(found, key=lambda c: c.length)


def _arc(angle: float) -> float:
    """An angle from 0 to a full turn; a full turn that stems from rounding is none."""
    turned = float(angle) % _TAU
    return 0.0 if _TAU - turned < 1e-7 else turned


def drawn(curve: Curve, a: Array, course: float, radius: float) -> Array:
    """Places (n, 2) on a curve from a, its start included."""
    at, places = np.asarray(a, np.float64), [np.asarray(a, np.float64)]
    for kind, part in zip(curve.word, curve.parts, strict=True):
        side = _TURNS[kind]
        if part < 1e-9:
            continue
        if side == 0:
            at = at + part * radius * np.array([np.sin(course), np.cos(course)])
            places.append(at)
            continue
        middle = at + side * radius * np.array([np.cos(course), -np.sin(course)])
        for turned in np.linspace(0, part, int(np.ceil(part / STEP_RAD)) + 1)[1:]:
            now = course + side * turned
            places.append(middle - side * radius * np.array([np.cos(now), -np.sin(now)]))
        course, at = course + side * part, places[-1]
    return np.array(places)


def leg(
    a: Array,
    course_a: float,
    b: Array,
    course_b: float,
    radius: float,
    blocked: Blocked,
    *,
    full: bool = True,
) -> tuple[float, Array, bool]:
    """Length in m, places (n, 2) and whether it is clear, of the shortest curve that is, or else of
    the shortest. Without `full`, places are left out where nothing closed is near.
    """
    first: tuple[float, Array] | None = None
    reach = REACH * radius
    far = not blocked(np.array([a, b]), reach)
    for curve in curves(a, course_a, b, course_b, radius):
        if far and not full:
            return radius * curve.length, np.empty((0, 2)), True
        places = drawn(curve, a, course_a, radius)
        places[-1] = b
        if first is None:
            first = radius * curve.length, places
        if far or not blocked(places, 0.0):
            return radius * curve.length, places, True
    assert first is not None  # LSL or RSR exists for any two places
    return *first, False


def turned_way(
    xy: Array, courses: Sequence[Sequence[float]], radius: float, blocked: Blocked
) -> tuple[list[Array], int]:
    """Curves from each place (n, 2) to the next, the shortest in all, and how many of them meet a
    closed place; `courses`: those in question at each place, radians.
    """
    best: list[list[tuple[float, int]]] = [[(0.0, -1)] * len(courses[0])]
    for k, (a, b) in enumerate(pairwise(xy)):
        row = []
        for after in courses[k + 1]:
            ways = []
            for i, before in enumerate(courses[k]):
                length, _, clear = leg(a, before, b, after, radius, blocked, full=False)
                ways.append((best[-1][i][0] + length + (0.0 if clear else MET), i))
            row.append(min(ways))
        best.append(row)
    at = int(np.argmin([v for v, _ in best[-1]]))
    chosen = [at]
    for row in reversed(best[1:]):
        at = row[at][1]
        chosen.append(at)
    chosen.reverse()
    parts, met = [], 0
    for k, (a, b) in enumerate(pairwise(xy)):
        _, places, clear = leg(a, courses[k][chosen[k]], b, courses[k + 1][chosen[k + 1]], radius,
                               blocked)  # fmt: skip
        parts.append(places)
        met += not clear
    return parts, met


def courses_at(xy: Array, yaws: Sequence[float | None]) -> list[list[float]]:
    """Courses in question at each place (n, 2), radians: for photos the direction of their line,
    both ways, elsewhere those of the legs before and after it; `yaws` in degrees, None elsewhere.
    """
    d = np.diff(xy, axis=0)
    to = np.arctan2(d[:, 0], d[:, 1])
    found = []
    for k, yaw in enumerate(yaws):
        if yaw is not None:  # a camera that is fixed to the drone sees what was planned
            own = [float(np.radians(yaw)), float(np.radians(yaw + 180))]
        else:
            own = [float(to[j]) for j in (k - 1, k) if 0 <= j < len(to)]
        rounded = {round(c % _TAU, 4) % round(_TAU, 4) for c in own} or {0.0}
        found.append(sorted(rounded))
    return found


def meets(closed: BaseGeometry) -> Blocked:
    """Whether ways (n, 2) come within a distance of closed places."""
    if closed.is_empty:
        return lambda _, __: False
    prepare(closed)

    def near(places: Array, distance: float) -> bool:
        way = LineString(places)
        return bool(closed.dwithin(way, distance) if distance else closed.intersects(way))

    return near
