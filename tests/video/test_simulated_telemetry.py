"""Telemetry of the simulator in every layout, read again, against the true path."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from pyproj import Transformer

from skyquilt import simulate as sim
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Reporting, Route, SrtLayout, Video
from skyquilt.simulate.video import telemetry
from skyquilt.video.positions import places_at
from skyquilt.video.tracks import read_track


@pytest.fixture(scope="module")
def flown():
    """The settings of a flight with a video, and all that happens in it."""
    settings = sim.FlightSettings(
        lens=Lens().scaled(480, 360),
        route=Route(photos=12, sidelap=0.4, speed=8.0),
        reporting=Reporting(gps_noise=0.0, focal_error=0.0),
        video=Video(fps=5.0, fixes_per_second=5.0, shift=2.0),
    )
    return settings, sim.prepare(settings)


@pytest.mark.parametrize("layout", get_args(SrtLayout))
def test_every_layout_is_read_as_it_was_meant(flown, layout, tmp_path):
    settings, world = flown
    video, film = replace(settings.video, layout=layout), world.video
    times = np.array([s.waypoint.time for s in film.shots])
    text = telemetry(film.reports, times, video, film.lens, settings.weather.moment)
    path = tmp_path / "FLIGHT.SRT"
    path.write_text(text, encoding="utf-8")
    track = read_track(path)
    found = places_at(track, times + 2.0)
    x, y = Transformer.from_crs(4326, world.place.crs, always_xy=True).transform(
        found.longitude_deg, found.latitude_deg
    )
    true = np.array([s.centre for s in film.shots])
    off = np.hypot(x - world.place.easting - true[:, 0], y - world.place.northing - true[:, 1])
    inside = np.isfinite(off)
    assert inside.mean() > 0.9
    # 0.3 m where rounded to 1e-6 degrees; where to 1e-4, of 11 m, a third of that on average
    coarse = layout in ("mavic-pro", "matrice300")
    assert np.median(off[inside]) < (4.0 if coarse else 0.4)
    assert track.focal_35mm == pytest.approx(28.84, abs=0.05) or layout in (
        "p4rtk",
        "mavic-pro",
        "matrice300",
    )
