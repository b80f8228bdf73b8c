"""The best and the guided against slow loops over all pairs; the best of a real pair."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from skyquilt.matching.matchers import Guided, Mutual
from skyquilt.model.features import Features
from skyquilt.papers.aligners import VLFEAT
from skyquilt.papers.best_matches import Best
from skyquilt.papers.ste import RansacSte
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.methods import detector_for

BRIGHTON = Path(__file__).parents[2] / ".." / "shared" / "data" / "brighton"


def features(descriptors, px=None, binary=False):
    n = len(descriptors)
    px = np.zeros((n, 2)) if px is None else px
    return Features(
        px=px, size=np.ones(n, np.float32), descriptors=descriptors, scale=1.0, binary=binary
    )


def pair(seed, binary=False, n=60):
    """The first 40 of a are in b, a little changed, in another order; where each is."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(n)
    if binary:
        a = rng.integers(0, 256, (n, 32), dtype=np.uint8)
        b = a ^ (rng.random((n, 32)) < 0.05).astype(np.uint8)
        b[40:] = rng.integers(0, 256, (n - 40, 32), dtype=np.uint8)
    else:
        a = rng.normal(0, 1, (n, 64)).astype(np.float32)
        b = a + rng.normal(0, rng.uniform(0.05, 0.4, (n, 1)), (n, 64)).astype(np.float32)
        b[40:] = rng.normal(0, 1, (n - 40, 64))
    return a, b[order], order


def distances(a, b, binary):
    """Slowly, one pair at a time."""
    if binary:
        return np.array(
            [
                [sum(bin(int(x ^ y)).count("1") for x, y in zip(p, q, strict=True)) for q in b]
                for p in a
            ]
        )
    unit = [d / np.linalg.norm(d, axis=1, keepdims=True) for d in (a, b)]
    return np.array([[np.linalg.norm(p - q) for q in unit[1]] for p in unit[0]])


@pytest.mark.parametrize("binary", [False, True])
def test_the_best_are_mutual_and_sorted(binary):
    a, b, _ = pair(0, binary)
    d = distances(a, b, binary)
    expected = [(i, j) for i in range(60) for j in [int(d[i].argmin())] if d[:, j].argmin() == i]
    expected.sort(key=lambda p: d[p])
    found = Best(count=30)(features(a, binary=binary), features(b, binary=binary))
    got = list(zip(found.index_a.tolist(), found.index_b.tolist(), strict=True))
    assert len(got) == 30 and set(got) <= set(expected)
    assert [d[p] for p in got] == pytest.approx([d[p] for p in expected[:30]], abs=1e-6)


@pytest.mark.parametrize("binary", [False, True])
def test_the_ratio_is_that_of_distances(binary):
    a, b, order = pair(1, binary)
    d = distances(a, b, binary)
    two = np.sort(d, 1)[:, :2]
    ratio = 0.3 if binary else 0.45
    expected = {
        (i, int(d[i].argmin()))
        for i in range(60)
        if two[i, 0] < ratio * two[i, 1] and d[:, d[i].argmin()].argmin() == i
    }
    found = Mutual(ratio=ratio)(features(a, binary=binary), features(b, binary=binary))
    assert set(zip(found.index_a.tolist(), found.index_b.tolist(), strict=True)) == expected
    assert 10 < len(expected) <= 40


def test_guidance_finds_what_repeats():
    """Everything looks alike four times over; only the place tells which is meant."""
    rng = np.random.default_rng(2)
    one = rng.normal(0, 1, (25, 64)).astype(np.float32)
    a = np.tile(one, (4, 1))
    px = rng.uniform(0, 2000, (100, 2))
    shift = np.array([300.0, -40.0])
    b = a + rng.normal(0, 0.05, a.shape).astype(np.float32)
    fa, fb = features(a, px), features(b, px + shift + rng.normal(0, 5, px.shape))
    assert len(Mutual()(fa, fb)) < 10
    found = Guided(radius_px=30)(fa, fb, px + shift)
    right = found.index_a == found.index_b
    assert right.all() and len(found) > 90
    wrong = Guided(radius_px=30)(fa, fb, px + shift + 200)
    assert len(wrong) < 5
    unknown = np.where(np.arange(100)[:, None] < 50, px + shift, np.nan)
    assert set(Guided(radius_px=30)(fa, fb, unknown).index_a) == set(
        found.index_a[found.index_a < 50]
    )


def test_nothing_and_kinds():
    none, some = features(np.zeros((0, 64), np.float32)), features(np.ones((3, 64), np.float32))
    for method in (Best(), Mutual()):
        assert len(method(none, some)) == len(method(some, none)) == 0
    assert len(Guided()(none, some, np.zeros((0, 2)))) == 0
    with pytest.raises(ValueError, match="one kind expected, got real of 64 and binary of 32"):
        Best()(some, features(np.ones((3, 32), np.uint8), binary=True))
    with pytest.raises(ValueError, match="a position for each of 3"):
        Guided()(some, some, np.zeros((2, 2)))


@pytest.mark.slow
def test_sift_all_keeps_the_strongest_wherever_they_are():
    """Against OpenCV's own detector; `sift` takes the strongest of each of 100 cells."""
    rng = np.random.default_rng(0)
    picture = np.full((400, 600), 120, np.float32)
    picture[:, 300:] += cv2.GaussianBlur(
        rng.normal(0, 300, (400, 300)).astype(np.float32), (0, 0), 2
    )
    picture = np.clip(picture + rng.normal(0, 1.5, picture.shape), 0, 255).astype(np.uint8)
    settings = MosaicSettings(method="flightline", detector="sift-all")
    found = detector_for(settings)(picture)
    every = cv2.SIFT.create(0, contrastThreshold=0.003, enable_precise_upscale=True)
    points = every.detect(picture)
    assert 600 < len(found) == len(points)  # fewer than it would keep: all of them
    assert sorted(found.px[:, 0]) == pytest.approx(sorted(p.pt[0] for p in points), abs=1e-3)
    assert len(detector_for(settings.changed(detector="sift"))(picture)) < len(found)


@pytest.mark.slow
def test_the_articles_estimator_starves_on_few_spread_keypoints_and_not_on_all():
    """A 2.4, 2.5 on neighbouring photos of gardens and woods."""
    if not BRIGHTON.is_dir():
        pytest.skip("the survey brighton is not beside this checkout")
    pictures = [cv2.imread(str(p), 0) for p in sorted(BRIGHTON.glob("*.JPG"))[1:3]]
    told = {}
    for name in ("sift", "sift-all"):
        detect = detector_for(MosaicSettings(method="flightline", detector=name))
        a, b = (detect(p) for p in pictures)
        best = Best(count=150, ratio=VLFEAT)(a, b)
        found = RansacSte()(a.px[best.index_a] / a.scale, b.px[best.index_b] / b.scale)
        told[name] = len(best), found.ste_per_inlier
    assert told["sift"][0] < 120 and told["sift"][1] > 1e4
    assert told["sift-all"][0] == 150 and told["sift-all"][1] < 3
