"""Sorties as ways in space and time: climbs, ways around keep-outs, over the surface, apart from
one another.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from shapely import contains_xy, prepare

from skyquilt.planning.airspace import Ways
from skyquilt.planning.records import Array, Drone, KeepOut, PicturePoint, Sortie, Waypoint
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.terrain import Terrain
from skyquilt.planning.times import leg_time
from skyquilt.planning.turns import courses_at, meets, turned_way

SAMPLE_M = 5.0
"""Largest distance of the places on a way whose surface is looked at; half a cell where that is
less.
"""
MOST_SAMPLES = 20_000
"""Largest number of these places on a way between two points."""
MOST_DELAY_S = 600.0
"""Longest wait before a take-off for the sake of separation."""
DELAY_STEP_S = 3.0
NO_WAY_M = 0.1
"""Places closer than this are one place."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """What has to be flown over."""

    terrain: Terrain
    """Ground or surface."""
    low: tuple[tuple[KeepOut, float], ...]
    """Closed places below the photos, with the height of their ceilings."""
    clearance: float
    """Above all of it, m."""

    def least(self, xy: Array) -> Array:
        """Least heights (n,) at places (n, 2)."""
        top = self.terrain.at(xy[:, 0], xy[:, 1])
        for place, ceiling in self.low:
            grown = place.shape.buffer(self.clearance)
            prepare(grown)
            within = contains_xy(grown, xy[:, 0], xy[:, 1])
            top = np.where(within, np.maximum(top, ceiling), top)
        return np.asarray(top + self.clearance)

    @property
    def flat(self) -> bool:
        """Whether nothing can stand in the way."""
        return not self.terrain.known and not self.low


def lifted(surface: Surface, way: Array) -> Array:
    """A way (k, 3) with the fewest places added or raised that keep it above the surface: the upper
    hull of its heights and those needed.
    """
    if surface.flat or len(way) < 2:
        return way
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way[:, :2], axis=0).T))])
    if s[-1] < 1e-6:
        return way
    step = min(SAMPLE_M, surface.terrain.cell / 2) if surface.terrain.known else SAMPLE_M
    count = min(int(s[-1] / step) + 2, MOST_SAMPLES)
    at = np.unique(np.concatenate([np.linspace(0, s[-1], count), s]))
    xy = np.column_stack([np.interp(at, s, way[:, k]) for k in (0, 1)])
    z = surface.least(xy)
    # between two places it may be as high as at either
    z = np.maximum(z, np.maximum(np.append(z[1:], -np.inf), np.append(-np.inf, z[:-1])))
    z[0], z[-1] = way[0, 2], way[-1, 2]
    hull: list[int] = []
    for k in range(len(at)):  # Andrew's monotone chain
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (z[b] - z[a]) * (at[k] - at[a]) <= (z[k] - z[a]) * (at[b] - at[a]):
                hull.pop()
            else:
                break
        hull.append(k)
    heights = np.interp(at, at[hull], z[hull])
    keep = np.zeros(len(at), bool)
    keep[hull] = True
    keep |= np.isin(at, s)  # where the way bends
    return np.column_stack([xy, heights])[keep]


def flown(
    drone: Drone,
    index: int,
    number: int,
    route: Sequence[int],
    points: Sequence[PicturePoint],
    ways: Ways,
    surface: Surface,
    settings: PlanSettings,
) -> Sortie:
    """The sortie of a route (indices of points) that takes off at time 0; `ways`: between all
    points, then the starts and landings of all drones.
    """
    start, landing = len(points) + 2 * index, len(points) + 2 * index + 1
    ground = surface.terrain.at(np.array([drone.start[0], drone.landing[0]]),
                                np.array([drone.start[1], drone.landing[1]]))  # fmt: skip
    air = surface.least(np.array([drone.start, drone.landing])) if not surface.flat else ground
    up = max(points[route[0]].z, float(air[0]))
    down = max(points[route[-1]].z, float(air[1]))
    stops = [(start, up), *((p, points[p].z) for p in route), (landing, down)]
    places, at = [np.array([[*drone.start, up]])], [-1]
    for (a, za), (b, zb) in pairwise(stops):
        leg = _leg(ways, surface, a, b, za, zb)
        places.append(leg[1:])
        at += [-1] * (len(leg) - 2) + [b if b < len(points) else -1]
    xyz = np.concatenate(places)
    if drone.turn_radius_m > 0:
        yaws = [points[p].yaw if p >= 0 else None for p in at]
        xyz, kept = in_arcs(xyz, yaws, drone.turn_radius_m, ways, surface)
        at = [at[k] if k >= 0 else -1 for k in kept]
    clock = (up - float(ground[0])) / drone.climb_ms
    way = [
        Waypoint(x=drone.start[0], y=drone.start[1], z=float(ground[0]), time_s=0.0),
        Waypoint(x=drone.start[0], y=drone.start[1], z=up, time_s=clock),
    ]
    times = leg_time(drone, settings, xyz)
    for (x, y, z), p, seconds in zip(xyz[1:].tolist(), at[1:], times.tolist(), strict=True):
        clock += seconds
        way.append(Waypoint(x=x, y=y, z=z, time_s=clock, point=points[p].id if p >= 0 else None))
        clock += drone.photo_s if p >= 0 else 0.0
    clock += (down - float(ground[1])) / drone.climb_ms
    way.append(Waypoint(x=drone.landing[0], y=drone.landing[1], z=float(ground[1]),
                        time_s=clock))  # fmt: skip
    return Sortie(drone=index, number=number, way=tuple(way))


def _leg(ways: Ways, surface: Surface, a: int, b: int, za: float, zb: float) -> Array:
    flat = ways.way(a, b)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(flat, axis=0).T))])
    z = np.interp(s, [0.0, max(s[-1], 1e-9)], [za, zb]) if s[-1] > 0 else np.array([za, zb])
    return lifted(surface, np.column_stack([flat, z]))


def in_arcs(
    xyz: Array, yaws: Sequence[float | None], radius: float, ways: Ways, surface: Surface
) -> tuple[Array, list[int]]:
    """The places of a way (n, 3) joined by the shortest curves that turn within a radius, and for
    each place of the result its index in `xyz`, or -1. `yaws`: directions of the pictures, degrees.
    """
    moves = np.hypot(*np.diff(xyz[:, :2], axis=0).T) > NO_WAY_M
    stay = [0, *(np.flatnonzero(moves) + 1).tolist()]
    own = [yaws[k] for k in stay]
    xy = xyz[stay, :2]
    if len(xy) < 2:
        return xyz, list(range(len(xyz)))
    parts, _ = turned_way(xy, courses_at(xy, own), radius, meets(ways.space.closed))
    rows, kept = [xyz[:1]], [0]
    for k, part in enumerate(parts):
        same = list(range(stay[k] + 1, stay[k + 1]))  # climbs on the spot
        rows += [xyz[same]] if same else []
        kept += same
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(part, axis=0).T))])
        z = np.interp(s, [0.0, max(float(s[-1]), 1e-9)], [xyz[stay[k + 1] - 1, 2],
                                                          xyz[stay[k + 1], 2]])  # fmt: skip
        found = lifted(surface, np.column_stack([part, z]))
        rows.append(found[1:])
        kept += [-1] * (len(found) - 2) + [stay[k + 1]]
    rest = list(range(stay[-1] + 1, len(xyz)))
    return np.concatenate([*rows, xyz[rest]]), [*kept, *rest]


def later(sortie: Sortie, seconds: float) -> Sortie:
    """The same sortie, taking off later."""
    return replace(sortie, way=tuple(replace(w, time_s=w.time_s + seconds) for w in sortie.way))


def apart(
    flights: Sequence[Sequence[Sortie]], separation: float
) -> tuple[list[list[Sortie]], list[str]]:
    """The sorties of each drone with take-offs delayed so that drones in the air stay apart, and a
    sentence for each pair that could not be kept apart.
    """
    done: list[list[Sortie]] = []
    sentences = []
    for own in flights:
        delay = 0.0
        while separation > 0 and done and delay <= MOST_DELAY_S:
            moved = [later(s, delay) for s in own]
            if all(nearest(moved, other) >= separation for other in done):
                break
            delay += DELAY_STEP_S
        if delay > MOST_DELAY_S:
            least = min(nearest(own, other) for other in done)
            sentences.append(
                f"a drone comes within {least:.0f} m of another, and {separation:g} m are asked"
                " for; no wait of up to ten minutes helps, so move its start or landing place."
            )
            delay = 0.0
        done.append([later(s, delay) for s in own])
    return done, sentences


def nearest(a: Sequence[Sortie], b: Sequence[Sortie]) -> float:
    """The least distance in m of two drones while both are in the air; infinite where they never
    are.
    """
    least = np.inf
    for one in a:
        for other in b:
            low = max(one.way[0].time_s, other.way[0].time_s)
            high = min(one.way[-1].time_s, other.way[-1].time_s)
            if low >= high:
                continue
            clock = np.unique(np.concatenate([
                np.arange(low, high, 0.5), [high],
                [w.time_s for w in (*one.way, *other.way) if low <= w.time_s <= high],
            ]))  # fmt: skip
            least = min(least, float(np.linalg.norm(
                places(one, clock) - places(other, clock), axis=1).min()))  # fmt: skip
    return float(least)


def places(sortie: Sortie, clock: Array) -> Array:
    """Where a drone is (n, 3) at times (n,)."""
    t = [w.time_s for w in sortie.way]
    return np.column_stack(
        [np.interp(clock, t, [getattr(w, k) for w in sortie.way]) for k in ("x", "y", "z")]
    )
