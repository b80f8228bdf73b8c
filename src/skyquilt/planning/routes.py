"""Routes through all points: within endurance, clear of keep-outs, the last landing early."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skyquilt.errors import RefusedError
from skyquilt.planning.airspace import Ways, make_airspace, ways_between
from skyquilt.planning.bound import lower_bound, work_of
from skyquilt.planning.flights import Surface, apart, flown, later
from skyquilt.planning.points import is_shut
from skyquilt.planning.records import Drone, KeepOut, PicturePoint, Site, Sortie
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.terrain import Terrain
from skyquilt.planning.times import NEVER, time_matrix
from skyquilt.planning.tours import Vehicle, tours
from skyquilt.planning.turns import meets

MOST_SORTIES = 60
"""Largest number of sorties of one drone."""
TIGHTER = 0.97
"""The endurance that routes are given again where climbs made them longer than expected."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Routes:
    """The flights of a plan."""

    sorties: tuple[Sortie, ...]
    """In order of drone and number."""
    bound_s: float
    """No plan can end earlier."""
    warnings: tuple[str, ...]
    """What does not hold."""


def plan_routes(
    site: Site,
    points: Sequence[PicturePoint],
    drones: Sequence[Drone],
    settings: PlanSettings,
    terrain: Terrain,
    height: float,
) -> Routes:
    """Flights of all drones through all points.

    Raises:
        RefusedError: a start lies in a keep-out area, points cannot be reached, or the endurance
            does not suffice.
        UsageError: OR-tools is not installed, or the wind is too strong.
    """
    ways, surface = free_ways(site, points, drones, settings, terrain, height)
    vehicles = [_vehicle(d, k, points, ways, surface, settings) for k, d in enumerate(drones)]
    _check_reach(points, drones, vehicles)
    bound = _bound(points, drones, vehicles)
    flights, usable = None, 1.0
    sorties = _least_sorties(vehicles)
    while flights is None:
        if sorties > MOST_SORTIES:
            raise RefusedError(
                f"more than {MOST_SORTIES} sorties of each drone would be needed; give more drones"
                " or longer endurance"
            )
        fleet = [_shorter(v, usable) for v in vehicles for _ in range(sorties)]
        orders = tours(fleet, settings.seconds)
        if orders is None:
            sorties += 1
            continue
        flights = _flights(orders, sorties, drones, points, ways, surface, settings)
        if any(s.seconds > drones[s.drone].usable_s for own in flights for s in own):
            flights, usable = None, usable * TIGHTER
            sorties += usable < TIGHTER**4
    kept, warnings = apart(flights, settings.separation_m)
    found = tuple(s for own in kept for s in own)
    warnings += _in_closed_places(found, drones, ways)
    end = max(s.way[-1].time_s for s in found)
    if settings.deadline_s is not None and end > settings.deadline_s:
        warnings.append(
            f"the last drone lands after {end / 60:.1f} min, and {settings.deadline_s / 60:.1f} min"
            f" are asked for; no plan for these drones can end before {bound / 60:.1f} min."
        )
    return Routes(sorties=found, bound_s=bound, warnings=tuple(warnings))


def _in_closed_places(sorties: Sequence[Sortie], drones: Sequence[Drone], ways: Ways) -> list[str]:
    """A sentence for each drone that cannot turn clear of keep-out areas; those that turn on the
    spot always can.
    """
    told = []
    meet = meets(ways.space.closed)
    for k, drone in enumerate(drones):
        own = [np.array([(w.x, w.y) for w in s.way]) for s in sorties if s.drone == k]
        if drone.turn_radius_m > 0 and any(meet(way, 0.0) for way in own):
            told.append(
                f"{drone.name} turns within {drone.turn_radius_m:g} m and cannot keep its distance"
                " from the keep-out areas on all of its way; give a drone that turns closer, or a"
                " larger keep-out area around narrow places."
            )
    return told


