"""What metadata imply, against two simulated cameras that look straight down."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skyquilt.coregistration.pictures import from_metadata, of_photo
from skyquilt.model.photo import Attitude, Focal, GeoPosition, Photo

LATITUDE, LONGITUDE = 46.5, -92.0
METRES = np.pi / 180 * 6378137


def photo(east, north, height, yaw, focal, width, rows, source="sensor"):
    return Photo(
        name="x",
        path=Path("x.jpg"),
        digest="",
        width=width,
        height=rows,
        channels=1,
        dtype="uint8",
        band="visible",
        camera_key="",
        focal=Focal(px=focal, sigma_px=1, source=source),
        position=GeoPosition(
            latitude_deg=LATITUDE + north / METRES,
            longitude_deg=LONGITUDE + east / METRES / np.cos(np.radians(LATITUDE)),
            altitude_m=height,
            datum="takeoff",
            takeoff_m=height,
        ),
        attitude=Attitude(yaw_deg=yaw, pitch_deg=0, roll_deg=0),
        time=None,
    )


def seen(ground, camera, at):
    """Pixels of ground points (n, 2: east, north) of a camera that looks straight down; top along
    the yaw.
    """
    east, north, height, yaw, focal, width, rows = camera
    off, y = ground - [east, north], np.radians(yaw)
    right, up = off @ [np.cos(y), -np.sin(y)], off @ [np.sin(y), np.cos(y)]
    return np.c_[(width - 1) / 2 + focal / height * right, (rows - 1) / 2 - focal / height * up]


A = (0.0, 0.0, 60.0, 40.0, 1500.0, 1000, 750)
B = (6.0, -4.0, 50.0, -75.0, 800.0, 640, 512)


def test_the_guess_is_what_the_cameras_see():
    guess = from_metadata(photo(*A), photo(*B))
    ground = np.array([[0.0, 0], [5, 3], [-4, 6], [8, -9]])
    a, b = seen(ground, A, None), seen(ground, B, None)
    there = np.c_[a, np.ones(4)] @ guess.b_H_a.T
    assert np.abs(there[:, :2] - b).max() < 0.05
    assert "positions" in guess.source and "yaws" in guess.source


def test_what_is_not_stated_is_taken_as_equal():
    a, b = photo(*A), photo(*B)
    guess = from_metadata(replace(a, attitude=None), replace(b, position=None))
    assert guess.source == "the photos' metadata (focal lengths)"
    assert np.hypot(*guess.b_H_a[:2, 0]) == pytest.approx(800 / 1500)
    assert guess.b_H_a[1, 0] == 0
    assert np.allclose(guess.b_H_a @ [499.5, 374.5, 1], [319.5, 255.5, 1])


def test_guessed_focal_lengths_and_photos_far_apart_say_nothing():
    assert from_metadata(photo(*A, source="guess"), photo(*B)) is None
    assert from_metadata(photo(*A), photo(400.0, *B[1:])) is None


def test_a_camera_is_known_by_its_focal_length():
    """A picture without one may be a map, or of a camera whose lens was taken out of it."""
    told, guessed = photo(*A), photo(*A, source="guess")
    values = np.zeros((750, 1000), np.uint8)
    assert of_photo(told, values).through_lens and not of_photo(guessed, values).through_lens
    assert of_photo(replace(guessed, unit="degC"), values).through_lens
