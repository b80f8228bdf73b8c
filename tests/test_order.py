"""Which slow tests come first where time is limited."""

from types import SimpleNamespace

from tests.conftest import further_cases


def item(nodeid, *marks):
    return SimpleNamespace(nodeid=nodeid, get_closest_marker=lambda name: name in marks)


def test_first_cases_are_those_that_nothing_else_shows():
    items = [
        item("a.py::test_seeds[0]"),
        item("a.py::test_seeds[1]", "slow"),
        item("a.py::test_sizes[long]", "slow", "long"),  # not among those whose time is limited
        item("a.py::test_sizes[large]", "slow"),
        item("a.py::test_sizes[larger]", "slow"),
        item("a.py::test_whole", "slow"),
        item("b.py::test_sizes[small]", "slow"),
        item("b.py::test_late[1]", "slow"),
        item("b.py::test_late[0]"),
    ]
    assert further_cases(items) == {
        "a.py::test_seeds[1]",
        "a.py::test_sizes[larger]",
        "b.py::test_late[1]",
    }
