"""Digital zooms that nothing tells: found by what they do to the adjustment, and flights at several
heights, which look alike, are none.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.enlarged import enlarged_photos
from skyquilt.model.poses import no_ties
from tests.alignment.blocks import FOCAL, LENS
from tests.alignment.test_bundle import Flown
from tests.alignment.test_late_positions import LINES, block, told_at


def enlarge(flown, factors):
    """Photos enlarged about the principal point: what a digital zoom does."""
    for i, f in enumerate(factors):
        px = LENS[1:3] + f * (flown.features[i].px - LENS[1:3])
        flown.features[i] = replace(flown.features[i], px=px)


def without_heights(flown):
    flown.priors = [
        replace(p, map_C=np.r_[p.map_C[:2], np.nan], sigma_C=np.r_[p.sigma_C[:2], np.inf])
        for p in flown.priors
    ]


@pytest.mark.slow
@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("factors", [(1.0, 1.4), (1.0, 1.3, 1.7)])
def test_photos_that_are_enlarged_are_calibrated_by_themselves(told, factors):
    flown = Flown(1, lines=4, per_line=6, points=500, gps=0.5)
    each = np.resize(factors, len(flown.photos))
    enlarge(flown, each)
    if not told:
        without_heights(flown)
    found = flown.aligned()
    assert sum("a digital zoom or a crop" in n for n in found.notes) == 1
    assert len(set(found.camera_of.values())) == len(factors)
    for i, f in enumerate(each):
        assert found.camera(i).focal == pytest.approx(f * FOCAL, rel=0.03)
    C = np.array([found.poses[i].map_C for i in range(len(each))])
    off = C - flown.truth.C
    assert np.hypot(*(off - off.mean(0))[:, :2].T).max() < 0.5
    assert np.ptp(off[:, 2]) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("told", [True, False])
def test_flights_at_two_heights_are_no_zoom(told):
    flown = Flown(2, lines=4, per_line=6, points=500, gps=0.5, heights=(45.0, 70.0))
    if not told:
        without_heights(flown)
    found = flown.aligned()
    assert not any("zoom" in n for n in found.notes)
    assert len(found.cameras) == 1


def test_groups_are_those_that_were_made():
    names = ["A"] * len(LINES)
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(0, 0.4, len(LINES))
        each = np.resize([1.0, 1.25, 1.6], len(LINES))
        seen = np.column_stack([LINES[:, :2], LINES[:, 2] / each + noise])
        found = enlarged_photos(block(seen), names, told_at(LINES, 0.5, seed))
        assert found.keys() == set(np.flatnonzero(each > 1))
        assert all(found[i] == pytest.approx(each[i], rel=0.04) for i in found)


@pytest.mark.parametrize("seed", range(6))
def test_heights_that_scatter_tell_a_zoom_by_their_means(seed):
    """Heights of a receiver, good to 6 m: no groups of their own. Two flights are none, either."""
    names, each = ["A"] * len(LINES), np.resize([1.0, 1.4], len(LINES))
    noise = np.random.default_rng(seed).normal(0, 0.4, len(LINES))
    lower = np.column_stack([LINES[:, :2], LINES[:, 2] / each + noise])
    found = enlarged_photos(block(lower), names, told_at(LINES, 6.0, seed))
    assert found.keys() == set(np.flatnonzero(each > 1))
    assert all(found[i] == pytest.approx(1.4, rel=0.12) for i in found)
    assert not enlarged_photos(block(lower), names, told_at(lower, 6.0, seed))


@pytest.mark.parametrize("kind", ["level", "drift", "told", "few", "no ties", "another camera"])
def test_what_is_no_group(kind):
    """Among them flights of two heights that files tell, and drifting heights in files."""
    n, names = len(LINES), ["A"] * len(LINES)
    two = LINES + np.outer(np.resize([0, 25], n), [0, 0, 1])
    told, seen = told_at(LINES, 0.5, 1), LINES
    if kind == "drift":
        told = told_at(LINES + np.outer(np.repeat([0, -25, 25, 40], n // 4), [0, 0, 1]), 0.5, 1)
        seen = LINES + np.outer(np.linspace(0, 8, n), [0, 0, 1])
    if kind in ("told", "no ties", "another camera"):
        seen = two
    if kind == "told":
        told = told_at(two, 0.5, 1)
    if kind == "few":
        seen = LINES.copy()
        seen[:2, 2] *= 0.6
    if kind == "another camera":
        names = ["A", "B"] * (n // 2)
    found = block(seen)
    if kind == "no ties":
        found = replace(found, ties=no_ties())
    assert enlarged_photos(found, names, told) == {}
