"""Which slow tests come first where time is limited."""

from pathlib import Path
from types import SimpleNamespace

from tests.conftest import DEAR, LONG, further_cases, turn


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


def test_dear_and_long_files_are_there():
    tests = Path(__file__).parent
    assert all(turn(tests / name) == 2 and (tests / name).is_file() for name in DEAR)
    assert all(turn(path) == 0 for name in LONG for path in tests.rglob(f"{name}.py"))
    assert len(LONG) == sum(1 for name in LONG for _ in tests.rglob(f"{name}.py"))
    assert turn(tests / "alignment" / "test_heights.py") == 1
