"""Parts that a guess says two pictures share."""

import cv2
import numpy as np
import pytest

from skyquilt.coregistration.common_part import common_part
from skyquilt.coregistration.methods import registration_method
from skyquilt.model.registration import Guess, Picture
from tests.coregistration.scenes import layout, spectrum, turned

WIDE, NARROW = (900, 1200), (256, 320)


@pytest.fixture(scope="module")
def tele():
    """A narrow thermal view of the middle of a wide visible one: it shows a ninth of it."""
    truth = turned(0.8, 8.0, WIDE, NARROW, (14, -9))
    labels = layout(*WIDE, seed=31)
    for extra in (32, 33, 34):  # details enough for a ninth
        labels = np.where(
            layout(*WIDE, seed=extra) > 0, layout(*WIDE, seed=extra) + 90 * (extra - 31), labels
        )
    a = np.clip(spectrum(labels, 1), 0, 255).astype(np.uint8)
    b = cv2.warpPerspective(
        spectrum(labels, 2), truth, (NARROW[1], NARROW[0]), flags=cv2.INTER_AREA
    )
    return Picture(values=a), Picture(values=np.clip(b, 0, 255).astype(np.uint8)), truth


def test_a_narrow_view_is_found_in_a_wide_one_by_its_guess(tele):
    a, b, truth = tele
    auto = registration_method("auto")
    guess = Guess(b_H_a=turned(0.8, 5.0, WIDE, NARROW), reach=0.15)
    found = auto(a, b, guess)
    assert found, found.reason
    middle = np.linalg.inv(truth)
    for px in ([40, 40], [280, 40], [40, 220], [280, 220]):
        in_a = middle @ [*px, 1]
        there = found.b_H_a @ (in_a / in_a[2])
        assert np.hypot(*(there[:2] / there[2] - px)) < 0.5
    inside = np.linalg.norm(
        (np.c_[found.px_a, np.ones(len(found.px_a))] @ truth.T)[:, :2] - found.px_b, axis=1
    )
    assert np.median(inside) < 1


def test_the_part_holds_all_that_the_reach_allows(tele):
    a, b, truth = tele
    guess = Guess(b_H_a=turned(0.8, 8.0, WIDE, NARROW), reach=0.1)
    part = common_part(a, b, guess)
    rows, columns = part.a.shape
    assert part.b.shape == NARROW and rows < 600 and columns < 700
    corners = np.linalg.inv(truth) @ np.array([[0, 320, 0, 320], [0, 0, 256, 256], [1, 1, 1, 1.0]])
    inside = corners[:2].T / corners[2:].T - part.shift_a
    assert (inside >= 0).all() and (inside <= [columns, rows]).all()
    x, y = part.shift_a.astype(int)
    assert (part.a.values == a.values[y : y + rows, x : x + columns]).all()
    there = part.guess.b_H_a @ [100, 100, 1]
    whole = guess.b_H_a @ [100 + x, 100 + y, 1]
    assert np.allclose(there[:2] / there[2], whole[:2] / whole[2])


def test_equal_views_stay_whole():
    a = Picture(values=np.zeros((300, 400), np.uint8))
    part = common_part(a, a, Guess(b_H_a=np.eye(3)))
    assert part.a.shape == part.b.shape == (300, 400) and not part.shift_a.any()
