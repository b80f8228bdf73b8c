"""Mutual nearest neighbours against OpenCV's matcher and against the definition written out."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.matching.matchers import SMOOTHEST, Mutual, _smoothest
from skyquilt.matching.sift import Sift
from skyquilt.model.features import Features
from tests.texture import texture


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


def test_the_waves_kept_of_sift_hold_nearly_all_of_it():
    waves = _smoothest()
    assert np.allclose(waves.T @ waves, np.eye(SMOOTHEST), atol=1e-6)
    features = Sift()(np.clip(texture(480, 640, seed=8), 0, 255).astype(np.uint8))
    assert len(features) > 500 and ((features.unit @ waves) ** 2).sum(1).mean() > 0.98


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_as_many_right_matches_as_by_whole_descriptors(seed):
    """Against OpenCV's matcher, by a turn of the picture that is known."""
    image = np.clip(texture(480, 640, seed=seed), 0, 255).astype(np.uint8)
    turn = cv2.getRotationMatrix2D((320, 240), 20, 0.9)
    noise = np.random.default_rng(seed).normal(0, 6, image.shape)
    other = np.clip(cv2.warpAffine(image, turn, (640, 480)) + noise, 0, 255).astype(np.uint8)
    a, b = Sift()(image), Sift()(other)

    def right(found):
        i, j = np.array(sorted(found)).T
        off = a.px[i] @ turn[:, :2].T + turn[:, 2] - b.px[j]
        return int((np.linalg.norm(off, axis=1) < 2).sum())

    crossed = {
        (m.queryIdx, m.trainIdx)
        for m in cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(a.unit, b.unit)
    }
    clear = {
        (m.queryIdx, m.trainIdx)
        for m, n in cv2.BFMatcher(cv2.NORM_L2).knnMatch(a.unit, b.unit, k=2)
        if m.distance < 0.85 * n.distance
    }
    whole = right(crossed & clear)
    assert whole > 150 and right(pairs(Mutual()(a, b))) > 0.99 * whole
