"""Candidate pairs against brute force, and what retrieval finds of simulated photos that
overlap.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.matching.candidates import Nearest, Retrieval, by_camera, sequence
from skyquilt.matching.sift import Sift
from skyquilt.model.features import Features
from tests.texture import texture


@settings(max_examples=80, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(0, 40),
    st.integers(1, 8),
    st.one_of(st.none(), st.floats(1, 60)),
    st.floats(0, 0.5),
)
def test_nearest_is_brute_force(seed, count, neighbours, reach, lost):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 100, (count, 2))
    xy[rng.random(count) < lost] = np.nan
    expected = {}
    for i in range(count):
        d = np.hypot(*(xy - xy[i]).T)
        d[i] = np.nan
        for j in np.argsort(d)[:neighbours]:
            if np.isfinite(d[j]) and (reach is None or d[j] <= reach):
                expected[min(i, int(j)), max(i, int(j))] = d[j]
    found = Nearest(neighbours=neighbours)(xy, reach)
    assert set(found) == set(expected) and len(found) == len(set(found))
    assert [expected[p] for p in found] == sorted(expected.values())


def test_photos_at_one_place_are_paired():
    """Positions rounded to the same degree: more of them than neighbours are asked for."""
    found = Nearest(neighbours=3)(np.zeros((6, 2)))
    assert all(i < j for i, j in found) and len({i for p in found for i in p}) == 6


def test_sequence():
    assert sequence(4) == [(0, 1), (1, 2), (2, 3)]
    assert sequence(4, 2) == [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)]
    assert sequence(1) == [] == sequence(0)


# retrieval


@pytest.fixture(scope="module")
def flown():
    """36 photos of 240 x 180 px in a grid over one ground, 60 % overlap, light and heading
    different.
    """
    ground = texture(1000, 1200, seed=9)
    rng = np.random.default_rng(9)
    features, corner = [], []
    for row in range(6):
        for column in range(6):
            y, x = row * 72 + rng.integers(0, 10), column * 96 + rng.integers(0, 10)
            view = ground[y : y + 180, x : x + 240] * rng.uniform(0.8, 1.2) + rng.normal(
                0, 3, (180, 240)
            )
            if column % 2:
                view = view[::-1, ::-1]
            features.append(Sift(count=300)(np.clip(view, 0, 255).astype(np.uint8)))
            corner.append((x, y))
    corner = np.array(corner)
    d = np.abs(corner[:, None] - corner[None])
    overlap = np.clip(240 - d[..., 0], 0, None) * np.clip(180 - d[..., 1], 0, None) / (240 * 180)
    np.fill_diagonal(overlap, 0)
    return features, overlap


@pytest.mark.slow
def test_retrieval_finds_what_overlaps(flown):
    features, overlap = flown
    found = Retrieval(neighbours=8, exhaustive_below=10)(features)
    i, j = np.array(found).T
    assert (i < j).all() and len(found) <= 8 * 36
    wanted = {(int(a), int(b)) for a, b in np.argwhere(np.triu(overlap > 0.5))}
    recall = len(wanted & set(found)) / len(wanted)
    assert recall > 0.9
    # chance: 36 photos ask for 8 of 35 each, so a pair comes up with 1 - (27 / 35)^2 = 0.40
    assert len([p for p in found if overlap[p] > 0.1]) / len(found) > 0.75


@pytest.mark.slow
def test_retrieval_for_the_lost_only(flown):
    features, _ = flown
    method = Retrieval(neighbours=5, exhaustive_below=10)
    found = method(features, asked=[7, 20])
    assert all(7 in p or 20 in p for p in found) and 5 <= len(found) <= 10
    assert set(found) <= set(method(features))
    assert found == method(features, asked=[7, 20])


def test_small_surveys_are_paired_completely(flown):
    features, _ = flown
    assert Retrieval(exhaustive_below=7)(features[:6]) == [
        (i, j) for i in range(6) for j in range(i + 1, 6)
    ]
    assert Retrieval(exhaustive_below=7)(features[:6], asked=[4]) == [
        (0, 4),
        (1, 4),
        (2, 4),
        (3, 4),
        (4, 5),
    ]
    assert len(Retrieval(exhaustive_below=7, neighbours=2)(features[:7])) < 21


def test_photos_without_features_do_no_harm(flown):
    features, _ = flown
    empty = Features(
        px=np.zeros((0, 2)),
        size=np.zeros(0, np.float32),
        descriptors=np.zeros((0, 128), np.float32),
        scale=1.0,
    )
    assert Retrieval(exhaustive_below=3, neighbours=2)([*features[:5], empty])


# several cameras on one drone


def rig(cameras, apart=15.0, noise=0.0, seed=0):
    """Names of cameras (n,) and positions (n, 2) of a drone that carries them over 4 x 5 places."""
    rng = np.random.default_rng(seed)
    at = [(apart * x, 1.5 * apart * y) for y in range(4) for x in range(5)]
    names = [f"c{k}" for _ in at for k in range(cameras)]
    return names, np.repeat(at, cameras, 0) + rng.normal(0, noise, (len(names), 2))


@pytest.mark.parametrize("noise", [0.0, 1.5])
@pytest.mark.parametrize("cameras", [2, 5])
def test_photos_of_each_camera_on_a_drone_are_paired(cameras, noise):
    names, xy = rig(cameras, noise=noise, seed=cameras)
    places = by_camera(names, xy)
    own = Nearest(neighbours=8)(places)
    for name in set(names):
        mine = [k for k, n in enumerate(names) if n == name]
        expected = {(mine[i], mine[j]) for i, j in Nearest(neighbours=8)(xy[mine])}
        assert expected <= set(own)
    assert all(names[i] == names[j] for i, j in own)


def test_other_drones_are_no_cameras_of_one():
    names, xy = rig(1)
    assert by_camera(names, xy) is None
    beside = xy + [0, 0.75 * 15]  # another drone's lines between those of the first
    assert by_camera([*names, *["d"] * len(xy)], np.vstack([xy, beside])) is None
    away = xy + [400.0, 0]
    assert by_camera([*names, *["d"] * len(xy)], np.vstack([xy, away])) is None
    assert by_camera(["a", "b"], np.full((2, 2), np.nan)) is None
    assert by_camera([], np.zeros((0, 2))) is None
    assert by_camera(["a", "b"], np.zeros((2, 2))) is None


def test_photos_without_position_stay_without():
    names, xy = rig(3)
    xy[4] = np.nan
    places = by_camera(names, xy)
    assert np.isnan(places[4, :2]).all() and np.isfinite(np.delete(places, 4, 0)).all()
    assert all(4 not in pair for pair in Nearest()(places))
