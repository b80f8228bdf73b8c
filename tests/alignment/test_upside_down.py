"""Files turned upside down that report no heading: found by the lens."""

from dataclasses import replace

import numpy as np
import pytest

import skyquilt.alignment.upside_down as upside_down
from tests.alignment.blocks import LENS
from tests.alignment.test_bundle import Flown, assert_residuals_fit, relative_error, worst_turn_deg

LINE = range(6, 12)
ASIDE = LENS + [0, 5.5, -7.3, 0, 0, 0, 8e-4, -8e-4, 0, 0, 0]
"""A lens whose axis lies one hundredth of the picture beside its middle, as of small cameras."""

MIDDLE = LENS + [0, -2.5, 2.5, 0, 0, 0, 0, 0, 0, 0, 0]


def silent(rewritten=None, turned=(), **options):
    """A flight without reported angles; `rewritten`: photo -> program."""
    flown = Flown(turned=turned, **({"lens": ASIDE, "noise": 0.1} | options))
    flown.priors = [
        replace(p, yaw_deg=np.nan, pitch_deg=0.0, roll_deg=0.0, sigma_tilt_deg=10.0)
        for p in flown.priors
    ]
    if rewritten is not None:
        flown.photos = [replace(p, editor=rewritten.get(i)) for i, p in enumerate(flown.photos)]
    return flown


def turned_in(alignment):
    return {i for i, key in alignment.camera_of.items() if key == "cam/turned"}


@pytest.fixture(scope="module")
def straight():
    flown = silent()
    return flown, flown.aligned()


@pytest.mark.slow
def test_a_turned_line_is_found(straight):
    """The same lens, poses and residuals as of a flight whose files nobody turned."""
    flown = silent(turned=LINE)
    found = flown.aligned()
    assert turned_in(found) == set(LINE)
    assert found.notes[-1].startswith("6 files were turned upside down by another program")
    assert "06.jpg" in found.notes[-1]
    mine, plain = found.cameras["cam"], straight[1].cameras["cam"]
    assert (mine.cx, mine.cy) == pytest.approx((plain.cx, plain.cy), abs=1.0)
    assert mine.focal == pytest.approx(plain.focal, rel=2e-3)
    assert worst_turn_deg(flown, found) == pytest.approx(worst_turn_deg(*straight), abs=0.1)
    assert relative_error(flown, found) < relative_error(*straight) + 0.1
    error, before = (np.sqrt((a.ties.residual_px**2).mean()) for a in (found, straight[1]))
    assert error == pytest.approx(before, rel=0.03)
    assert_residuals_fit(found, (7, 13))


@pytest.mark.slow
def test_files_that_were_only_rewritten_stay(straight):
    flown = silent(dict.fromkeys(LINE, "Some Editor"))
    found = flown.aligned()
    assert not turned_in(found) and not any("upside down" in note for note in found.notes)
    assert relative_error(flown, found) == pytest.approx(relative_error(*straight), abs=1e-9)


@pytest.mark.slow
def test_of_two_programs_the_one_that_turns_is_told():
    names = dict.fromkeys(LINE, "Some Viewer") | dict.fromkeys(range(3), "Some Editor")
    found = silent(names, LINE).aligned()
    assert turned_in(found) == set(LINE)


@pytest.mark.slow
def test_a_lens_in_the_middle_does_not_tell():
    """Nothing is turned on the strength of noise, and nothing depends on it."""
    found = silent(turned=LINE, lens=MIDDLE).aligned()
    assert not turned_in(found)


@pytest.mark.slow
def test_where_all_files_are_rewritten_nothing_is_turned():
    """The picture of a lens is as likely as the same turned."""
    flown = silent(dict.fromkeys(range(18), "Some Viewer"))
    assert not turned_in(flown.aligned())


def test_metadata_that_are_trusted_are_not_asked():
    assert not turned_in(silent(turned=LINE).aligned(repair=False))


@pytest.mark.slow
def test_of_many_photos_some_tell(monkeypatch):
    monkeypatch.setattr(upside_down, "MANY", 4)
    monkeypatch.setattr(upside_down, "ASKED", 5)
    assert turned_in(silent(turned=LINE).aligned()) == set(LINE)
