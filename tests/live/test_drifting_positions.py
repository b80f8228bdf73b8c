"""Errors of positions that are alike from photo to photo, against drawn ones."""

import numpy as np
import pytest

from skyquilt.live.drifting_positions import alike, foreseen, leap_m, unforeseen_m


def drifting(rng, share, photos=400, deviation=2.0):
    """Errors (photos, 2) in m, each `share` of the one before and the rest by chance."""
    off = rng.normal(0, deviation, (photos, 2))
    for k in range(1, photos):
        off[k] = share * off[k - 1] + np.sqrt(1 - share**2) * off[k]
    return off


def left_m(off, recent=15):
    """Root mean square per axis of what is left of errors of which each was foreseen."""
    left = [off[k] - foreseen(off[k - recent : k], recent) for k in range(recent, len(off))]
    return float(np.sqrt(np.mean(np.square(left))))


@pytest.mark.parametrize("seed", range(6))
def test_drifts_are_foreseen_and_chance_is_not(seed):
    """No rule foresees more than all but sqrt(1 - share^2) of such errors."""
    rng = np.random.default_rng(seed)
    for share in (0.99, 0.95, 0.9):
        off = drifting(rng, share)
        raw = float(np.sqrt((off**2).mean()))
        assert left_m(off) < 0.8 * raw
        assert left_m(off) > 0.9 * np.sqrt(1 - share**2) * 2.0
    chance = drifting(rng, 0.0)
    assert left_m(chance) < 1.06 * float(np.sqrt((chance**2).mean()))


def test_few_photos_tell_nothing():
    off = np.full((5, 2), 4.0)
    assert alike(off) == 0.0
    assert foreseen(off, 5).tolist() == [0.0, 0.0]
    assert unforeseen_m(off, 1.5) == 1.5
    assert foreseen(np.zeros((0, 2)), 0).tolist() == [0.0, 0.0]
    assert unforeseen_m(np.zeros((0, 2)), 1.5) == 1.5


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_a_jump_after_a_few_photos_is_told(count):
    off = np.random.default_rng(count).normal(0, 1.0, (count, 2)) + (5.0, 7.0)
    assert unforeseen_m(off, 1.0) < 2.5
    off[-1] += (24.0, -18.0)
    assert unforeseen_m(off, 1.0) > 9.0


def test_a_photo_errs_as_the_one_before_it_or_as_the_first():
    off = np.column_stack([np.arange(10.0, 20.0), np.zeros(10)])
    share = alike(off)
    assert 0.9 < share < 1
    assert foreseen(off, 10)[0] == pytest.approx(19 * share)
    assert foreseen(off, 4)[0] == pytest.approx(13 * share)
    assert foreseen(off, 0)[0] == pytest.approx(10 * share)


@pytest.mark.parametrize("seed", range(6))
def test_a_jump_is_told_from_its_first_photo_until_some_fit_again(seed):
    rng = np.random.default_rng(seed)
    off = rng.normal(0, 1.0, (40, 2))
    off[20:25] += (24.0, -18.0)
    told = {k: unforeseen_m(off[max(k - 15, 0) : k], 1.0) > 3.0 for k in range(6, 40)}
    assert all(told[k] for k in (21, 22, 23, 26, 27, 28))  # within it, errors may be foreseen
    assert not any(told[k] for k in range(6, 21))


@pytest.mark.parametrize("seed", range(6))
def test_a_position_leaps_where_no_drone_flies_so_fast(seed):
    """Lines there and back, a photo every 4 s; some are missing, and one waits on the ground."""
    rng = np.random.default_rng(seed)
    line, place = np.divmod(np.arange(28), 7)
    way = np.column_stack([16.0 * line, 11.0 * np.where(line % 2, 6 - place, place)])
    told, s = way + rng.normal(0, 1.0, way.shape), 4.0 * np.arange(28)
    s[20:] += 300.0
    kept = np.sort(rng.choice(28, 20, replace=False))
    for k in range(3, 20):
        before, now = kept[:k], kept[k]
        if now - before[-1] <= 3 and now != 20:
            assert leap_m(told[before], s[before], told[now], s[now]) < 3.0
        away = told[now] + 30.0 * np.array([np.cos(k), np.sin(k)])
        leap = leap_m(told[before], s[before], away, float(s[before[-1]]) + 4.0)
        assert leap > 30 - np.linalg.norm(told[now] - told[before[-1]]) - 1.5 * 11 - 8
        assert leap_m(told[before], s[before], away, np.nan) == 0.0


def test_two_photos_do_not_tell_how_fast_a_drone_flies():
    way, s = np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([0.0, 4.0])
    assert leap_m(way, s, np.array([90.0, 0.0]), 8.0) == 0.0
    third = np.vstack([way, (20.0, 0.0)]), np.append(s, 8.0)
    assert leap_m(*third, np.array([90.0, 0.0]), 12.0) == pytest.approx(70 - 1.5 * 10)
    assert leap_m(*third, np.array([-60.0, 0.0]), -4.0) == pytest.approx(60 - 1.5 * 10)
