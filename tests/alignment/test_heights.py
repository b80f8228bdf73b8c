"""Heights above different zeros, against sums by hand; the geoid itself has its own tests."""

import numpy as np
import pytest

from skyquilt.alignment.control import control_in_frame
from skyquilt.alignment.heights import height_figures
from skyquilt.alignment.priors import choose_frame, priors
from skyquilt.errors import UsageError
from skyquilt.geometry.geoid import geoid_height
from skyquilt.model.photo import ControlPoint, GeoPosition, PointObservation
from tests.alignment.surveys import photo

PLACE = {"latitude_deg": 46.6, "longitude_deg": 14.3}
N = float(geoid_height(46.6, 14.3))


def drone(takeoff, sea):
    """A drone's usual photo: barometer and a height above sea level."""
    return photo(
        position=GeoPosition(
            **PLACE, altitude_m=takeoff, datum="takeoff", takeoff_m=takeoff, sea_level_m=sea
        )
    )


def rtk(ellipsoid):
    return photo(
        position=GeoPosition(
            **PLACE, altitude_m=ellipsoid, datum="ellipsoid", ellipsoid_m=ellipsoid
        )
    )


def heights(photos, datum):
    frame = choose_frame(photos, None, (), datum)
    assert frame.vertical_datum == (datum or photos[0].position.datum)
    return [p.map_C[2] for p in priors(photos, frame)]


def test_the_geoid_is_far_from_the_ellipsoid_here():
    assert 45 < N < 50  # Carinthia


def test_an_ellipsoidal_height_becomes_one_above_the_geoid_and_stays_otherwise():
    assert heights([rtk(620.0)], "egm96") == pytest.approx([620 - N])
    assert heights([rtk(620.0)], "ellipsoid") == [620.0]
    assert heights([rtk(620.0)], None) == [620.0]


def test_the_barometer_gives_the_shape_and_sea_level_the_zero():
    photos = [drone(60.0, 501.0), drone(62.0, 500.0), drone(64.0, 505.5)]
    # take-off at 441, 438, 441.5: the median
    assert heights(photos, "egm96") == pytest.approx([501.0, 503.0, 505.0])
    assert heights(photos, "ellipsoid") == pytest.approx([501 + N, 503 + N, 505 + N])
    assert heights(photos, "takeoff") == heights(photos, None) == [60.0, 62.0, 64.0]


def test_several_take_off_points_are_not_taken_for_one():
    photos = [drone(60.0, 501.0 + 20 * k) for k in range(6)]
    assert heights(photos, "egm96") == pytest.approx([501.0 + 20 * k for k in range(6)])


def test_a_precise_height_is_not_replaced_by_a_barometer():
    exact = photo(
        position=GeoPosition(
            **PLACE, altitude_m=620.0, datum="ellipsoid", ellipsoid_m=620.0, takeoff_m=63.0
        )
    )
    assert heights([exact, exact], "egm96") == pytest.approx(2 * [620 - N])


def test_methods_of_level_ground_count_from_take_off_where_it_is_told():
    exact = photo(
        position=GeoPosition(
            **PLACE, altitude_m=620.0, datum="ellipsoid", ellipsoid_m=620.0, takeoff_m=63.0
        )
    )
    frame = choose_frame([exact], None, level=True)
    assert frame.vertical_datum == "takeoff"
    assert [p.map_C[2] for p in priors([exact], frame)] == [63.0]
    assert choose_frame([rtk(620.0)], None, level=True).vertical_datum == "ellipsoid"


@pytest.mark.parametrize(
    ("photos", "datum", "words"),
    [
        ([drone(60.0, None)], "egm96", "needs heights above sea level or the ellipsoid"),
        ([rtk(620.0)], "takeoff", "needs heights above take-off"),
        ([photo(position=None)], "egm96", "needs positions"),
    ],
)
def test_what_cannot_be_converted_is_refused(photos, datum, words):
    with pytest.raises(UsageError, match=words):
        choose_frame(photos, None, (), datum)


def point(z, datum="control", check=False):
    seen = (PointObservation(photo="a.jpg", x=1.0, y=1.0),)
    return ControlPoint(
        name="p", x=14.3, y=46.6, z=z, crs="EPSG:4326", datum=datum, observations=seen, check=check
    )


@pytest.mark.parametrize(
    ("stated", "asked", "target", "z"),
    [
        ("egm96", None, "egm96", 440.0),
        ("ellipsoid", None, "ellipsoid", 440.0),
        ("control", None, "control", 440.0),
        ("egm96", "ellipsoid", "ellipsoid", 440 + N),
        ("ellipsoid", "egm96", "egm96", 440 - N),
        ("control", "egm96", "egm96", 440.0),
    ],
)
def test_the_datum_of_control_points_is_respected(stated, asked, target, z):
    one = drone(60.0, 501.0)
    control = (point(440.0, stated),)
    frame = choose_frame([one], None, control, asked)
    assert frame.control_datum == target
    (found,) = control_in_frame(control, [named(one)], frame)
    assert found.xyz[2] == pytest.approx(z)


def named(one):
    from dataclasses import replace

    return replace(one, name="a.jpg")


def test_check_points_are_compared_in_the_datum_of_the_map():
    control = (point(440.0 + N, "ellipsoid", check=True),)
    one = named(drone(60.0, 501.0))
    (found,) = control_in_frame(control, [one], choose_frame([one], None, control, "egm96"))
    assert found.xyz[2] == pytest.approx(440.0)


def test_take_off_and_control_heights_exclude_each_other():
    with pytest.raises(UsageError, match="control points that have heights"):
        choose_frame([drone(60.0, 501.0)], None, (point(440.0),), "takeoff")


def test_the_report_says_what_files_claim():
    told = height_figures([drone(60.0, 501.0), drone(60.0, 503.0)], (), "egm96")
    assert told["claimed"] == {"takeoff": 2, "sea_level": 2}
    assert told["vertical_crs"] == "EPSG:5773"
    assert told["geoid_m"] == pytest.approx(N, abs=0.01)
    assert "442.0 m (from 441.0 to 443.0" in " ".join(told["trust"])
    assert height_figures([drone(60.0, 501.0)], (), "takeoff")["vertical_crs"] is None
    assert np.isfinite(told["geoid_m"])
