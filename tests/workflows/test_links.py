"""Links are stored packed, and those of a survey as one artefact that a resumed run reads."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt.alignment.tracks import blocks_of
from skyquilt.engine.codec import decode, encode
from skyquilt.matching.through_others import ThroughOthers
from skyquilt.model.features import Link, RejectedLink, numbers
from skyquilt.settings import MosaicSettings
from skyquilt.workflows import links
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.links import PackedLinks, _Linker
from skyquilt.workflows.mosaic import iter_mosaic, mosaic
from tests.matching.test_through_others import SIZE, flown, linked, overlap, seen

places = st.lists(st.integers(0, 70_000), max_size=6)
found = st.lists(
    st.one_of(
        places.map(lambda v: ("link", v)), st.sampled_from(["weak", "", "no common similarity"])
    ),
    max_size=8,
)


@given(found)
def test_packed_links_are_the_links(some):
    pairs = []
    for k, what in enumerate(some):
        if isinstance(what, str):
            pairs.append(RejectedLink(a=k, b=k + 1, reason=what))
        else:
            index = numbers(np.array(what[1], np.int64))
            pairs.append(
                Link(a=k, b=k + 2, index_a=index, index_b=index[::-1], b_S_a=complex(k, -1))
            )
    again = list(decode(encode(PackedLinks.of(pairs)), REGISTRY))
    assert len(again) == len(pairs)
    for one, two in zip(pairs, again, strict=True):
        assert type(one) is type(two) and (one.a, one.b) == (two.a, two.b)
        if isinstance(one, Link):
            assert one.index_a.tolist() == two.index_a.tolist()
            assert one.index_b.tolist() == two.index_b.tolist()
            assert one.b_S_a == two.b_S_a
        else:
            assert one.reason == two.reason


@pytest.mark.parametrize(
    ("largest", "kind"), [(0, np.uint16), (65_535, np.uint16), (65_536, np.int64)]
)
def test_numbers_take_the_room_they_need(largest, kind):
    given = np.array([0, largest])
    assert numbers(given).dtype == kind and numbers(given).tolist() == given.tolist()
    assert numbers(np.zeros(0, np.int64)).dtype == np.uint16


def looked_for(maps, reach=2, rounds=4, xy=None):
    """The pairs that are compared of photos (affine maps from the ground), whose positions tell of
    neighbours in the order of capture only; and those that are links.
    """
    features, places = seen(maps)
    n = len(maps)

    def compared(pairs):
        found = []
        for a, b in pairs:
            link = linked(a, b, places)
            found.append(link if len(link) > 30 else RejectedLink(a=a, b=b, reason="few"))
        return found

    def alike(features, asked):
        shown = {i: set(places[i].tolist()) for i in range(n)}
        return [
            (min(i, j), max(i, j))
            for i in asked
            for j in range(n)
            if i != j and shown[i] & shown[j]
        ]

    linker = SimpleNamespace(
        found=SimpleNamespace(
            photos=[SimpleNamespace(width=SIZE[0], height=SIZE[1])] * n, features=features
        ),
        methods=SimpleNamespace(through_others=ThroughOthers(rounds=rounds), retrieval=alike),
        xy=np.arange(n)[:, None] * [10.0, 0.0] if xy is None else xy,
        nearest=lambda reach_m=None: [(i, i + k) for k in range(1, reach) for i in range(n - k)],
        batch=compared,
    )
    workers = SimpleNamespace(each=lambda do, parts: map(do, parts))
    steps = links._linked(linker, workers)
    counts = []
    try:
        while True:
            counts.append(next(steps))
    except StopIteration as end:
        tried = end.value
    assert all(done <= total for done, total in counts)
    pairs = [(k.a, k.b) for k in tried]
    assert len(set(pairs)) == len(pairs)
    return pairs, {(k.a, k.b) for k in tried if isinstance(k, Link)}


@pytest.mark.slow
def test_photos_that_look_to_all_sides_are_compared_with_what_they_share():
    """Neighbours in the order of capture hardly connect them; their true overlaps do."""
    maps = flown(24, 5, spread=60.0)
    n = len(maps)
    shares = {(a, b): overlap(maps, a, b) for a in range(n) for b in range(a + 1, n)}
    _, found = looked_for(maps)
    near = {(i, i + 1) for i in range(n - 1)}
    assert len(found & near) < n / 2 < 0.3 * len(found)
    count = np.bincount(np.array(sorted(found)).ravel(), minlength=n)
    missed = {
        (a, b) for (a, b), s in shares.items() if s > 0.5 and (a, b) not in found
    }  # not of photos that have links enough
    assert all(max(count[a], count[b]) >= 8 for a, b in missed)
    assert len(set(blocks_of(n, [linked(*p, seen(maps)[1]) for p in found]).tolist())) == 1


def test_photos_that_positions_connect_are_asked_no_further():
    """Each overlaps the next one by half and no other one by as much."""
    step = SIZE[0] / 20
    linear = np.eye(2) * 10
    maps = [
        np.column_stack([linear, np.array(SIZE) / 2 - linear @ (k * step - 150, 0.0)])
        for k in range(8)
    ]
    pairs, found = looked_for(maps, reach=3)
    assert sorted(pairs) == sorted({(i, i + k) for k in (1, 2) for i in range(8 - k)})
    assert found == {(i, i + 1) for i in range(7)}


def test_ground_that_looks_alike_far_away_is_not_compared():
    """Two lines over the same pattern, 1 km or 20 m apart by their positions."""
    half = np.eye(2) * 10
    line = [
        np.column_stack([half, np.array(SIZE) / 2 - half @ (k * 30.0 - 60, 0.0)]) for k in range(6)
    ]
    x = np.tile(np.arange(6) * 30.0, 2)
    across = {}
    for apart in (20.0, 1000.0):
        xy = np.column_stack([x, np.repeat([0.0, apart], 6)])
        pairs, _ = looked_for(line * 2, xy=xy)
        across[apart] = {(a, b) for a, b in pairs if a < 6 <= b} - {(5, 6)}
    assert {(k, k + 6) for k in range(6)} <= across[20.0]
    assert not across[1000.0]


@pytest.mark.slow
def test_a_run_that_goes_on_takes_all_links_at_once(flight, tmp_path, monkeypatch):
    quick = MosaicSettings(surface="ties", gsd_cm=30.0, jobs=1, features=1500)
    first = mosaic(flight / "photos", tmp_path / "out", quick).metrics
    asked = []
    batch = _Linker.batch
    monkeypatch.setattr(_Linker, "batch", lambda self, p: (asked.append(p), batch(self, p))[1])
    again = {"overwrite": True, "rerun_from": "align"}
    *_, last = iter_mosaic(flight / "photos", tmp_path / "out", quick, **again)
    assert not asked
    assert last.metrics["links"] == first["links"] > 8
    assert last.metrics["pairs_rejected"] == first["pairs_rejected"]
    # of other photos, batches that are there are used and the rest is matched
    names = sorted((flight / "photos").iterdir())[:-1]
    mosaic(names, tmp_path / "fewer", quick)
    assert asked


@pytest.mark.slow
def test_matches_in_files_give_the_same_map(flight, tmp_path, monkeypatch):
    quick = MosaicSettings(surface="ties", gsd_cm=30.0, jobs=1, features=1500)
    mosaic(flight / "photos", tmp_path / "memory", quick)
    monkeypatch.setattr(links, "LONG", 0)
    held = []
    in_files = PackedLinks.in_files

    def watched(self):
        held.extend(in_files(self))
        return tuple(held)

    monkeypatch.setattr(PackedLinks, "in_files", watched)
    mosaic(flight / "photos", tmp_path / "files", quick)
    assert len(held) == 2 and all(not part.values.flags.writeable for part in held)
    one, two = ((tmp_path / name / "mosaic.tif").read_bytes() for name in ("memory", "files"))
    assert one == two
