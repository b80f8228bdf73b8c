"""Seam points on drawn label maps; seam disparity of photos that disagree by a known amount."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.quality import seam_points as seam_points_module
from skyquilt.quality.seam_points import SeamPoint, seam_points
from skyquilt.quality.seams import PatchPairs, noise_of, seam_disparity
from tests.texture import seen, texture


def voronoi(count, size=300, seed=0):
    seeds = np.random.default_rng(seed).uniform(0, size, (count, 2))
    y, x = np.mgrid[:size, :size]
    labels = np.argmin([(y - a) ** 2 + (x - b) ** 2 for a, b in seeds], axis=0) + 1
    labels[:20] = 0
    return labels


def neighbours(labels):
    touching = [
        np.stack([labels[1:], labels[:-1]], -1).reshape(-1, 2),
        np.stack([labels[:, 1:], labels[:, :-1]], -1).reshape(-1, 2),
    ]
    pairs = np.sort(np.concatenate(touching), axis=1)
    pairs = pairs[(pairs[:, 0] != pairs[:, 1]) & (pairs[:, 0] > 0)]
    return {tuple(p) for p in np.unique(pairs, axis=0).tolist()}


@settings(max_examples=20, deadline=None)
@given(count=st.integers(1, 25), seed=st.integers(0, 99), spacing=st.floats(2, 80))
def test_every_seam_has_a_point_and_every_point_lies_on_its_seam(count, seed, spacing):
    labels = voronoi(count, 120, seed)
    points = seam_points(labels, spacing_px=spacing)
    assert {(p.a, p.b) for p in points} == neighbours(labels)
    assert len(points) <= 300
    assert len(set(points)) == len(points)
    for p in points:
        low = labels[int(p.row), int(p.column)]
        high = labels[int(np.ceil(p.row)), int(np.ceil(p.column))]
        assert {low, high} == {p.a, p.b}


def test_longer_seams_have_more_points_evenly_spread():
    labels = np.ones((200, 400), int)
    labels[100:], labels[:100, 40:] = (
        2,
        3,
    )  # 1 touches 2 along 40 px, 3 touches 2 along 360, 1 and 3 along 100
    points = seam_points(labels, spacing_px=10)
    counts = {pair: sum((p.a, p.b) == pair for p in points) for pair in ((1, 2), (2, 3), (1, 3))}
    assert counts == {(1, 2): 4, (2, 3): 36, (1, 3): 10}
    steps = np.diff(sorted(p.column for p in points if (p.a, p.b) == (2, 3)))
    assert steps.min() >= 9
    assert steps.max() <= 11
    assert seam_points(labels, spacing_px=10) == points


def test_the_limit_is_kept_and_shared_by_length():
    labels = voronoi(25)
    pairs = neighbours(labels)
    for limit in (len(pairs) + 20, len(pairs), 5):
        points = seam_points(labels, spacing_px=2, limit=limit)
        assert 0 < len(points) <= limit
        assert limit < len(pairs) or {(p.a, p.b) for p in points} == pairs
    assert seam_points(labels, limit=0) == []


def test_strips_of_a_raster_have_the_same_points(monkeypatch):
    labels = np.kron(np.random.default_rng(3).integers(0, 5, (6, 5)), np.ones((7, 9), int))
    at_once = seam_points(labels, spacing_px=4)
    monkeypatch.setattr(seam_points_module, "STRIP", 5)
    assert len(at_once) > 20 and seam_points(labels, spacing_px=4) == at_once


@pytest.mark.parametrize(
    "labels", [np.zeros((9, 9), int), np.ones((9, 9), np.uint16), np.eye(9, dtype=np.uint8)]
)
def test_no_seam_no_points(labels):
    assert seam_points(labels) == []


def points_of(count):
    return [SeamPoint(row=k, column=2 * k, a=1, b=2) for k in range(count)]


def shifted(s, *, flat=0, unrelated=0, unseen=0, gain=0.8):
    """A patch source whose photo b lies s = (dy, dx) quarter px beside photo a; some patches
    spoilt.
    """
    fine = texture(1000, 1000)
    rng = np.random.default_rng(0)

    def cut(points):
        at = rng.integers(40, 700, (len(points), 2))
        a = np.array([seen(fine, r, c) for r, c in at])
        b = np.array([seen(fine, r - s[0], c - s[1]) for r, c in at]) * gain + rng.normal(
            0, 1, a.shape
        )
        is_seen = np.ones(len(points), bool)
        b[:flat] = 50
        b[flat : flat + unrelated] = b[flat : flat + unrelated, ::-1, ::-1]
        is_seen[len(points) - unseen :] = False
        return PatchPairs(a=a.astype(np.float32), b=b.astype(np.float32), seen=is_seen)

    return cut


def disparity(points, source, **settings):
    return seam_disparity(points, source(points), **settings)


def test_known_disparity_is_measured():
    report = disparity(points_of(60), shifted((6, -8)), gsd_m=0.02)  # 1.5 px south, 2 px west
    assert (report.measured, report.attempted) == (60, 60)
    assert report.median_px == pytest.approx(2.5, abs=0.03)
    assert report.p95_px == pytest.approx(2.5, abs=0.1)
    assert report.median_cm == pytest.approx(5.0, abs=0.06)
    assert np.median([s.dy for s in report.samples]) == pytest.approx(1.5, abs=0.03)
    assert np.median([s.dx for s in report.samples]) == pytest.approx(-2.0, abs=0.03)
    assert report.stands


def test_a_good_mosaic_is_not_flattered_below_what_noise_allows():
    report = disparity(points_of(60), shifted((0, 0)), gsd_m=0.02)
    assert 0.001 < report.median_px < 0.05


def test_failures_are_attempted_and_blind_points_are_not():
    source = shifted((4, 4), flat=10, unrelated=15, unseen=5)
    report = disparity(points_of(60), source, gsd_m=0.02)
    assert report.attempted == 60 - 10 - 5
    assert report.measured == report.attempted - 15
    assert sum(not s.ok for s in report.samples) == 15
    assert all(s.reason for s in report.samples if not s.ok)
    assert report.median_px == pytest.approx(np.sqrt(2), abs=0.03)
    assert report.stands


@pytest.mark.parametrize("unit", [0.002, 0.1, 50.0])
def test_measured_values_of_any_unit_have_the_figures_of_grey_ones(unit):
    """Degrees of level ground, of warm roofs, counts; where nothing was measured, there is none."""
    points, source = points_of(60), shifted((6, -8), flat=10, unseen=5)
    grey = source(points)
    values = replace(grey, a=np.float32(unit) * grey.a + 10, b=np.float32(unit) * grey.b + 10)
    values.a[11, 0, 0] = np.nan
    report = seam_disparity(points, values, gsd_m=0.02, noise=noise_of(values))
    assert (report.measured, report.attempted) == (44, 44)
    assert report.median_px == pytest.approx(2.5, abs=0.03)
    assert noise_of(replace(values, seen=np.zeros(60, bool))) > 0


def test_a_disparity_beyond_the_search_is_a_failure_not_a_small_figure():
    report = disparity(points_of(40), shifted((0, 4 * 10)), gsd_m=0.02)
    assert report.attempted == 40
    assert report.measured <= 1
    assert not report.stands


def test_no_seams_no_figures():
    report = seam_disparity([], shifted((0, 0))(points_of(1)), gsd_m=0.02)
    assert (report.median_px, report.p95_px, report.median_cm, report.p95_cm) == (None,) * 4
    assert (report.measured, report.attempted, report.samples) == (0, 0, ())
    assert not report.stands
    blind = disparity(points_of(3), shifted((0, 0), unseen=3), gsd_m=0.02)
    assert (blind.median_px, blind.attempted) == (None, 0)
