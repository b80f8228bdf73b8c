"""Flights with cameras that nobody knows: slow shutters, and pictures resized along one side."""

import numpy as np
import pytest

from skyquilt.quality.map_error import map_error
from skyquilt.simulate import FlightSettings
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Route
from tests.once import flown_once

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("readout", "aspect", "fixed_yaw"),
    [
        (0.09, 1.0, True),
        pytest.param(0.09, 1.0, False, marks=pytest.mark.long),
        pytest.param(0.0, 0.97, False, marks=pytest.mark.long),
    ],
)
def test_the_map_has_its_shape(mosaic, tmp_path_factory, readout, aspect, fixed_yaw):
    """Within 0.7 ground pixels once it lies, and is as large, as the positions of 2 m have it."""
    lens = Lens(width=800, height=600, focal=700.0, readout=readout, aspect=aspect)
    settings = FlightSettings(
        seed=5,
        lens=lens,
        route=Route(photos=16, height=60.0, speed=8.0, fixed_yaw=fixed_yaw),
        control=Control(points=0, checks=0),
    )
    flight = flown_once(tmp_path_factory, f"untold {readout} {aspect} {fixed_yaw}", settings)
    run = mosaic(flight / "photos").made()
    (note,) = [w for w in run.metrics["notes"] if "do not fit the camera" in w]
    (shutter,) = run.metrics["shutter"].values()
    assert shutter["source"] == "unknown"
    assert abs(shutter["readout_ms"] / 1000 - readout) < 3 * shutter["sigma_ms"] / 1000 + 1e-3
    said = float(note.split("the ratio ")[1].split(" ")[0])
    # a drone that turns with its lines hardly tells a readout from an aspect ratio
    assert said == pytest.approx(aspect, abs=0.01 if readout else 0.005)
    error = map_error(run.output / "mosaic.tif", flight / "truth" / "truth_ortho.tif")
    good = [s for s in error.samples if s.ok]
    z = np.array([complex(s.x, s.y) for s in good])
    there = z - [complex(s.error_x_m, s.error_y_m) for s in good]
    z -= z.mean()
    A = np.stack([z, np.ones_like(z)], 1)
    similar = np.linalg.lstsq(A, there, rcond=None)[0]
    assert abs(similar[0]) == pytest.approx(1, abs=0.015)
    assert np.median(np.abs(A @ similar - there)) < 0.7 * settings.resolution
