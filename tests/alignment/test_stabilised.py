"""Photos that electronic stabilisation cut out of larger pictures, each elsewhere: found by what
they do to an adjustment, and each given an optical axis of its own.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.control import fit_similarity_3d
from skyquilt.alignment.stabilised import as_stabilised
from tests.alignment.blocks import WIDTH
from tests.alignment.surveys import photo
from tests.alignment.test_bundle import Flown


def off_m(flown, found):
    """How far camera centres lie off after a similarity, m (RMS)."""
    at = np.array([found.poses[i].map_C for i in range(len(flown.photos))])
    scale, R, t = fit_similarity_3d(at, flown.truth.C)
    return float(np.sqrt(((scale * at @ R.T + t - flown.truth.C) ** 2).sum(1).mean()))


def cut_elsewhere(flown, share, seed=0):
    """The photos as parts that lie elsewhere by up to this share of their width; (n, 2) px."""
    jumps = np.random.default_rng(seed).uniform(-share, share, (len(flown.photos), 2)) * WIDTH
    for i, jump in enumerate(jumps):
        flown.features[i] = replace(flown.features[i], px=flown.features[i].px + jump)
    return jumps


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.02, 0.04])
def test_each_photo_that_was_cut_elsewhere_has_an_axis_of_its_own(share):
    flown = Flown(3, lines=3, per_line=4, points=700)
    straight = off_m(flown, flown.aligned())
    jumps = cut_elsewhere(flown, share)
    found = flown.aligned()
    assert sum("meets each photo at another place" in n for n in found.notes) == 1
    axes = np.array([(found.camera(i).cx, found.camera(i).cy) for i in range(len(jumps))])
    left = (axes - axes.mean(0)) - (jumps - jumps.mean(0))
    assert np.abs(left).max() < 0.3 * np.abs(jumps).max()
    assert off_m(flown, found) < 2 * straight
    without = off_m(flown, flown.aligned(repair=False))
    assert off_m(flown, found) < 0.4 * without


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_photos_that_nobody_cut_keep_one_axis(seed):
    found = Flown(seed, lines=3, per_line=4, points=700).aligned()
    assert len(found.cameras) == 1


def test_each_photo_is_a_part_of_one_lens():
    shot = [photo("a.jpg"), photo("b.jpg"), photo("c.jpg", key="other")]
    out = as_stabilised(shot, {shot[0].camera_key})
    assert len({p.camera_key for p in out}) == 3 and out[2] is shot[2]
    told = [(p.zoom.camera, p.zoom.factor, p.zoom.centred) for p in out[:2]]
    assert told == [(shot[0].camera_key, 1.0, False)] * 2
    # two that tell the same count as one does
    assert out[0].focal.sigma_px == pytest.approx(shot[0].focal.sigma_px * np.sqrt(2))
