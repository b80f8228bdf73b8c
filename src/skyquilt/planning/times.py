"""Flying times of drones between places, in wind, with climbs and photos."""

from itertools import pairwise

import numpy as np

from skyquilt.errors import UsageError
from skyquilt.planning.airspace import Ways, corner_way
from skyquilt.planning.records import Array, Drone
from skyquilt.planning.settings import PlanSettings

NEVER = 1e7
"""Stands for the time to places that cannot be reached, s."""


def ground_speed(drone: Drone, settings: PlanSettings, course: Array) -> Array:
    """Speed over ground in m/s on courses (radians from north), by the triangle of velocities.

    Raises:
        UsageError: the wind is as fast as the drone.
    """
    if settings.wind_ms >= 0.95 * drone.speed_ms:
        raise UsageError(
            f"{drone.name} flies {drone.speed_ms:g} m/s and cannot make way against a wind of"
            f" {settings.wind_ms:g} m/s"
        )
    blows_to = np.radians(settings.wind_from_deg + 180)
    with_it = settings.wind_ms * np.cos(course - blows_to)
    across = settings.wind_ms * np.sin(course - blows_to)
    return np.asarray(np.sqrt(drone.speed_ms**2 - across**2) + with_it)


def leg_time(drone: Drone, settings: PlanSettings, way: Array) -> Array:
    """Times (k - 1,) of the legs of a way (k, 3), without photos."""
    d = np.diff(way, axis=0)
    flat = np.hypot(d[:, 0], d[:, 1])
    speed = ground_speed(drone, settings, np.arctan2(d[:, 0], d[:, 1]))
    return np.maximum(flat / speed, np.abs(d[:, 2]) / drone.climb_ms)


def time_matrix(drone: Drone, settings: PlanSettings, ways: Ways, z: Array) -> Array:
    """(n, n) times in s between places of heights z (n,), without photos."""
    places, corners = ways.places, ways.space.corners
    flat = _times(drone, settings, places, places)
    if len(corners):
        there = _times(drone, settings, places, corners)
        back = _times(drone, settings, corners, places)
        inner = _corner_times(drone, settings, ways)
        i, j = np.nonzero(ways.first >= 0)
        a, b = ways.first[i, j], ways.last[i, j]
        flat[i, j] = there[i, a] + inner[a, b] + back[b, j]
    climb = np.abs(z[:, None] - z[None, :]) / drone.climb_ms
    found = np.maximum(flat, climb)
    found[~np.isfinite(ways.length)] = NEVER
    return np.asarray(found)


def _times(drone: Drone, settings: PlanSettings, a: Array, b: Array) -> Array:
    d = b[None, :, :] - a[:, None, :]
    speed = ground_speed(drone, settings, np.arctan2(d[..., 0], d[..., 1]))
    return np.asarray(np.hypot(d[..., 0], d[..., 1]) / speed)


def _corner_times(drone: Drone, settings: PlanSettings, ways: Ways) -> Array:
    """(k, k) times between corners along the shortest ways."""
    space = ways.space
    legs = _times(drone, settings, space.corners, space.corners)
    found = np.zeros_like(legs)
    pairs = {
        (int(a), int(b))
        for a, b in zip(ways.first.ravel(), ways.last.ravel(), strict=True)
        if a >= 0
    }
    for a, b in pairs:
        path = corner_way(space, a, b)
        found[a, b] = sum(legs[p, q] for p, q in pairwise(path))
    return found
