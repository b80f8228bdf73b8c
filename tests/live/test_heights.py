"""The ground under a growing map whose reported heights are worth nothing."""

import numpy as np
import pytest
import rasterio

from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.simulate.settings import Control, Reporting, Route
from tests.live.conftest import made


@pytest.mark.slow
def test_no_ground_is_left_at_heights_of_earlier_adjustments(tmp_path_factory, tmp_path):
    """Photos rise and fall by tens of metres as the map grows, and all of the ground with them: two
    fifths of it had been more than 8 m off.
    """
    flight = made(
        tmp_path_factory,
        "heights",
        seed=16,
        route=Route(photos=15),
        control=Control(points=0, checks=0),
        reporting=Reporting(
            gps_noise_z=40.0, altitude_drift=60.0, barometer_noise=30.0, attitude_missing=True
        ),
    )
    live = LiveMap(tmp_path / "out", LiveSettings(features=800, deterministic=True))
    for path in flight.photos:
        live.add(path)
    rows = np.array(live.ledger.rows("select col, row, z from height"), np.float64)
    assert np.array_equal(live.heights.at(rows[:, :2].astype(int)), rows[:, 2])
    xy = (rows[:, :2] + 0.5) * live.heights.cell + live.members.frame.origin
    with rasterio.open(flight.folder / "truth" / "truth_surface.tif") as truth:
        true = np.array([v[0] for v in truth.sample(xy)], np.float64)
    known = true > 0
    off = rows[known, 2] - true[known]
    off -= np.median(off)  # heights above the sea stay unknown
    live.close()
    assert known.sum() > 200
    assert (np.abs(off) > 8).mean() < 0.02
