"""Pictures that show a small part of another one: simulated truth."""

import cv2
import numpy as np
import pytest

from skyquilt.coregistration.methods import registration_method
from skyquilt.coregistration.points import _levels
from skyquilt.coregistration.usable import usable
from skyquilt.model.registration import Picture
from tests.coregistration.scenes import layout, spectrum, turned

WHOLE = (900, 1080)


def zoomed(times, degrees, *, seed, other, middle=(0.0, 0.0), shape=(300, 360)):
    """A landscape, a part of it `times` as near, in another spectrum or not, and b_H_a."""
    labels = layout(*WHOLE, seed=seed)
    for more in range(1, 6):  # as much in each part as in a whole
        labels = np.where(
            labels % 5 == more - 1, labels + 90 * layout(*WHOLE, seed + 50 * more), labels
        )
    labels = labels % 97
    b_H_a = turned(times * shape[0] / WHOLE[0], degrees, WHOLE, shape, middle)
    fine = spectrum(labels, seed + other, noise=0.0, blur=0.6)
    b = cv2.warpPerspective(fine, b_H_a, shape[::-1], flags=cv2.INTER_CUBIC)
    b += np.random.default_rng(seed).normal(0, 2, shape).astype(np.float32)
    a = spectrum(labels, seed, noise=2.0)
    return *(np.clip(v, 0, 255).astype(np.uint8) for v in (a, b)), b_H_a


@pytest.mark.parametrize("times", [3.5, 8.0])
def test_points_find_a_part_of_one_spectrum(times):
    a, b, truth = zoomed(times, 130.0, seed=2, other=0, middle=(30.0, -20.0))
    one, other = (usable(Picture(values=v)) for v in (a, b))
    points = registration_method("auto").method.points
    ends = np.array([[[0, 0], [359, 0], [359, 299], [0, 299.0]]])
    in_a = cv2.perspectiveTransform(ends, np.linalg.inv(truth))
    for b_H_a in (points(one, other).b_H_a, np.linalg.inv(points(other, one).b_H_a)):
        assert np.abs(cv2.perspectiveTransform(in_a, b_H_a) - ends).max() < 6


def test_other_pictures_have_no_points_in_common():
    a, _, _ = zoomed(4.0, 0.0, seed=2, other=0)
    _, b, _ = zoomed(4.0, 0.0, seed=7, other=0)
    proposal = registration_method("auto").method.points(
        *(usable(Picture(values=v)) for v in (a, b))
    )
    assert proposal.b_H_a is None and proposal.reason


def test_values_of_any_unit_are_seen_alike():
    kelvin = 280 + np.random.default_rng(1).uniform(0, 9, (60, 80)).astype(np.float32)
    valid = np.ones(kelvin.shape, bool)
    levels = _levels(kelvin, valid)
    assert np.abs(levels.astype(int) - _levels(100 * kelvin, valid)).max() <= 1
    assert levels.min() == 0 and levels.max() == 255
    assert _levels(kelvin, ~valid).shape == kelvin.shape


@pytest.mark.slow
@pytest.mark.parametrize("other", [0, 1])
def test_four_times_as_near_is_found_in_either_spectrum(other):
    a, b, truth = zoomed(4.0, 205.0, seed=4, other=other, middle=(-40.0, 25.0))
    found = registration_method("auto")(Picture(values=a), Picture(values=b))
    assert found, found.reason
    px = np.c_[np.array([40, 320, 40, 320.0]), np.array([40, 40, 260, 260.0]), np.ones(4)].T
    there = found.b_H_a @ np.linalg.inv(truth) @ px
    assert np.abs(there[:2] / there[2] - px[:2]).max() < 4
