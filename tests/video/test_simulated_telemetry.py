"""Telemetry of the simulator in every layout, read again, against the true path."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from skyquilt.simulate.settings import SrtLayout
from skyquilt.simulate.video import telemetry
from skyquilt.video.tracks import read_track
from tests.video.simulated import distances, prepared, times_of


@pytest.fixture(scope="module")
def flown():
    """The settings of a flight with a video, and all that happens in it."""
    return prepared()


@pytest.mark.parametrize("layout", get_args(SrtLayout))
def test_every_layout_is_read_as_it_was_meant(flown, layout, tmp_path):
    settings, world = flown
    video, film = replace(settings.video, layout=layout), world.video
    times = times_of(world)
    text = telemetry(film.reports, times, video, film.lens, settings.weather.moment)
    path = tmp_path / "FLIGHT.SRT"
    path.write_text(text, encoding="utf-8")
    track = read_track(path)
    off = distances(track, world)
    # 0.3 m where rounded to 1e-6 degrees; where to 1e-4, of 11 m, a third of that on average
    coarse = layout in ("mavic-pro", "matrice300")
    assert np.median(off) < (4.0 if coarse else 0.4)
    assert track.focal_35mm == pytest.approx(28.84, abs=0.05) or layout in (
        "p4rtk",
        "mavic-pro",
        "matrice300",
    )
