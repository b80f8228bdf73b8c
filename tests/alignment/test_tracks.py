"""Tracks from matches, against a union-find written out; triangulation of exact and of noisy
rays.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyquilt.alignment.tracks import Tracks, build_tracks, thin
from skyquilt.alignment.triangulate import intersect, polish
from skyquilt.model.features import Features, Link
from tests.alignment.blocks import make_block


def features(count, seed=0, scale=2.0):
    rng = np.random.default_rng(seed)
    return Features(
        px=rng.uniform(0, 600, (count, 2)),
        size=np.ones(count, np.float32),
        descriptors=np.zeros((count, 8), np.float32),
        scale=scale,
    )


def link(a, b, pairs):
    pairs = np.array(pairs, np.int64).reshape(-1, 2)
    return Link(a=a, b=b, index_a=pairs[:, 0], index_b=pairs[:, 1], b_S_a=1 + 0j)


def observed(tracks):
    """The observations (photo, px) of each track."""
    return {
        frozenset(zip(tracks.photo[m].tolist(), map(tuple, tracks.px[m].tolist()), strict=True))
        for m in (tracks.point == p for p in range(tracks.count))
    }


def test_chains_become_tracks_and_a_photo_visited_twice_spoils_its_track():
    f = [features(5, k, scale=1.0 + k) for k in range(3)]
    links = [
        link(0, 1, [(0, 0), (1, 1), (2, 2)]),
        link(1, 2, [(0, 4), (1, 3), (2, 1)]),
        link(0, 2, [(2, 0), (4, 2)]),
    ]
    tracks = build_tracks(f, links)
    # (0,0)-(1,0)-(2,4); (0,1)-(1,1)-(2,3); (0,2)-(1,2)-(2,1) and (2,0): photo 2 twice, dropped;
    # (0,4)-(2,2)
    found = observed(tracks)

    def at(photo, k):
        return photo, tuple(f[photo].px[k].tolist())

    assert found == {
        frozenset({at(0, 0), at(1, 0), at(2, 4)}),
        frozenset({at(0, 1), at(1, 1), at(2, 3)}),
        frozenset({at(0, 4), at(2, 2)}),
    }
    assert (np.diff(tracks.point) >= 0).all()
    assert tracks.sigma_px == pytest.approx(np.maximum(0.25 * (1.0 + tracks.photo), 0.3))


@settings(max_examples=80, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 5), st.integers(0, 3), st.integers(0, 5)),
        max_size=25,
    )
)
def test_tracks_are_the_connected_components(matches):
    f = [features(6, k) for k in range(4)]
    by_pair = {}
    for a, i, b, j in matches:
        if a < b:
            by_pair.setdefault((a, b), set()).add((i, j))
    parent = {(a, i): (a, i) for a in range(4) for i in range(6)}

    def root(x):
        while parent[x] != x:
            x = parent[x]
        return x

    for (a, b), pairs in by_pair.items():
        for i, j in pairs:
            parent[root((a, i))] = root((b, j))
    groups = {}
    for x in parent:
        groups.setdefault(root(x), []).append(x)
    expected = {
        frozenset((a, *f[a].px[i].tolist()) for a, i in g)
        for g in groups.values()
        if len(g) > 1 and len({a for a, _ in g}) == len(g)
    }
    tracks = build_tracks(f, [link(a, b, sorted(p)) for (a, b), p in by_pair.items()])
    found = [
        frozenset((int(a), *p.tolist()) for a, p in zip(tracks.photo[m], tracks.px[m], strict=True))
        for m in (tracks.point == k for k in range(tracks.count))
    ]
    assert set(found) == expected and len(found) == len(expected)


def test_a_place_described_several_times_is_one_observation():
    f = [features(4, k) for k in range(3)]
    for photo in f[:2]:
        photo.px[3] = photo.px[0]  # one place, two orientations
    links = [link(0, 1, [(0, 0), (3, 3), (1, 1)]), link(1, 2, [(3, 2), (1, 0)])]
    tracks = build_tracks(f, links)
    found = observed(tracks)

    def at(photo, k):
        return photo, tuple(f[photo].px[k].tolist())

    assert found == {
        frozenset({at(0, 0), at(1, 0), at(2, 2)}),
        frozenset({at(0, 1), at(1, 1), at(2, 0)}),
    }
    assert len(tracks.point) == 6


def test_no_links_no_tracks():
    tracks = build_tracks([features(3)], [])
    assert tracks.count == 0 and len(tracks.px) == 0


def random_tracks(seed, count=800, photos=12):
    rng = np.random.default_rng(seed)
    length = rng.integers(2, 7, count)
    point = np.repeat(np.arange(count), length)
    photo = np.concatenate([np.sort(rng.choice(photos, k, replace=False)) for k in length])
    px = rng.uniform(-0.5, [799.5, 599.5], (len(point), 2))
    return Tracks(point=point, photo=photo, px=px, sigma_px=np.full(len(point), 0.3))


def test_only_drops_tracks_left_with_one_observation():
    tracks = random_tracks(0)
    keep = np.random.default_rng(1).random(len(tracks.point)) < 0.4
    left = tracks.only(keep)
    number = np.bincount(tracks.point[keep], minlength=tracks.count)
    assert left.count == (number >= 2).sum()
    assert len(left.point) == number[number >= 2].sum()
    assert (np.bincount(left.point) >= 2).all()


def test_a_photo_whose_observations_lie_in_few_cells_keeps_them_all():
    tracks = random_tracks(2, count=3000)
    shore = (tracks.photo == 5) & (tracks.px[:, 0] > 80)  # the rest of photo 5 is water
    tracks = tracks.only(~shore)
    had = np.bincount(tracks.photo)
    few, many = (
        np.bincount(thin(tracks, [(800, 600)] * 12, per_photo=64, least=k).photo) for k in (0, 150)
    )
    assert few[5] < had[5] and many[5] == had[5]
    assert (many >= np.minimum(had, 150)).all()
    assert many.sum() < 0.9 * had.sum()


def test_thinning_keeps_every_cell_of_every_photo_and_its_longest_tracks():
    tracks = random_tracks(2, count=3000)
    cells, per_photo = 4, 64
    thinned = thin(tracks, [(800, 600)] * 12, per_photo=per_photo, cells=cells)
    assert len(thinned.point) < 0.75 * len(tracks.point)

    def slots(t):
        column, row = np.clip(((t.px + 0.5) / (800, 600) * cells).astype(int), 0, cells - 1).T
        return t.photo * cells**2 + row * cells + column

    all_, kept = (
        np.bincount(slots(tracks), minlength=192),
        np.bincount(slots(thinned), minlength=192),
    )
    assert (kept >= np.minimum(all_, per_photo // cells**2)).all()
    assert np.bincount(thinned.point).mean() > np.bincount(tracks.point).mean() + 0.3
    # whole tracks survive or none of them
    number = np.bincount(tracks.point)[tracks.point]
    lengths = dict(zip(map(tuple, tracks.px.tolist()), number, strict=True))
    assert all(
        lengths[tuple(p)] == n
        for p, n in zip(thinned.px.tolist(), np.bincount(thinned.point)[thinned.point], strict=True)
    )


def test_rays_meet_in_their_point():
    rng = np.random.default_rng(3)
    X = rng.normal(0, 20, (30, 3))
    point = np.repeat(np.arange(30), 3)
    origin = rng.normal(0, 20, (90, 3)) + np.array([0, 0, 80])
    direction = (X[point] - origin) * rng.uniform(0.1, 5, (90, 1))
    assert intersect(point, origin, direction, 30) == pytest.approx(X, abs=1e-5)


def test_two_skew_rays_meet_halfway_between():
    found = intersect(
        np.array([0, 0]), np.array([[0.0, 0, 0], [0, 0, 1]]), np.array([[3.0, 0, 0], [0, 2, 0]]), 1
    )
    assert found[0] == pytest.approx([0, 0, 0.5], abs=1e-6)


def test_polished_points_err_as_their_deviation_says():
    """Heights over 20 blocks of true poses: normalised errors have unit variance (Cauchy's 0.79 at
    its scale of 2).
    """
    z = []
    for seed in range(8):
        block = make_block(seed, lines=2, per_line=4, points=300, loss_px=1e6)
        state, sigma = polish(block.problem, replace(block.truth, X=block.truth.X + 0.5))
        z.append((state.X - block.truth.X)[:, 2] / sigma)
    z = np.concatenate(z)
    assert np.mean(z**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(z)))
    assert abs(np.mean(z)) < 4 / np.sqrt(len(z))
