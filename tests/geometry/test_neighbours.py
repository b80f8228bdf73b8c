"""Nearest points and pairs against SciPy's k-d tree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from skyquilt.geometry.neighbours import nearest, pairs_within


@pytest.mark.parametrize(
    ("count", "k", "offset"), [(1, 1, 0.0), (9, 9, 1e5), (3000, 8, 0.0), (3000, 2, 4e6)]
)
def test_neighbours_are_those_of_scipy(count, k, offset):
    rng = np.random.default_rng(count + k)
    points = rng.uniform(-200, 200, (count, 2)) + offset
    at = np.concatenate([points, rng.uniform(-300, 300, (500, 2)) + offset])
    distance, index = nearest(points, at, k)
    expected, _ = cKDTree(points).query(at, k=k)
    assert distance.shape == index.shape == (len(at), k)
    # single precision may take the second of two that are equally far to within 0.03 mm
    assert np.abs(distance - expected.reshape(distance.shape)).max() < 3e-5
    assert np.allclose(np.linalg.norm(points[index] - at[:, None], axis=2), distance)
    assert (np.diff(distance, axis=1) >= 0).all()


def test_points_at_one_place_are_all_found():
    distance, index = nearest(np.ones((40, 2)), np.array([[1.0, 1.0]]), 40)
    assert not distance.any() and sorted(index[0].tolist()) == list(range(40))


@pytest.mark.parametrize("k", [0, 4])
def test_more_neighbours_than_points_are_refused(k):
    with pytest.raises(ValueError, match="1 to 3 neighbours"):
        nearest(np.zeros((3, 2)), np.zeros((1, 2)), k)


@pytest.mark.parametrize("stretch", [(1.0, 1.0), (30.0, 0.1), (0.1, 30.0), (0.0, 0.0)])
@pytest.mark.parametrize("count", [2, 7, 400])
def test_pairs_within_reach_are_those_of_scipy(count, stretch):
    points = np.random.default_rng(count).uniform(-50, 50, (count, 2)) * stretch
    i, j = pairs_within(points, 12.0)
    expected = sorted(cKDTree(points).query_pairs(12.0))
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected
    assert count < 400 or expected


def test_one_place_has_no_pairs():
    assert not len(pairs_within(np.zeros((1, 2)), 5.0)[0])
    assert not len(pairs_within(np.zeros((0, 2)), 5.0)[0])
