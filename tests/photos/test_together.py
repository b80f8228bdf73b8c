"""Who was taken together: names, times, and what speaks against them."""

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

from skyquilt.model.photo import Focal, GeoPosition, Photo
from skyquilt.photos.together import late_by, taken_together

NOON = datetime(2024, 6, 1, 12)


def photo(name, seconds=None, east_m=None):
    position = None
    if east_m is not None:
        position = GeoPosition(
            latitude_deg=0, longitude_deg=east_m / 111319.5, altitude_m=50, datum="takeoff"
        )
    return Photo(
        name=name,
        path=Path(name),
        digest=name,
        width=640,
        height=512,
        channels=1,
        dtype="uint8",
        band="visible",
        camera_key="c",
        focal=Focal(px=700, sigma_px=70, source="guess"),
        position=position,
        attitude=None,
        time=None if seconds is None else NOON + timedelta(seconds=seconds),
    )


def test_by_names_that_differ_in_letters_only():
    a = [photo(f"DJI_2024_{k:04d}_W.JPG") for k in range(4)]
    b = [photo(f"DJI_2024_{k:04d}_T.JPG") for k in (3, 1, 7)]
    assert taken_together(a, b) == [(3, 0), (1, 1)]


def test_by_times_each_photo_once():
    a = [photo(f"DJI_{2 * k}.JPG", 2.0 * k) for k in range(4)]
    b = [photo(f"DJI_{2 * k + 1}.JPG", 2.0 * k + 0.3) for k in range(4)] + [
        photo("DJI_99.JPG", 0.4)
    ]
    assert taken_together(a, b) == [(0, 0), (1, 1), (2, 2), (3, 3)]


def test_of_a_fast_camera_the_photo_nearest_in_time_counts():
    """It exposes five times a second, and began before the other one."""
    a = [photo(f"A{k}.JPG", 2.0 * k + 0.61) for k in range(4)]
    b = [photo(f"B{100 + k}.JPG", 0.2 * k) for k in range(40)]
    assert taken_together(a, b) == [(0, 3), (1, 13), (2, 23), (3, 33)]


def test_equal_names_of_another_flight_are_chance():
    a = [photo(f"SIM_{k}.jpg", 3.0 * k) for k in range(4)]
    assert taken_together(a, [photo(f"SIM_{k}.jpg", 3.0 * k + 3600) for k in range(4)]) == []
    a = [photo(f"SIM_{k}.jpg", east_m=10.0 * k) for k in range(4)]
    assert taken_together(a, [photo(f"SIM_{k}.jpg", east_m=10.0 * k + 7) for k in range(4)]) == []
    assert (
        len(taken_together(a, [photo(f"SIM_{k}.jpg", east_m=10.0 * k + 1) for k in range(4)])) == 4
    )


def test_of_a_wide_and_a_zoom_camera_the_wide_one_counts():
    """All three files of one trigger have the same number and time; the zoom's may show no more
    than a part of the thermal picture.
    """
    zoom = Focal(px=3000, sigma_px=70, source="guess")
    wide = [photo(f"DJI_{k:04d}_W.JPG", 3.0 * k) for k in range(4)]
    near = [
        replace(photo(f"DJI_{k:04d}_Z.JPG", 3.0 * k), focal=zoom, camera_key="z") for k in range(4)
    ]
    heat = [photo(f"DJI_{k:04d}_T.JPG", 3.0 * k) for k in (3, 1)]
    unnamed = [photo(f"heat{name}.tif", 3.0 * k) for name, k in zip("ab", (3, 1), strict=True)]
    for b in (heat, unnamed):
        assert taken_together([*near, *wide], b) == [(7, 0), (5, 1)]
        assert taken_together([*wide, *near], b) == [(3, 0), (1, 1)]


def test_how_late_a_camera_with_a_clock_of_its_own_is_beside_its_median():
    a = [photo(f"A_{k}.jpg", 2.0 * k + 0.125) for k in range(4)]
    late = [0.25, 0.0, -0.125, 0.125]
    b = [photo(f"B_{k}.jpg", 2.0 * k + 0.5 + s) for k, s in enumerate(late)]
    assert late_by(a, b).tolist() == [s - 0.0625 for s in late]
    whole = [photo(f"B_{k}.jpg", 2.0 * k) for k in range(4)]
    untimed = [photo(f"B_{k}.jpg") for k in range(4)]
    assert not late_by(a, whole).any() and not late_by(a, untimed).any()
