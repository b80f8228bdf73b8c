"""Frames and priors against pyproj and plain geography."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Geod, Transformer

from skyquilt.alignment.priors import choose_frame, priors, stretch, stretch_warnings, utm_epsg
from skyquilt.errors import UsageError
from skyquilt.model.photo import Attitude, ControlPoint, GeoPosition
from tests.alignment.surveys import photo

places = (st.floats(-79, 79), st.floats(-179.9, 179.9))


def at(latitude, longitude, **more):
    return photo(
        position=GeoPosition(
            latitude_deg=latitude,
            longitude_deg=longitude,
            **{"altitude_m": 60.0, "datum": "takeoff", **more},
        )
    )


@pytest.mark.parametrize(
    ("latitude", "longitude", "code"),
    [
        (50.8, -0.14, 32630),
        (50.8, 0.14, 32631),
        (-33.9, 18.4, 32734),
        (0.0, -180.0, 32601),
        (-0.1, 179.99, 32760),
        (64.1, -21.9, 32627),
        (-54.8, -68.3, 32719),
        (10.0, 180.0, 32601),
    ],
)
def test_utm_zones(latitude, longitude, code):
    assert utm_epsg(latitude, longitude) == f"EPSG:{code}"


@pytest.mark.parametrize("east", [179.9995, 179.9999, -179.9999])
def test_a_flight_over_the_meridian_of_180_degrees_has_its_frame_there(east):
    flown = [(east + 0.0001 * i + 180) % 360 - 180 for i in range(-4, 4)]
    frame = choose_frame([at(-17.0, longitude) for longitude in flown], None)
    assert frame.crs in ("EPSG:32760", "EPSG:32701")
    to_map = Transformer.from_crs(4326, frame.crs, always_xy=True)
    x, y = to_map.transform(flown, [-17.0] * len(flown))
    assert np.hypot(np.array(x) - frame.origin[0], np.array(y) - frame.origin[1]).max() < 200


@settings(max_examples=60, deadline=None)
@given(*places)
def test_the_zone_holds_its_place(latitude, longitude):
    area = CRS.from_user_input(utm_epsg(latitude, longitude)).area_of_use
    assert area.west - 1e-9 <= longitude <= area.east + 1e-9 or area.west > area.east
    assert area.south <= latitude <= area.north


@settings(max_examples=60, deadline=None)
@given(st.floats(-75, 75), st.floats(-179, 179), st.floats(-180, 180))
def test_grid_yaw_is_where_a_step_that_way_leads(latitude, longitude, yaw):
    """A metre along a true heading, projected: the map's direction is the prior's yaw (sign of the
    convergence).
    """
    there = photo(
        position=GeoPosition(
            latitude_deg=latitude, longitude_deg=longitude, altitude_m=60.0, datum="takeoff"
        ),
        attitude=Attitude(yaw_deg=yaw, pitch_deg=3.0, roll_deg=-2.0),
    )
    frame = choose_frame([there], None)
    (prior,) = priors([there], frame)
    lon, lat, _ = Geod(ellps="WGS84").fwd(longitude, latitude, yaw, 10.0)
    to_map = Transformer.from_crs(4326, frame.crs, always_xy=True)
    (x0, y0), (x1, y1) = to_map.transform(longitude, latitude), to_map.transform(lon, lat)
    expected = np.degrees(np.arctan2(x1 - x0, y1 - y0))
    assert (prior.yaw_deg - expected + 180) % 360 - 180 == pytest.approx(0, abs=2e-3)
    assert prior.map_C[:2] + frame.origin == pytest.approx([x0, y0], abs=1e-6)
    assert np.abs(prior.map_C[:2]).max() <= 50.001 and prior.map_C[2] == 60.0
    assert (prior.pitch_deg, prior.roll_deg) == (3.0, -2.0)


def test_a_crs_asked_for():
    here = [at(50.8, -0.14)]
    assert choose_frame(here, "EPSG:27700").crs == "EPSG:27700"
    frame = choose_frame(here, "EPSG:27700")
    x, y = Transformer.from_crs(4326, 27700, always_xy=True).transform(-0.14, 50.8)
    assert priors(here, frame)[0].map_C[:2] + frame.origin == pytest.approx([x, y], abs=1e-6)


@pytest.mark.parametrize(
    ("crs", "words"),
    [
        ("EPSG:999999", "not a coordinate system"),
        ("nonsense", "not a coordinate system"),
        ("EPSG:4326", "not projected in metres"),
        ("EPSG:2263", "not projected in metres"),
        ("EPSG:4978", "not projected"),
        ("EPSG:5773", "not projected"),
        ("EPSG:32630+5773", "what heights count from .* horizontal part, EPSG:32630"),
    ],
)
def test_a_crs_that_will_not_do(crs, words):
    with pytest.raises(UsageError, match=words):
        choose_frame([at(50.8, -0.14)], crs)


@pytest.mark.parametrize(
    ("crs", "place", "words"),
    [
        ("EPSG:6933", (46.6, 14.3), "stretches a metre at 46.60, 14.30 to 0.79 m one way"),
        ("EPSG:4087", (60.0, 14.3), "to 1.00 m one way and to 1.99 m the other"),
        ("EPSG:2048", (-33.9, 19.0), "axes that do not point east and north"),  # west, south
        ("EPSG:5513", (50.0, 14.0), "axes that do not point east and north"),  # south, west
        ("EPSG:3031", (50.8, -0.14), "stretches a metre|has no coordinates"),
    ],
)
def test_a_crs_that_does_not_suit_the_place(crs, place, words):
    """Maps were mirrored in South Africa."""
    with pytest.raises(UsageError, match=words):
        choose_frame([at(*place)], crs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("crs", "place", "told"),
    [
        ("EPSG:2056", (46.6, 8.0), False),
        ("EPSG:5514", (50.0, 14.0), False),  # Krovak, north 8 degrees off the grid
        ("EPSG:32661", (85.0, 30.0), False),  # the pole's own, turned by 30 degrees
        ("EPSG:31467", (50.0, 9.0), False),  # northing is named first
        ("EPSG:3577", (-42.0, 147.0), True),  # Albers: 2.6 % at Tasmania
        ("EPSG:3034", (46.0, 14.0), True),  # 3.1 %
        ("EPSG:3857", (50.8, -0.14), True),  # Web Mercator: 58 %, whichever way
    ],
)
def test_a_crs_that_keeps_shapes_is_taken_and_told(crs, place, told):
    frame = choose_frame([at(*place)], crs)
    warnings = stretch_warnings(frame)
    assert len(warnings) == told
    if crs == "EPSG:3857":
        assert "is 1.5" in warnings[0] and "heights" in warnings[0]
    lat, lon = place
    found = stretch(crs, lat, lon)
    to = Transformer.from_crs(4326, crs, always_xy=True)
    a, b = (lon, lat), Geod(ellps="WGS84").fwd(lon, lat, 37.0, 100.0)[:2]
    way = np.array(to.transform(*b)) - to.transform(*a)
    east, north = np.sin(np.radians(37.0)) * 100, np.cos(np.radians(37.0)) * 100
    assert way == pytest.approx(found @ [east, north], abs=0.02)


def test_without_positions_the_control_points_give_the_frame():
    nothing = photo(position=None)
    point = ControlPoint(
        name="a", x=500000.0, y=5600000.0, z=3.0, crs="EPSG:32630", observations=()
    )
    assert choose_frame([nothing], None, [point]).crs == "EPSG:32630"
    frame = choose_frame([nothing], None)
    assert frame.crs is None
    (prior,) = priors([nothing], frame)
    assert np.isnan(prior.map_C).all() and np.isnan(prior.yaw_deg)


def test_the_median_place_outvotes_a_stray():
    photos = [at(50.8, -0.14 - 1e-4 * k) for k in range(5)] + [at(0.0, 100.0)]
    assert choose_frame(photos, None).crs == "EPSG:32630"


def test_heights_of_the_majority_s_datum():
    """Heights above take-off of two; the third's own is above the sea, but it also states one above
    take-off.
    """
    photos = [
        at(50.8, -0.14),
        at(50.8, -0.14),
        at(50.8, -0.14, altitude_m=170.0, datum="sea_level", takeoff_m=61.5),
        at(50.8, -0.14, altitude_m=170.0, datum="sea_level"),
    ]
    photos = photos[:2] + photos
    frame = choose_frame(photos, None)
    assert frame.vertical_datum == "takeoff"
    z = [p.map_C[2] for p in priors(photos, frame)]
    assert z[:5] == [60.0, 60.0, 60.0, 60.0, 61.5] and np.isnan(z[5])


def test_the_flight_s_heading_stands_in_for_the_camera_s():
    plain = photo(attitude=None, flight_yaw_deg=90.0)
    frame = choose_frame([plain], None)
    (prior,) = priors([plain], frame)
    assert prior.yaw_deg == pytest.approx(90.0 - frame.convergence_deg)
    assert prior.yaw_source == "xmp-flight" and prior.sigma_yaw_deg == 15.0


def test_heights_without_positions_tell_the_scale():
    """Where no photo has a position they are the map's heights; where others have, they are
    converted as theirs are, or unknown.
    """
    bare = [photo(position=None, height_m=h) for h in (58.0, 61.0)]
    frame = choose_frame([*bare, photo(position=None)], None)
    assert (frame.crs, frame.vertical_datum, frame.metric) == (None, "takeoff", True)
    told = priors([*bare, photo(position=None)], frame)
    assert [p.map_C[2] for p in told[:2]] == [58.0, 61.0]
    assert np.isnan(told[0].map_C[:2]).all() and np.isnan(told[2].map_C[2])
    for others, height in (
        (at(50.8, -0.14), 58.0),
        (at(50.8, -0.14, altitude_m=160.0, datum="sea_level", sea_level_m=160.0), np.nan),
    ):
        mixed = [others, bare[0]]
        (_, prior) = priors(mixed, choose_frame(mixed, None))
        assert prior.map_C[2] == pytest.approx(height, nan_ok=True)
    assert not choose_frame([photo(position=None)], None).metric
