"""Positions that are wrong, of two sites, rounded, or repeated."""

import numpy as np
import piexif
import pytest
from pyproj import Geod

from skyquilt.photos.read import read_photo
from skyquilt.photos.survey import read_survey

from .conftest import dji_exif, dji_xmp, gps_exif

STATED_M = 5.0
"""Deviation of a position in EXIF that states none."""


def photo_at(make_jpeg, number, latitude, longitude, drone=False):
    """A photo with its position in XMP (as a drone states it) or in EXIF, five seconds after the
    one before.
    """
    taken = f"2020:06:01 10:{number // 12:02d}:{number * 5 % 60:02d}"
    exif = dji_exif(Exif={piexif.ExifIFD.DateTimeOriginal: taken})
    exif["GPS"] = gps_exif(latitude, longitude)
    xmp = dji_xmp(GpsLatitude=f"{latitude:.9f}", GpsLongitude=f"{longitude:.9f}") if drone else None
    return make_jpeg(f"{number:03d}.jpg", exif=exif, xmp=xmp, seed=number).parent


def placed(survey):
    return [p.name for p in survey.photos if p.position]


@pytest.mark.parametrize(("first", "second"), [(6, 4), (4, 6), (5, 5)])
def test_the_larger_of_two_sites_is_mapped_and_the_other_is_named_once(make_jpeg, first, second):
    for i in range(first + second):
        latitude = 46.6 + 0.27 * (i >= first) + i * 0.000123
        folder = photo_at(make_jpeg, i, latitude, 14.3)
    survey = read_survey(folder)
    mapped = range(first) if first >= second else range(first, first + second)
    assert placed(survey) == [f"{i:03d}.jpg" for i in mapped]
    (note,) = [n for n in survey.notes if "another site" in n]
    away = Geod(ellps="sphere").inv(14.3, 46.6, 14.3, 46.87)[2] / 1000
    assert f"lie {away:.0f} km from the {max(first, second)} others" in note
    assert note.startswith(f"{min(first, second)} photos")


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ((-1, 1), "north and south"),
        ((1, -1), "east and west"),
        ((-1, -1), "north and south, east and west"),
        (None, "latitude and longitude"),
    ],
)
@pytest.mark.parametrize("drone", [False, True])
def test_signs_that_some_positions_lost_are_given_back(make_jpeg, kind, words, drone):
    """A program that rewrites photos loses the letters S and W of some."""
    true = [(-33.9 + i * 0.000123, -70.6 + i * 0.00007) for i in range(9)]
    for i, (north, east) in enumerate(true):
        place = (north, east) if i < 6 else (east, north)
        if kind and i >= 6:
            place = north * kind[0], east * kind[1]
        folder = photo_at(make_jpeg, i, *place, drone)
    survey = read_survey(folder)
    for photo, place in zip(survey.photos, true, strict=True):
        found = photo.position.latitude_deg, photo.position.longitude_deg
        assert found == pytest.approx(place, abs=1e-6)
    (note,) = [n for n in survey.notes if "exchanged" in n]
    assert note.startswith("3 photos (006.jpg") and f"once {words} are exchanged" in note


def survey_at_heights(make_jpeg, heights):
    """The survey of photos with these heights above sea level in m."""
    for i, height in enumerate(heights):
        exif = dji_exif()
        exif["GPS"] = gps_exif(46.6 + i * 0.000123, 14.3, height)
        folder = make_jpeg(f"{i:03d}.jpg", exif=exif, seed=i).parent
    return read_survey(folder)


@pytest.mark.parametrize(
    ("low", "wrong", "sign"),
    [(20, 5, 1), (300, 4, 1), (460, 7, 1), (-420, 3, -1), (-80, 4, -1), (90, 1, 1)],
)
def test_heights_of_the_other_sign_are_turned_round(make_jpeg, low, wrong, sign):
    """Ten photos of which some have lost EXIF's `GPSAltitudeRef`, or got it. Below 430 m under the
    sea there is no land, so that most may be wrong.
    """
    true = [low + 1.5 * i for i in range(10)]
    survey = survey_at_heights(make_jpeg, [-h if i < wrong else h for i, h in enumerate(true)])
    for photo, height in zip(survey.photos, true, strict=True):
        assert photo.position.altitude_m == photo.position.sea_level_m == pytest.approx(height)
    (note,) = [n for n in survey.notes if "sign" in n]
    assert note.startswith(f"In {wrong} of 10 photos (000.jpg") and "geo.txt" in note


