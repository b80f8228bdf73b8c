"""A compass that is off turns all headings alike, and none of the photos."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.conflicts import conflicts
from skyquilt.alignment.start import common_error_deg
from skyquilt.geometry.frames import angle_difference_deg, angles_from_cam_R_map
from tests.alignment.test_bundle import Flown, relative_error


def compass(flown, off):
    flown.priors = [replace(p, yaw_deg=p.yaw_deg + off) for p in flown.priors]
    return flown


def turn_deg(flown, found):
    """Median error of the headings of the sensors."""
    return float(
        np.median(
            [
                angle_difference_deg(
                    angles_from_cam_R_map(p.cam_R_map)[0],
                    angles_from_cam_R_map(flown.file_pose(i))[0],
                )
                for i, p in found.poses.items()
            ]
        )
    )


@pytest.fixture(scope="module")
def right():
    """A flight with a true compass, and what is found of it."""
    flown = Flown(3, gps=1.5)
    return flown, flown.aligned()


@pytest.mark.slow
@pytest.mark.parametrize("off", [18.0, -12.0, 60.0, 179.0])
def test_a_compass_that_is_off_does_not_turn_the_map(right, off):
    """Eighteen headings of 5 degrees, taken each by itself, turn this map by a fifth of 12."""
    wrong = compass(Flown(3, gps=1.5), off)
    found = wrong.aligned()
    assert abs(turn_deg(wrong, found) - turn_deg(*right)) < 0.35
    assert relative_error(wrong, found) < relative_error(*right) + 0.15
    said = {c.photo for c in conflicts(wrong.photos, wrong.priors, found) if c.field == "yaw"}
    for i, p in enumerate(wrong.priors):
        true = angles_from_cam_R_map(wrong.file_pose(i))[0]
        apart = abs(angle_difference_deg(p.yaw_deg, true))
        named = max(15.0, 3 * p.sigma_yaw_deg)
        if abs(apart - named) > 1.0:  # the map itself is turned by half a degree
            assert (wrong.photos[i].name in said) == (apart > named)


@pytest.mark.slow
@pytest.mark.parametrize("off", [12.0, 0.0, 60.0, 180.0])
def test_files_that_were_turned_are_found_under_a_compass_that_is_off(off):
    turned = (4, 5, 6, 7)
    flown = compass(Flown(1, turned=turned), off)
    found = flown.aligned()
    assert {i for i, camera in found.camera_of.items() if camera.endswith("/turned")} == set(turned)
    assert relative_error(flown, found) < 0.5
    said = {
        c.photo: c.meaning
        for c in conflicts(flown.photos, flown.priors, found)
        if c.field == "yaw" and "upside down" in c.meaning
    }
    assert set(said) == {f"{i:02d}.jpg" for i in turned}


@pytest.mark.parametrize(
    ("off", "whole", "common"),
    [
        ([170, -175, 178, -170], [1, 1, 1, 1], -178.5),  # across the cut
        ([3, 5, 4, 184, 186, 185], [1, 1, 1, 0, 0, 0], 4),  # half of them turned by a viewer
        ([40, 42, 41, 43], [0, 0, 0, 0], 41.5),
        ([181, 182, 179], [0, 0, 0], 0),  # all turned by a viewer: not the compass
        ([181, 182, 179], [1, 1, 1], -179),
        ([0, 90, 180, 270], [1, 1, 1, 1], 0),  # nothing in common
        ([30, 31], [1, 1], 0),  # too few
        ([], [], 0),
    ],
)
def test_what_headings_are_off_in_common(off, whole, common):
    found = common_error_deg(np.array(off, float), [bool(w) for w in whole])
    assert found == pytest.approx(common, abs=2)
    for by in (-100, 33, 250):  # turning all turns the common part
        also = common_error_deg(np.array(off, float) + by, [True] * len(off))
        plain = common_error_deg(np.array(off, float), [True] * len(off))
        if plain:
            assert angle_difference_deg(also, plain + by) == pytest.approx(0, abs=1e-9)
