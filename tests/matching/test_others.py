"""Harris, ORB and AKAZE: keypoints follow the image, descriptors match it, corners lie where they
are.
"""

import numpy as np
import pytest

from skyquilt.engine.codec import decode, encode
from skyquilt.matching.binary_features import Akaze, Orb
from skyquilt.matching.matchers import Mutual
from skyquilt.model.features import Features
from skyquilt.papers.harris import Harris
from tests.matching.test_sift import warped
from tests.texture import texture


@pytest.fixture(scope="module")
def picture():
    return np.clip(texture(480, 640, seed=3), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("method", "angle", "scale", "share"),
    [
        (Harris(count=600), 0, 1, 0.7),
        (Harris(count=600), 8, 1, 0.3),
        (Harris(count=600, upright=False), 60, 1, 0.25),
        (Orb(count=600), 0, 1, 0.45),
        (Orb(count=600), 40, 1, 0.25),
        (Orb(count=600), 0, 0.8, 0.2),
        (Akaze(count=600), 0, 1, 0.5),
        (Akaze(count=600), 40, 1, 0.35),
        (Akaze(count=600, upright=True), 0, 0.8, 0.2),
    ],
)
def test_keypoints_move_with_the_image(picture, method, angle, scale, share):
    other, M = warped(picture, angle, scale, (11, -6))
    a, b = method(picture), method(other)
    matches = Mutual()(a, b)
    off = b.px[matches.index_b] - (a.px[matches.index_a] @ M[:, :2].T + M[:, 2])
    good = np.linalg.norm(off, axis=1) < 3
    assert good.mean() > 0.75 and good.sum() > share * len(a)
    assert np.abs(np.median(off[good], axis=0)).max() < 0.25


def test_corners_of_squares_are_found():
    image = np.full((240, 320), 50, np.uint8)
    corners = []
    for y in range(20, 200, 60):
        for x in range(20, 280, 60):
            image[y : y + 30, x : x + 30] = 200
            corners += [
                (x - 0.5, y - 0.5),
                (x + 29.5, y - 0.5),
                (x - 0.5, y + 29.5),
                (x + 29.5, y + 29.5),
            ]
    found = Harris(count=500, block=3)(image)
    distance = np.linalg.norm(found.px[:, None] - np.array(corners)[None], axis=-1)
    assert distance.min(0).max() < 1.2 and len(found) == len(corners)


def test_bits_differ_as_often_as_similarities_say(picture):
    """1 - similarity is twice the share of differing bits, counted one by one."""
    found = Orb(count=100)(picture)
    assert found.binary and found.descriptors.shape == (100, 32)
    s = found.unit @ found.unit.T
    for i, j in ((0, 1), (5, 70), (33, 33)):
        bits = sum(
            bin(int(p ^ q)).count("1") for p, q in zip(*found.descriptors[[i, j]], strict=True)
        )
        assert 1 - s[i, j] == pytest.approx(2 * bits / 256, abs=1e-5)
    back = decode(encode(found), {"Features": Features})
    assert back.binary and (back.descriptors == found.descriptors).all()


@pytest.mark.parametrize("method", [Harris(), Orb(), Akaze()])
def test_a_blank_image_has_no_features(method):
    found = method(np.zeros((300, 400), np.uint8))
    assert len(found) == 0 and found.px.shape == (0, 2) and len(Mutual()(found, found)) == 0
