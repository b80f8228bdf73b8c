"""Errors of positions that are alike from photo to photo, against drawn ones."""

import numpy as np
import pytest

from skyquilt.live.drifting_positions import alike, foreseen, unforeseen_m


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
