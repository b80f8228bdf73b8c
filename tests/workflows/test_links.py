"""Links are stored packed, and those of a survey as one artefact that a resumed run reads."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt.engine.codec import decode, encode
from skyquilt.model.features import Link, RejectedLink, numbers
from skyquilt.settings import MosaicSettings
from skyquilt.workflows import links
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.links import PackedLinks, _Linker
from skyquilt.workflows.mosaic import iter_mosaic, mosaic

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
