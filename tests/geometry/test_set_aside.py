"""Values that lie in a temporary file while they are not needed."""

import numpy as np
import pytest

from skyquilt.engine.memory_watch import resident_bytes
from skyquilt.geometry import set_aside
from skyquilt.geometry.set_aside import InFile, SetAside


@pytest.mark.parametrize("large", [True, False])
def test_a_value_comes_back_as_often_as_it_is_asked_for(large):
    value = {"px": np.random.default_rng(1).normal(size=(1000, 2)), "name": "a"}
    aside = SetAside(value, large=large)
    for _ in range(2):
        back = aside.get()
        assert np.array_equal(back["px"], value["px"]) and back["name"] == "a"
        assert (back is value) is not large


def test_large_values_leave_the_memory():
    import tracemalloc

    tracemalloc.start()
    try:
        aside = SetAside(np.ones(4_000_000))
        held, most = tracemalloc.get_traced_memory()
        assert held < 1e6 and most < 34e6  # written without a copy
        assert aside.get().sum() == 4_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("missing", ["folder", "space"])
def test_without_a_disk_for_it_a_value_stays_in_memory(monkeypatch, missing):
    class Full:
        def write(self, data):
            raise OSError(28, "No space left on device")

    def temporary(dir):
        if missing == "folder":
            raise FileNotFoundError(2, "no folder for temporary files")
        return Full()

    monkeypatch.setattr(set_aside, "TemporaryFile", temporary)
    assert SetAside([1, 2, 3]).get() == [1, 2, 3]


@pytest.mark.parametrize("large", [True, False])
@pytest.mark.parametrize("shape", [(0,), (5,), (3, 2), (100_000, 2)])
def test_an_array_in_a_file_is_the_same_before_and_after_its_memory_is_given_back(shape, large):
    values = np.random.default_rng(2).integers(0, 60_000, shape).astype(np.uint16)
    held = InFile(values, large=large)
    for _ in range(2):
        assert held.values.dtype == values.dtype and np.array_equal(held.values, values)
        held.release()
    assert (held.values is values) == (not large or not values.size)


def test_an_array_in_a_file_takes_memory_only_while_it_is_used():
    held = InFile(np.ones(16_000_000))
    before = resident_bytes()
    assert held.values.sum() == 16_000_000
    assert resident_bytes() > before + 100e6
    held.release()
    assert resident_bytes() < before + 10e6


def test_without_a_disk_for_it_an_array_stays_in_memory(monkeypatch):
    def none(dir):
        raise FileNotFoundError(2, "no folder for temporary files")

    monkeypatch.setattr(set_aside, "TemporaryFile", none)
    values = np.arange(9)
    held = InFile(values)
    held.release()
    assert held.values is values
