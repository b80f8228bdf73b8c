"""Offsets of known size are found again; the level stays; what overlaps cannot tell is left
alone.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from skyquilt.model.raster import Window
from skyquilt.ortho.drift import Drift, Overlaps, overlaps, solved
from skyquilt.ortho.exposure import NEUTRAL, Exposure
from skyquilt.ortho.frame_pattern import medians, sized
from skyquilt.ortho.radiometry import drift_of
from skyquilt.settings import PictureSettings
from tests.ortho.scenes import FLAT, GRID, block, composer, photograph, view


def heat(shot):
    """Degrees Celsius, 5 to 55."""
    return (5 + photograph(shot) / 5).astype(np.float32)


@pytest.fixture(scope="module")
def drifted():
    """Six frames of one ground, each off by an amount of its own."""
    views = block()
    rng = np.random.default_rng(3)
    true = {v.photo: float(rng.normal(0, 1.5)) for v in views}
    noise = rng.normal(0, 0.1, (len(views), 300, 400)).astype(np.float32)
    frames = {v.photo: heat(v) + np.float32(true[v.photo]) + noise[k] for k, v in enumerate(views)}
    return views, frames, true


def level(offsets):
    return np.array(list(offsets.values())) - np.median(list(offsets.values()))


def test_known_offsets_are_found_again(drifted):
    views, frames, true = drifted
    found = Drift()(views, frames, FLAT, GRID.bounds)
    assert list(found) == [v.photo for v in views]
    assert np.median(list(found.values())) == pytest.approx(0, abs=1e-9)
    assert np.abs(level(found) + level(true)).max() < 0.03  # of offsets of 1.5 degrees


def test_a_frame_that_a_hot_thing_crosses_is_not_believed_there(drifted):
    """A corner of one frame shows something that was gone a moment later."""
    views, frames, true = drifted
    spoilt = dict(frames)
    spoilt[views[2].photo] = frames[views[2].photo].copy()
    spoilt[views[2].photo][:100, :130] += 25
    found = Drift()(views, spoilt, FLAT, GRID.bounds)
    assert np.abs(level(found) + level(true)).max() < 0.3  # means would be off by some degrees


def test_the_map_has_one_level_afterwards(drifted):
    views, frames, true = drifted
    clean = {v.photo: heat(v) for v in views}

    def drawn(pictures, exposure):
        window = Window(row=0, column=0, height=GRID.height, width=GRID.width)
        made = composer(views, pictures, GRID, exposure=exposure, dtype=np.float32)(window)
        return np.where(made.photo >= 0, made.pixels[..., 0], np.nan)

    wanted = drawn(clean, NEUTRAL) + np.median(list(true.values()))
    offsets = Drift()(views, frames, FLAT, GRID.bounds)
    raw, even = (
        drawn(frames, NEUTRAL),
        drawn(frames, Exposure(gains={}, fields={}, offsets=offsets)),
    )
    assert np.nanmedian(np.abs(raw - wanted)) > 0.4
    assert np.nanmedian(np.abs(even - wanted)) < 0.12  # the noise's own median is 0.07


def test_places_without_measurement_say_nothing(drifted):
    views, frames, true = drifted
    holes = {k: np.where(np.arange(400) % 7 < 3, np.nan, f) for k, f in frames.items()}
    found = Drift()(views, holes, FLAT, GRID.bounds)
    assert np.abs(level(found) + level(true)).max() < 0.06


def test_every_part_that_hangs_together_keeps_its_own_level():
    edges = Overlaps(
        first=np.array([0, 1, 3]),
        second=np.array([1, 2, 4]),
        difference=np.array([1.0, 1.0, -4.0]),
        sigma=np.full(3, 0.01),
    )
    found = solved(edges, 6, 12)
    assert found == pytest.approx([1, 0, -1, -2, 2, 0], abs=0.02)


def test_one_wrong_overlap_of_many_is_outvoted():
    rng = np.random.default_rng(0)
    true = rng.normal(0, 1, 8)
    first, second = np.triu_indices(8, 1)
    difference = true[second] - true[first]
    difference[5] += 6
    found = solved(
        Overlaps(first=first, second=second, difference=difference, sigma=np.full(28, 0.05)), 8, 12
    )
    assert np.abs(found + true - np.median(true)).max() < 0.02


def test_a_long_line_of_small_equal_errors_does_not_run_away():
    """100 frames whose every overlap errs by +0.01 for drifts of 0.5: summed up, the ends would
    part by a degree.
    """
    true = np.random.default_rng(2).normal(0, 0.5, 100)
    first = np.arange(99)
    found = solved(
        Overlaps(
            first=first, second=first + 1, difference=np.diff(true) + 0.01, sigma=np.full(99, 0.05)
        ),
        100,
        12,
    )
    error = found + true - np.median(true)
    assert abs(error[-10:].mean() - error[:10].mean()) < 0.5


@pytest.mark.parametrize(("jump", "ahead", "left"), [(1, 1, 0.3), (1, 3, 0.06), (4, 3, 0.06)])
def test_a_camera_that_calibrates_itself_on_the_way_makes_no_step(jump, ahead, left):
    """A strip of 40 frames that drift by 0.02; from the 24th on all are warmer by a jump."""
    rng = np.random.default_rng(7)
    true = rng.normal(0, 0.02, 40) + jump * (np.arange(40) >= 23)
    first, second = np.array(
        [(i, j) for i in range(40) for j in range(i + 1, min(i + ahead, 39) + 1)]
    ).T
    seen = true[second] - true[first] + rng.normal(0, 0.02, len(first))
    edges = Overlaps(first=first, second=second, difference=seen, sigma=np.full(len(first), 0.02))
    error = true + solved(edges, 40, 12)
    assert abs(np.median(error[23:]) - np.median(error[:23])) < left


def test_medians_of_overlaps():
    """Frame 1 is 2 above frame 0 at 9 points (one of them wild); frame 2 shares too few."""
    point = np.r_[np.arange(9), np.arange(9), np.arange(3)]
    row = np.r_[np.zeros(9), np.ones(9), np.full(3, 2)].astype(int)
    value = np.r_[np.arange(9.0), np.arange(9.0) + 2, np.arange(3.0)]
    value[12] = 99
    edges = overlaps(point, row, value, least=8)
    assert (edges.first.tolist(), edges.second.tolist(), edges.difference.tolist()) == (
        [0],
        [1],
        [2.0],
    )


def test_frames_without_company_are_left_alone():
    one, far = view(0, 0, 0), view(1, 400, 0)
    frames = {0: heat(one), 1: heat(one)}
    assert Drift()([one], frames, FLAT, GRID.bounds) == {}
    assert Drift()([one, far], frames, FLAT, GRID.bounds) == {}


Y, X = np.mgrid[:300, :400]
RING = (2.5 * np.exp(-(((np.hypot(X - 200, Y - 150) / 250 - 0.4) / 0.12) ** 2))).astype(np.float32)


@cache
def strip(count=12):
    """Frames of one straight line, 70 % overlap, with drift and noise; what is true of each."""
    views = [view(k, -24 + 4.4 * k, 0.5 * (k % 3), yaw=85 + k % 4) for k in range(count)]
    rng = np.random.default_rng(5)
    offset = rng.normal(0, 1.0, count)
    noise = rng.normal(0, 0.1, (count, 300, 400)).astype(np.float32)
    return views, {v.photo: heat(v) + np.float32(offset[v.photo]) + noise[v.photo] for v in views}


@pytest.mark.slow
def test_a_ring_common_to_all_frames_is_found():
    views, frames = strip()
    ringed = {k: f + RING for k, f in frames.items()}
    found = Drift().patterns(views, ringed, FLAT, GRID.bounds)
    assert list(found) == [v.photo for v in views]
    left = RING + sized(found[0], RING.shape)
    assert RING.std() > 0.7
    assert left.std() < 0.2 * RING.std()


@pytest.mark.slow
def test_frames_without_a_pattern_have_none():
    views, frames = strip()
    assert Drift().patterns(views, frames, FLAT, GRID.bounds) == {}


def test_what_half_of_the_frames_show_is_no_pattern():
    """A ring that comes with a new calibration halfway is not the camera's."""
    views, frames = strip()
    half = {k: f + RING * (k >= 6) for k, f in frames.items()}
    assert Drift().patterns(views, half, FLAT, GRID.bounds) == {}


@pytest.mark.slow
def test_a_map_of_ringed_frames_has_no_rings():
    views, frames = strip()
    ringed = {k: f + RING for k, f in frames.items()}

    def levels(pictures):
        return drift_of(views, pictures, FLAT, GRID.bounds, "celsius", Drift(), PictureSettings())

    def drawn(pictures, exposure):
        window = Window(row=0, column=0, height=GRID.height, width=GRID.width)
        made = composer(views, pictures, GRID, exposure=exposure, dtype=np.float32)(window)
        values = np.where(made.photo >= 0, made.pixels[..., 0], np.nan)
        return values - np.nanmedian(values)

    found = levels(ringed)
    assert len(found.patterns) == len(views)
    clean = drawn(frames, levels(frames))
    kept, mended = (drawn(ringed, e) - clean for e in (replace(found, patterns={}), found))
    assert np.nanstd(mended) < np.nanstd(kept) / 3


def test_medians_of_groups_are_numpys():
    rng = np.random.default_rng(1)
    values, group = rng.normal(size=400), rng.integers(0, 37, 400)
    expected = np.array([np.median(values[group == g]) for g in group])
    assert medians(values, group) == pytest.approx(expected)
