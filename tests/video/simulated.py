"""A simulated flight with a video, and how far telemetry puts its frames from where they were."""

import numpy as np
from pyproj import Transformer

from skyquilt import simulate as sim
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Reporting, Route, Video
from skyquilt.video.positions import places_at

LATE_S = 2.0
"""Seconds by which the telemetry is late."""


def prepared():
    """The settings of a flight with a video, and all that happens in it."""
    settings = sim.FlightSettings(
        lens=Lens().scaled(480, 360),
        route=Route(photos=12, sidelap=0.4, speed=8.0),
        reporting=Reporting(gps_noise=0.0, focal_error=0.0),
        video=Video(fps=5.0, fixes_per_second=5.0, shift=LATE_S),
    )
    return settings, sim.prepare(settings)


def times_of(world):
    """When the frames of the clip were taken, s."""
    return np.array([s.waypoint.time for s in world.video.shots])


def distances(track, world):
    """Distances in m of frames' places by a track from the true ones, where it tells some."""
    found = places_at(track, times_of(world) + LATE_S)
    x, y = Transformer.from_crs(4326, world.place.crs, always_xy=True).transform(
        found.longitude_deg, found.latitude_deg
    )
    true = np.array([s.centre for s in world.video.shots])
    off = np.hypot(x - world.place.easting - true[:, 0], y - world.place.northing - true[:, 1])
    inside = np.isfinite(off)
    assert inside.mean() > 0.9
    return off[inside]
