"""Pairs through photos between them, against the true overlap of their footprints."""

import numpy as np
import pytest
from shapely.geometry import Polygon

from skyquilt.matching.through_others import ThroughOthers
from skyquilt.model.features import Features, Link

SIZE = (800, 600)
GROUND = np.random.default_rng(7).uniform(-200, 200, (6000, 2))
"""Places that photos show, in m."""


def flown(count, seed, spread=45.0):
    """Photos of level ground as they are taken by hand: the affine maps (2, 3) from m to px."""
    rng = np.random.default_rng(seed)
    maps = []
    for _ in range(count):
        turn, stretch = rng.uniform(-np.pi, np.pi), np.diag(rng.uniform(7, 12, 2))
        c, s = np.cos(turn), np.sin(turn)
        linear = stretch @ np.array([[c, -s], [s, c]])
        middle = rng.uniform(-spread, spread, 2)
        maps.append(np.column_stack([linear, np.array(SIZE) / 2 - linear @ middle]))
    return maps


def seen(maps):
    """Features of each photo, and the ground places that they are."""
    features, places = [], []
    for m in maps:
        px = GROUND @ m[:, :2].T + m[:, 2]
        inside = np.flatnonzero(((px >= 0) & (px < SIZE)).all(1))
        features.append(
            Features(
                px=px[inside],
                size=np.ones(len(inside), np.float32),
                descriptors=np.zeros((len(inside), 4), np.uint8),
                scale=1.0,
            )
        )
        places.append(inside)
    return features, places


def linked(a, b, places):
    _, index_a, index_b = np.intersect1d(places[a], places[b], return_indices=True)
    return Link(a=a, b=b, index_a=index_a, index_b=index_b, b_S_a=1 + 0j)


def overlap(maps, a, b):
    """The larger of the shares of two photos that the other one shows."""

    def footprint(m):
        corners = np.array([(0, 0), (SIZE[0], 0), SIZE, (0, SIZE[1])], float)
        return Polygon(np.linalg.solve(m[:, :2], (corners - m[:, 2]).T).T)

    one, two = footprint(maps[a]), footprint(maps[b])
    return one.intersection(two).area / min(one.area, two.area)


@pytest.mark.parametrize("seed", range(4))
def test_all_that_overlap_are_found_and_no_others(seed):
    """By the true footprints; the share is counted at 49 places, so it may be off by a few."""
    maps = flown(20, seed)
    features, places = seen(maps)
    shares = {(a, b): overlap(maps, a, b) for a in range(20) for b in range(a + 1, 20)}
    # every third pair that overlaps by far is linked
    links = [linked(*pair, places) for pair in [p for p, s in shares.items() if s > 0.4][::3]]
    tried = {(k.a, k.b) for k in links}
    near = [{k.other(i) for k in links if i in (k.a, k.b)} for i in range(20)]
    method = ThroughOthers(enough=99, each=99)
    found = set(method(links, features, [SIZE] * 20, tried))
    asked = {p for p in shares if p not in tried and near[p[0]] & near[p[1]]}
    assert len(asked) > 20
    assert found <= asked
    assert {p for p in asked if shares[p] > method.overlap + 0.05} <= found
    assert all(shares[p] > method.overlap - 0.05 for p in found)


def test_photos_with_links_enough_are_not_asked():
    maps = flown(12, 1, spread=10.0)  # all overlap
    features, places = seen(maps)
    links = [linked(a, b, places) for a in range(10) for b in range(a + 1, 10)]
    links += [linked(9, 10, places), linked(10, 11, places)]
    tried = {(k.a, k.b) for k in links}
    found = ThroughOthers(enough=8, each=99)(links, features, [SIZE] * 12, tried)
    assert found == [*((i, 10) for i in range(9)), (9, 11)]
    some = ThroughOthers(enough=8, each=3)(links, features, [SIZE] * 12, tried)
    assert set(some) < set(found)
    assert sum(10 in pair for pair in some) == 3


def test_links_that_tell_no_map_lead_nowhere():
    maps = flown(3, 2, spread=5.0)
    features, places = seen(maps)
    tried, sizes = {(0, 2), (1, 2)}, [SIZE] * 3
    whole = [linked(a, 2, places) for a in (0, 1)]
    assert ThroughOthers()(whole, features, sizes, tried) == [(0, 1)]
    few = [linked(a, 2, [p[:2] if i == a else p for i, p in enumerate(places)]) for a in (0, 1)]
    assert ThroughOthers()(few, features, sizes, tried) == []
    assert ThroughOthers()([], features, sizes, set()) == []
