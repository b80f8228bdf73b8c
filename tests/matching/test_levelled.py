"""Simulated relief: what stands on the plane is removed, and the plane's transformation comes out
better.
"""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.geometry.transforms import transfer
from skyquilt.matching.levelled import Level, depth_map, disparities, threshold_px
from skyquilt.matching.ransac import Ransac

F, HEIGHT, BASE = 1170.0, 40.0, 12.0
GRID = np.stack(np.meshgrid(np.linspace(0, 1500, 7), np.linspace(0, 1000, 5)), -1).reshape(-1, 2)


def relief_pair(seed, share=0.35, relief=1.5):
    """Two nadir photos 12 m apart from 40 m over level ground with things up to `relief` on it: a,
    b, heights.

    Level ground moves by F * BASE / HEIGHT = 351 px between them.
    """
    rng = np.random.default_rng(seed)
    x = np.column_stack([rng.uniform(-14, 26, 500), rng.uniform(-17, 17, 500)])
    z = np.where(rng.random(500) < share, relief * rng.random(500), 0.0)
    a, b = (F * (x - (c, 0)) / (HEIGHT - z)[:, None] + (750, 500) for c in (0, BASE))
    return a + rng.normal(0, 0.3, a.shape), b + rng.normal(0, 0.3, b.shape), z


def error(H):
    """RMS over the frame against the ground's own motion, px."""
    return np.sqrt(((transfer(H, GRID) - GRID + (F * BASE / HEIGHT, 0)) ** 2).sum(1).mean())


def test_eps_is_the_papers():
    assert threshold_px(4, 40) == 5  # its example
    assert threshold_px(0.1, 100) == 1 and threshold_px(4.1, 40) == 6
    assert threshold_px(None, 40) == threshold_px(4, None) == 5


@pytest.mark.parametrize("model", ["translation", "similarity", "homography"])
def test_things_on_the_plane_are_removed(model):
    better = []
    for seed in range(8):
        a, b, z = relief_pair(seed)
        first = Ransac(model=model, threshold_px=12)(a, b)
        found = Level(relief_m=1.5, height_m=40)(a, b, first)
        inside = first.inliers
        assert found.eps_px == 2 and len(found.level) == len(found.d_px) == inside.sum()
        assert found.estimate.count == found.level.sum() < first.count
        assert (found.estimate.inliers[inside] == found.level).all() and not found.estimate.inliers[
            ~inside
        ].any()
        assert np.linalg.norm(found.d_px[found.level], axis=1).max() <= 2
        assert (
            found.level[z[inside] == 0].mean() > 0.9 and found.level[z[inside] > 0.8].mean() < 0.1
        )
        better.append((error(found.estimate.b_H_a), error(first.b_H_a)))
    after, before = np.array(better).T
    assert np.median(after) < 0.6 * np.median(before)


def test_level_ground_stays_as_it_is():
    a, b, _ = relief_pair(0, share=0.0)
    first = Ransac()(a, b)
    found = Level()(a, b, first)
    assert found.level.all() and found.estimate.b_H_a == pytest.approx(first.b_H_a, abs=1e-6)


def test_smaller_pictures_have_smaller_thresholds():
    a, b, _ = relief_pair(1)
    first = Ransac(threshold_px=12)(a, b)
    assert Level(relief_m=4, height_m=40, width=750)(a, b, first).eps_px == 2.5
    assert Level(relief_m=4, height_m=40, width=150)(a, b, first).eps_px == 1


def test_disparities_tell_heights():
    """d = F B h / (Z (Z - h)), along the base (8.9 px for a metre here)."""
    a, b, z = relief_pair(2)
    H = np.array([[1, 0, -F * BASE / HEIGHT], [0, 1, 0], [0, 0, 1]])
    d = disparities(H, a, b)
    expected = -F * BASE * z / (HEIGHT * (HEIGHT - z))
    assert d[:, 0] == pytest.approx(expected, abs=2.0) and np.abs(d[:, 1]).max() < 2
    assert np.corrcoef(d[:, 0], expected)[0, 1] > 0.98


def test_the_depth_map_is_scaled_and_without_gaps():
    px = np.array([[0, 0], [99, 0], [0, 59], [99, 59]], float)
    d = np.array([[-3, 0], [1, 4], [0, 0], [1, -4]], float)
    dm = depth_map(px, d, (60, 100))
    assert dm.shape == (60, 100, 3) and dm.dtype == np.float32 and 0 <= dm.min() and dm.max() <= 1
    size = np.linalg.norm(d, axis=1)
    for (x, y), v, n in zip(px.astype(int), d, size, strict=True):
        expected = ((v[0] + 3) / 4, n / size.max(), (v[1] + 4) / 8)
        assert dm[y, x] == pytest.approx(expected, abs=0.03)
    assert depth_map(px[:1], d[:1], (6, 9)) == pytest.approx(0.5)  # nothing to scale by
    assert depth_map(px[:0], d[:0], (6, 9)) == pytest.approx(0.5)
    assert np.isfinite(depth_map(px[:2], d[:2], (60, 100))).all()


def test_nothing_is_removed_where_too_few_would_stay():
    a, b, _ = relief_pair(3)
    first = Ransac(threshold_px=12)(a, b)
    few = replace(first, inliers=np.arange(len(a)) < 6)
    far = b + np.random.default_rng(0).uniform(-90, 90, b.shape)
    found = Level(relief_m=0, height_m=40)(a, far, few)
    assert found.estimate is few and found.level.all() and len(found.level) == 6