@pytest.mark.parametrize("unknown", [(3,), (0, 2, 4), range(1, 9)])
@pytest.mark.parametrize("height", [500.0, 61.0, -55.0])
def test_a_height_of_zero_among_others_is_none(make_jpeg, unknown, height):
    true = [height + i for i in range(9)]
    survey = survey_at_heights(make_jpeg, [0 if i in unknown else h for i, h in enumerate(true)])
    for i, photo in enumerate(survey.photos):
        want = None if i in unknown else pytest.approx(true[i])
        assert photo.position.altitude_m == photo.position.sea_level_m == want
        assert photo.position.datum == ("unknown" if i in unknown else "sea_level")
    (note,) = [n for n in survey.notes if "exactly 0" in n]
    assert note.startswith(f"In {len(unknown)} of 9 photos (")


@pytest.mark.parametrize(
    "heights",
    [
        [0, 0, 0, 0],
        [-2, 0, 3, 6, 9],  # at the sea
        [-6, -3, 4, 7, 9],  # over a polder, by a poor receiver
        [60, 31, 4, -27, -54],  # a drift
        [120, 400, 700, -30, 120],
    ],
)
def test_heights_on_both_sides_of_the_sea_level_stay(make_jpeg, heights):
    survey = survey_at_heights(make_jpeg, heights)
    assert [p.position.altitude_m for p in survey.photos] == pytest.approx(heights)
    assert not any("sign" in n or "exactly" in n for n in survey.notes)


def test_an_old_position_that_is_repeated_is_no_site(make_jpeg):
    for i in range(9):
        folder = photo_at(make_jpeg, i, 47.9 if i < 3 else 46.6 + i * 0.000123, 14.3)
    survey = read_survey(folder)
    assert placed(survey) == [f"{i:03d}.jpg" for i in range(3, 9)]
    assert sum("from the others" in n for n in survey.notes) == 3


def test_a_flight_over_the_meridian_of_180_degrees_is_one_site(make_jpeg):
    for i in range(8):
        longitude = 179.9993 + i * 0.000213
        longitude -= 360 * (longitude > 180)
        folder = photo_at(make_jpeg, i, -17.0, longitude)
    assert len(placed(read_survey(folder))) == 8


@pytest.mark.parametrize("step", [1e-3, 1e-4, 1 / 3600])
def test_rounded_positions_are_as_uncertain_as_rounding_makes_them(make_jpeg, step):
    rng = np.random.default_rng(3)
    true = np.array([46.6, 14.3]) + rng.uniform(0, 0.02, (6, 2))
    for i, (latitude, longitude) in enumerate(np.round(true / step) * step):
        folder = photo_at(make_jpeg, i, latitude, longitude)
    survey = read_survey(folder)
    many = rng.uniform(0, 1, 100_000)
    sigma = max(float(np.std(np.round(many / step) * step - many)) * 111_320, STATED_M)
    assert [p.position.sigma_xy_m for p in survey.photos] == pytest.approx([sigma] * 6, rel=0.01)
    assert any("rounded" in n for n in survey.notes) == (sigma > STATED_M)


def test_positions_of_a_receiver_are_not_taken_for_rounded_ones(make_jpeg):
    for i, north in enumerate(np.random.default_rng(5).uniform(0, 0.001, 6)):
        folder = photo_at(make_jpeg, i, 46.6 + round(north, 6), 14.3)
    survey = read_survey(folder)
    assert {p.position.sigma_xy_m for p in survey.photos} == {STATED_M}
    assert not any("rounded" in n for n in survey.notes)


