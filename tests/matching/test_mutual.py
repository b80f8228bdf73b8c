"""Mutual nearest neighbours against OpenCV's matcher and against the definition written out."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.matching.matchers import Mutual
from skyquilt.model.features import Features


def unit(seed, count, dimension=32, base=None, noise=0.0):
    rng = np.random.default_rng(seed)
    d = (
        rng.normal(0, 1, (count, dimension))
        if base is None
        else base + rng.normal(0, noise, base.shape)
    )
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return Features(
        px=np.zeros((len(d), 2)), size=np.ones(len(d), np.float32), descriptors=d, scale=1.0
    )


def pairs(matches):
    return set(zip(matches.index_a.tolist(), matches.index_b.tolist(), strict=True))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 60), st.integers(2, 60), st.floats(0.5, 1.0))
def test_the_definition(seed, m, n, ratio):
    a = unit(seed, m, 4)
    b = unit(seed + 1, n, 4)
    distance = np.linalg.norm(a.descriptors[:, None].astype(float) - b.descriptors[None], axis=2)
    expected, doubtful = set(), set()
    for i in range(m):
        j, k = np.argsort(distance[i])[:2]
        back = np.sort(distance[:, j])
        if abs(distance[i, j] - ratio * distance[i, k]) < 1e-3 or (
            m > 1 and abs(distance[i, j] - back[0]) < 1e-4 and back[1] - back[0] < 1e-4
        ):
            doubtful.add((i, int(j)))
        elif distance[i, j] < ratio * distance[i, k] and distance[:, j].argmin() == i:
            expected.add((i, int(j)))
    found = pairs(Mutual(ratio=ratio)(a, b))
    assert expected - doubtful <= found and found - doubtful <= expected


def test_against_opencv_with_cross_check():
    a = unit(0, 400, 128)
    b = unit(1, 400, 128, base=a.descriptors.astype(float), noise=0.06)
    b = Features(
        px=b.px,
        size=b.size,
        scale=1.0,
        descriptors=np.r_[b.descriptors[::-1], unit(2, 200, 128).descriptors],
    )
    crossed = {
        (m.queryIdx, m.trainIdx)
        for m in cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(a.descriptors, b.descriptors)
    }
    clear = {
        (m.queryIdx, m.trainIdx)
        for m, n in cv2.BFMatcher(cv2.NORM_L2).knnMatch(a.descriptors, b.descriptors, k=2)
        if m.distance < 0.85 * n.distance
    }
    found = pairs(Mutual(ratio=0.85)(a, b))
    assert found == crossed & clear
    assert len(found) > 300
    assert np.mean([i + j == 399 for i, j in found]) > 0.99  # the right ones


def test_two_photos_are_equal_partners():
    """Mutual matches without ratio are the same from either side."""
    a, b = unit(5, 150, 8), unit(6, 130, 8)
    assert pairs(Mutual(ratio=10.0)(a, b)) == {(i, j) for j, i in pairs(Mutual(ratio=10.0)(b, a))}


@pytest.mark.parametrize(("m", "n"), [(0, 0), (0, 50), (50, 0), (1, 50), (50, 1), (1, 1)])
def test_too_few_to_tell(m, n):
    matches = Mutual()(unit(0, m), unit(1, n))
    assert len(matches) == 0 and matches.index_b.dtype.kind == "i"