def free_ways(
    site: Site,
    points: Sequence[PicturePoint],
    drones: Sequence[Drone],
    settings: PlanSettings,
    terrain: Terrain,
    height: float,
) -> tuple[Ways, Surface]:
    """The ways between all points, then start and landing of each drone; and what is flown over.

    Raises:
        RefusedError: a start or landing place lies in a keep-out area.
    """
    shut = [k for k in site.keep_out if is_shut(k, terrain, height, settings.clearance_m)]
    low = tuple(
        (k, terrain.highest(k.shape) + (k.ceiling_m or 0.0)) for k in site.keep_out if k not in shut
    )
    grounds = np.array([p for d in drones for p in (d.start, d.landing)])
    _check_grounds(site.keep_out, drones)
    space = make_airspace([k.shape for k in shut], settings.clearance_m)
    near = space.inside(grounds)
    if near.any():
        drone = drones[int(np.flatnonzero(near)[0]) // 2]
        raise RefusedError(
            f"{drone.name} starts or lands within {settings.clearance_m:g} m of a keep-out area;"
            " choose another place or a smaller --clearance"
        )
    places = np.concatenate([np.array([(p.x, p.y) for p in points]), grounds])
    surface = Surface(terrain=terrain, low=low, clearance=settings.clearance_m)
    return ways_between(space, places), surface


def _check_grounds(closed: Sequence[KeepOut], drones: Sequence[Drone]) -> None:
    from shapely import Point

    for drone in drones:
        for place, what in ((drone.start, "starts"), (drone.landing, "lands")):
            for keep_out in closed:
                if keep_out.shape.intersects(Point(place)):
                    name = f" '{keep_out.name}'" if keep_out.name else ""
                    raise RefusedError(
                        f"{drone.name} {what} inside the keep-out area{name}; choose another place"
                    )


def _vehicle(
    drone: Drone,
    index: int,
    points: Sequence[PicturePoint],
    ways: Ways,
    surface: Surface,
    settings: PlanSettings,
) -> Vehicle:
    n = len(points)
    z = np.array([p.z for p in points])
    flat = time_matrix(drone, settings, ways, np.zeros(len(ways.places)))
    climb = np.abs(z[:, None] - z[None, :]) / drone.climb_ms
    ground = surface.terrain.at(
        np.array([drone.start[0], drone.landing[0]]), np.array([drone.start[1], drone.landing[1]])
    )
    start, landing = n + 2 * index, n + 2 * index + 1
    return Vehicle(
        times=np.maximum(flat[:n, :n], climb) + drone.photo_s,
        out=flat[start, :n] + (z - ground[0]) / drone.climb_ms + drone.photo_s,
        home=flat[:n, landing] + (z - ground[1]) / drone.climb_ms,
        usable=drone.usable_s,
    )


def _shorter(vehicle: Vehicle, share: float) -> Vehicle:
    return Vehicle(times=vehicle.times, out=vehicle.out, home=vehicle.home,
                   usable=vehicle.usable * share)  # fmt: skip


def _check_reach(
    points: Sequence[PicturePoint], drones: Sequence[Drone], vehicles: Sequence[Vehicle]
) -> None:
    """Refuses points that no drone can reach and return from."""
    alone = np.array([v.out + v.home for v in vehicles])
    if (alone.min(axis=0) >= NEVER).any():
        raise RefusedError(
            f"{int((alone.min(axis=0) >= NEVER).sum())} picture-points cannot be reached: keep-out"
            " areas surround them or the start"
        )
    usable = np.array([v.usable for v in vehicles])
    if (alone.min(axis=1) > usable).all():
        k = int(np.argmin(alone.min(axis=1) - usable))
        raise RefusedError(
            f"{drones[k].name} can fly {usable[k]:.0f} s less its reserve, and the nearest point"
            f" there and back takes {alone[k].min():.0f} s; start closer or give more endurance"
        )
    lost = (alone > usable[:, None]).all(axis=0)
    if lost.any():
        raise RefusedError(
            f"{int(lost.sum())} of {len(points)} picture-points lie too far away for one charge,"
            f" the farthest takes {alone.min(axis=0).max():.0f} s there and back; start closer"
        )


def _bound(
    points: Sequence[PicturePoint], drones: Sequence[Drone], vehicles: Sequence[Vehicle]
) -> float:
    photo = [d.photo_s for d in drones]
    work = work_of(
        [v.times - p for v, p in zip(vehicles, photo, strict=True)],
        [v.out - p for v, p in zip(vehicles, photo, strict=True)],
        [v.home for v in vehicles],
        np.array([(p.x, p.y) for p in points]),
        photo,
        [v.usable for v in vehicles],
        [d.swap_s for d in drones],
    )
    return lower_bound(work, _least_sorties(vehicles) * len(drones) + 2)


def _least_sorties(vehicles: Sequence[Vehicle]) -> int:
    """Fewest sorties of each drone that can be enough: each point has at least its cheapest leg."""
    least = sum(float(np.min(v.times + NEVER * np.eye(len(v.out)), axis=0).sum()) for v in vehicles)
    usable = sum(v.usable for v in vehicles)
    if len(vehicles[0].out) < 2:
        return 1
    return max(1, math.floor(least / len(vehicles) / usable))


def _flights(
    orders: Sequence[Sequence[int]],
    sorties: int,
    drones: Sequence[Drone],
    points: Sequence[PicturePoint],
    ways: Ways,
    surface: Surface,
    settings: PlanSettings,
) -> list[list[Sortie]]:
    """The sorties of each drone, one after the other; drones without points stay on the ground."""
    found: list[list[Sortie]] = []
    for index, drone in enumerate(drones):
        clock = 0.0
        own: list[Sortie] = []
        for order in orders[index * sorties : (index + 1) * sorties]:
            if not len(order):
                continue
            flight = flown(drone, index, len(own) + 1, order, points, ways, surface, settings)
            own.append(later(flight, clock))
            clock += flight.seconds + drone.swap_s
        found.append(own)
    return found