def test_a_repeated_position_is_as_uncertain_as_the_way_to_the_next(make_jpeg):
    """Four photos in a line, each place stated three times; the last ones have no next."""
    places = [46.6 + 0.000213 * (i // 3) * (1 + i // 6) for i in range(12)]
    for i, latitude in enumerate(places):
        folder = photo_at(make_jpeg, i, latitude, 14.3, drone=True)
    survey = read_survey(folder)
    found = [p.position.sigma_xy_m for p in survey.photos]
    stated = found[0]
    steps = np.diff(np.unique(places)) * 111_320
    for run, way in enumerate([*steps, steps[-1]]):
        assert found[3 * run] == stated
        assert found[3 * run + 1 : 3 * run + 3] == pytest.approx([way] * 2, rel=1e-3)
    assert any("8 photos" in n and "repeat" in n for n in survey.notes)


def test_positions_of_a_receiver_that_stopped_are_as_uncertain_as_the_way_flown_since(make_jpeg):
    """Nine photos after the last new position, at the usual steps: a bent map rested on them."""
    places = [46.6 + 0.0001 * min(i, 5) for i in range(15)]
    for i, latitude in enumerate(places):
        folder = photo_at(make_jpeg, i, latitude, 14.3, drone=True)
    found = [p.position.sigma_xy_m for p in read_survey(folder).photos]
    assert found[:6] == [found[0]] * 6
    assert found[6:] == pytest.approx([9 * 0.0001 * 111_320] * 9, rel=1e-3)


def test_a_missing_reference_of_a_position_is_told(make_jpeg):
    exif = dji_exif()
    told = read_photo(make_jpeg("told.jpg", exif=exif))
    del exif["GPS"][piexif.GPSIFD.GPSLongitudeRef]
    path = make_jpeg("untold.jpg", exif=exif, seed=2)
    assert not any("north and east are assumed" in n for n in told.notes)
    assert any("north and east are assumed" in n for n in read_photo(path).notes)
    assert any("1 photos do not say" in n for n in read_survey(path.parent).notes)


def survey_with(make_jpeg, told, number=6):
    """A line of photos whose GPS directories have further tags, by photo."""
    for k in range(number):
        gps = gps_exif(46.5 + 1e-4 * k, -92.0) | told.get(k, {})
        exif = dji_exif(GPS=gps)
        exif["Exif"][piexif.ExifIFD.DateTimeOriginal] = f"2016:06:23 16:31:{k:02d}"
        path = make_jpeg(exif=exif, name=f"{k}.jpg", seed=k)
    return read_survey(path.parent)


@pytest.mark.parametrize(
    ("told", "wider", "word"),
    [
        ({piexif.GPSIFD.GPSStatus: "V"}, (20, 20), "GPSStatus V"),
        ({piexif.GPSIFD.GPSMeasureMode: "2"}, (1, 20), "GPSMeasureMode 2"),
        ({piexif.GPSIFD.GPSDOP: (30, 1)}, (4, 4), ""),
        ({piexif.GPSIFD.GPSDOP: (9, 4), piexif.GPSIFD.GPSStatus: "A"}, (1, 1), ""),
    ],
)
def test_what_a_receiver_did_not_measure_counts_for_little(make_jpeg, told, wider, word):
    survey = survey_with(make_jpeg, {1: told, 4: told})
    assert not survey_notes_about(survey, "GPS") or word
    usual, *_ = (p.position for p in survey.photos)
    for k, photo in enumerate(survey.photos):
        xy, z = wider if k in (1, 4) else (1, 1)
        assert photo.position.sigma_xy_m == pytest.approx(xy * usual.sigma_xy_m)
        assert photo.position.sigma_z_m == pytest.approx(z * usual.sigma_z_m)
    named = survey_notes_about(survey, word) if word else []
    assert [("1.jpg" in n, "4.jpg" in n) for n in named] == [(True, True)] * bool(word)


@pytest.mark.parametrize("tag", [piexif.GPSIFD.GPSStatus, piexif.GPSIFD.GPSMeasureMode])
def test_a_camera_that_always_says_so_tells_nothing(make_jpeg, tag):
    told = {tag: "V" if tag == piexif.GPSIFD.GPSStatus else "2"}
    survey = survey_with(make_jpeg, dict.fromkeys(range(5), told))
    assert len({p.position.sigma_z_m for p in survey.photos}) == 1
    assert not survey_notes_about(survey, "measured no")


def survey_notes_about(survey, word):
    return [n for n in survey.notes if word in n]
