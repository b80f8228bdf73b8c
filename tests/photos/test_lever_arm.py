"""A lever arm against displacements written down by hand."""

from dataclasses import replace

import pytest
from pyproj import Geod

from skyquilt.model.photo import GeoPosition
from skyquilt.photos.lever_arm import with_lever_arm
from tests.alignment.surveys import photo

EARTH = Geod(ellps="WGS84")
ANTENNA = GeoPosition(
    latitude_deg=46.6,
    longitude_deg=14.3,
    altitude_m=600.0,
    datum="ellipsoid",
    ellipsoid_m=600.0,
    takeoff_m=60.0,
)


def moved(arm, heading, tilt=(0.0, 0.0), position=ANTENNA):
    """(azimuth, distance, height, notes) of the camera from the antenna."""
    one = replace(
        photo(position=position), flight_yaw_deg=heading, flight_tilt_deg=tilt, attitude=None
    )
    (done,), notes = with_lever_arm([one], arm)
    p = done.position
    azimuth, _, distance = EARTH.inv(14.3, 46.6, p.longitude_deg, p.latitude_deg)
    return azimuth % 360, distance, p.ellipsoid_m - 600, notes


@pytest.mark.parametrize(
    ("arm", "heading", "azimuth"),
    [((0, 2, 0), 0, 0), ((0, 2, 0), 90, 90), ((2, 0, 0), 0, 90), ((2, 0, 0), 90, 180)],
)
def test_forward_and_right_turn_with_the_heading(arm, heading, azimuth):
    found, distance, height, _ = moved(arm, heading)
    assert (found - azimuth + 180) % 360 == pytest.approx(180, abs=0.5)
    assert distance == pytest.approx(2.0, rel=5e-3)
    assert height == pytest.approx(0, abs=1e-9)


def test_up_and_down_and_a_nose_that_is_raised():
    assert moved((0, 0, -0.3), 77)[2] == pytest.approx(-0.3)
    azimuth, distance, height, _ = moved((0, 2, 0), 0, tilt=(30.0, 0.0))
    assert (distance, height) == (pytest.approx(3**0.5, rel=5e-3), pytest.approx(1.0))
    assert moved((2, 0, 0), 0, tilt=(0.0, 30.0))[2] == pytest.approx(-1.0)  # right wing down


def test_a_barometer_keeps_its_zero_and_mrk_files_have_their_own_offsets():
    one = replace(photo(position=ANTENNA), flight_yaw_deg=0.0)
    (done,), _ = with_lever_arm([one], (0, 0, -0.3))
    assert done.position.takeoff_m == 60.0
    *_, height, notes = moved((0, 0, -0.3), 0, position=replace(ANTENNA, source="mrk"))
    assert height == 0
    assert "offsets of its own" in notes[0]
