import errno
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from skyquilt.engine import codec
from skyquilt.engine.store import Store, digest
from skyquilt.errors import OutputError
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.methods import methods_for


@pytest.fixture
def store(tmp_path):
    return Store(folder=tmp_path / "store", registry={})


def test_made_once_then_found(store):
    calls = []
    for _ in range(3):
        value = store.get_or("stage", "key", lambda: calls.append(1) or [1, np.arange(3)])
    assert (len(calls), store.misses, store.hits) == (1, 1, 2)
    assert value[1].tolist() == [0, 1, 2]


def test_another_store_on_the_same_folder_finds_it(store):
    store.put("stage", "key", [1.5, float("nan")])
    value = Store(folder=store.folder, registry={}).get("stage", "key")
    assert value[0] == 1.5
    assert np.isnan(value[1])


@pytest.mark.parametrize("size", [0, 1, 50, -1])
def test_a_torn_artefact_is_made_again(store, size):
    store.put("stage", "key", list(range(10)))
    path = store.folder / "stage" / "key.npz"
    path.write_bytes(path.read_bytes()[:size])
    assert store.get("stage", "key") is None
    assert store.get_or("stage", "key", lambda: [7]) == [7]
    assert store.get("stage", "key") == [7]


@pytest.mark.parametrize("other", ["stage/b", "another/a"])
def test_an_artefact_in_the_place_of_another_is_made_again(store, other):
    """Files that a program or a person exchanged are whole, and of the same kind."""
    stage, key = other.split("/")
    store.put("stage", "a", 1.0)
    store.put(stage, key, 2.0)
    theirs = (store.folder / stage / f"{key}.npz").read_bytes()
    (store.folder / "stage" / "a.npz").write_bytes(theirs)
    assert store.get("stage", "a") is None
    assert store.get_or("stage", "a", lambda: 1.0) == 1.0
    assert (store.get("stage", "a"), store.get(stage, key)) == (1.0, 2.0)


def test_what_is_there_is_told_without_reading_it(store):
    assert not store.has("stage", "key")
    store.put("stage", "key", [1])
    hits = store.hits
    assert store.has("stage", "key") and store.hits == hits + 1
    (store.folder / "stage" / "key.npz").write_bytes(b"")
    assert not store.has("stage", "key")


def test_values_that_count_as_nothing_are_kept(store):
    for value in ([], 0, "", {}):
        store.put("stage", "key", value)
        assert store.get_or("stage", "key", lambda: pytest.fail("made again")) == value


def test_a_full_disk_leaves_the_former_artefact(store, monkeypatch):
    store.put("stage", "key", [1])

    def full(file, value, name):
        file.write(b"PK")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("skyquilt.engine.store.write", full)
    with pytest.raises(OutputError, match=r"disk is full.*same command again"):
        store.put("stage", "key", [2])
    monkeypatch.undo()
    assert store.get("stage", "key") == [1]
    assert [p.name for p in (store.folder / "stage").iterdir()] == ["key.npz"]


def test_forgetting_concerns_only_the_stages_named(store):
    for stage in ("a", "b"):
        store.put(stage, "key", [1])
    store.forget(["a", "never there"])
    assert store.get("a", "key") is None
    assert store.get("b", "key") == [1]


def test_a_digest_depends_on_values_only():
    array = np.arange(6.0).reshape(2, 3)
    assert digest(array, (1, "a"), {"x": 1, "y": 2}) == digest(
        array.copy(), [1, "a"], {"y": 2, "x": 1}
    )
    assert len({digest(v) for v in (1, 2, "1", None, True, (1,), array, -array)}) == 8


def test_arrays_of_other_shape_or_type_are_other_inputs():
    """Equal bytes do not make equal arrays."""
    flat = np.arange(6.0)
    assert len({digest(flat), digest(flat.reshape(2, 3)), digest(flat.view(np.int64))}) == 3


def test_a_method_is_known_by_its_parameters_and_version(monkeypatch):
    first = methods_for(MosaicSettings())
    assert digest(first.detector) == digest(methods_for(MosaicSettings()).detector)
    other = methods_for(MosaicSettings(features=500))
    assert digest(first.detector) != digest(other.detector)
    before = digest(first.align)
    monkeypatch.setattr(type(first.align.bundle.bundle), "version", 99)
    assert digest(first.align) != before


def test_what_a_digest_does_not_know_is_refused():
    """Its text says nothing of its value: two such things would share one key, or one have two."""
    for value in (object(), {"a": object()}, lambda: 0, np.array([object()]), iter(())):
        with pytest.raises(TypeError, match="key cannot be made of"):
            digest(value)


def test_a_digest_tells_keys_sets_and_bytes_by_value():
    assert digest({1: "a"}) != digest({"1": "a"})
    assert digest({3, 1, 2}) == digest(frozenset((1, 2, 3))) != digest((1, 2, 3))
    assert len({digest(v) for v in (b"a", "a", 1j, Path("a") / "b")}) == 4


def test_a_function_is_known_by_its_name_and_constants():
    assert digest(digest) == digest(digest) != digest(pytest.raises)


def test_what_a_killed_process_left_is_removed(store):
    store.put("stage", "key", [1])
    left = store.folder / "stage" / "key.elsewhere-77.partial"
    left.write_bytes(b"torn")
    store.tidy()
    assert not left.exists() and store.get("stage", "key") == [1]


def test_two_processes_may_make_the_same_result(store, monkeypatch):
    """The other one finishes while this one writes."""
    other = Store(folder=store.folder, registry={})

    def meanwhile(file, value, name):
        monkeypatch.undo()
        monkeypatch.setattr("os.getpid", lambda: 77)
        other.put("stage", "key", [1])
        codec.write(file, value, name)

    monkeypatch.setattr("skyquilt.engine.store.write", meanwhile)
    store.put("stage", "key", [1])
    assert store.get("stage", "key") == [1]
    assert not list(store.folder.rglob("*.partial"))


@pytest.mark.slow
def test_threads_that_make_the_same_do_not_take_it_from_one_another(store):
    """Eight threads store one key at a time, a hundred times."""
    meet = threading.Barrier(8, timeout=30)

    def put(k):
        for n in range(100):
            meet.wait()
            store.put("stage", f"{n}", [n] * 200)
        return k

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(put, range(8))) == list(range(8))
    assert all(store.get("stage", f"{n}") == [n] * 200 for n in range(100))
    assert not list(store.folder.rglob("*.partial"))
