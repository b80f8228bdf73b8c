"""A small simulated flight and its mosaic, made once."""

import gc
import json
import pickle
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zlib import crc32

import pytest
from hypothesis import settings as hypothesis_settings

from skyquilt.engine.free_memory import return_large_blocks
from skyquilt.model.event import Event, Result
from skyquilt.settings import MosaicSettings
from skyquilt.simulate import FlightSettings
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Route
from skyquilt.workflows.mosaic import iter_mosaic
from tests.once import flown_once, once_for_all

DATA = Path(__file__).parents[2] / "shared" / "data"

return_large_blocks()  # as the program does: pages that are asked for again and again cost a tenth

# on a busy machine a time limit per example judges the machine
hypothesis_settings.register_profile("skyquilt", deadline=None)
hypothesis_settings.load_profile("skyquilt")


@dataclass(frozen=True, kw_only=True)
class Finished:
    """A run's folder and what it told."""

    output: Path
    events: list[Event]

    def json(self, name: str) -> Any:
        return json.loads((self.output / name).read_text())

    @property
    def metrics(self) -> dict[str, Any]:
        return self.json("metrics.json")


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine photos of 800 x 600 px, `gcp_list.txt` beside their folder `photos`, and `truth`."""
    settings = FlightSettings(
        seed=3,
        lens=Lens().scaled(800, 600),
        route=Route(photos=9),
        control=Control(points=5, checks=3),
    )
    return flown_once(tmp_path_factory, "large", settings)


@pytest.fixture(scope="session")
def finished(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The flight's mosaic with control points, made once for all processes."""

    def make(folder: Path) -> None:
        settings = MosaicSettings(gcp=flight / "gcp_list.txt", jobs=2)
        events = list(iter_mosaic(flight / "photos", folder / "out", settings))
        assert isinstance(events[-1], Result)
        (folder / "events").write_bytes(pickle.dumps(events))

    folder = once_for_all(tmp_path_factory, "large map", make)
    # a copy: some tests lay something beside the map for a moment
    output = shutil.copytree(folder / "out", tmp_path_factory.mktemp("finished") / "out")
    return Finished(output=output, events=pickle.loads((folder / "events").read_bytes()))


BEGAN_S = time.monotonic()


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--within`, for CI: on a slow machine it leaves out what is last."""
    parser.addoption("--within", type=float, metavar="S", help="skip slow tests that begin later")


@pytest.hookimpl(tryfirst=True)  # before the test's fixtures are made
def pytest_runtest_setup(item: pytest.Item) -> None:
    most = item.config.getoption("--within")
    if most is not None and time.monotonic() - BEGAN_S > most and item.get_closest_marker("slow"):
        pytest.skip(f"the {most:.0f} s for slow tests are over (`make test-all` has no limit)")


LONG = ("test_large_survey", "test_windows", "test_docs")
"""Files of tests that take a minute and more."""
DEAR = (
    "calibration/test_few_views.py",
    "end_to_end/test_thermal_simulated.py",
    "live/test_crash.py",
    "live/test_elsewhere.py",
    "live/test_finish.py",
    "live/test_heights.py",
    "live/test_lenses.py",
    "live/test_marks.py",
    "live/test_placeless.py",
    "thermal/test_thermal_rig.py",
    "workflows/test_cluster.py",
)
"""Files of tests that take half a minute each: where time is limited, ten others come first."""


def turn(path: Path) -> int:
    """0 for the longest files, 2 for dear ones, 1 for all others."""
    dear = f"{path.parent.name}/{path.name}" in DEAR
    return 0 if path.stem in LONG else 1 + dear


def further_cases(items: list[pytest.Item]) -> set[str]:
    """Ids of slow tests that are further cases of a function: another one is quick, or a slow one
    before them.
    """
    slow = [item for item in items if item.get_closest_marker("slow")]
    run = [item for item in slow if not item.get_closest_marker("long")]
    own = {item.nodeid: item.nodeid.partition("[")[0] for item in items}
    known = {own[item.nodeid] for item in items if not item.get_closest_marker("slow")}
    further = set()
    for item in run:
        if own[item.nodeid] in known:
            further.add(item.nodeid)
        known.add(own[item.nodeid])
    return further


@pytest.hookimpl(tryfirst=True)  # before xdist looks for groups
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The longest files begin first, so that none runs alone after all others. Where time is
    limited, every function's first case comes before further cases of any, what is dear comes last
    of both, and files are mixed, always alike: what is left out is then no subject as a whole. The
    two parts of a file are groups of their own (`--dist loadgroup`).
    """
    if config.getoption("--within") is not None:
        further = further_cases(items)
        for item in items:
            group = f"{item.nodeid.partition('::')[0]} {int(item.nodeid in further)}"
            item.add_marker(pytest.mark.xdist_group(group))
        items.sort(key=lambda item: crc32(item.path.name.encode()))
        items.sort(key=lambda item: (item.nodeid in further, turn(item.path)))
    else:
        items.sort(key=lambda item: item.path.stem not in LONG)


def pytest_collection_finish() -> None:
    """Modules and thousands of tests stay to the end: they need not be looked through for garbage
    again and again.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture
def survey_data() -> Callable[[str], Path]:
    """A real survey beside the checkout; the test is skipped where it is missing."""

    def find(name: str) -> Path:
        if not (DATA / name).is_dir():
            pytest.skip(f"real survey missing: {DATA / name}")
        return DATA / name

    return find


@pytest.fixture(scope="module")
def browser():
    """A real browser, without a window."""
    from playwright.sync_api import sync_playwright

    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip("no Chromium is installed: apt install chromium")
    with sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield chromium
        chromium.close()
