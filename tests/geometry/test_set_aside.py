"""Values that lie in a temporary file while they are not needed."""

import numpy as np
import pytest

from skyquilt.geometry import set_aside
from skyquilt.geometry.set_aside import SetAside


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
