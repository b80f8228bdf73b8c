"""Small flights of known truth, and live maps served on this machine."""

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from skyquilt.live.adjustment_schedule import QUIET_S
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.live.workflow import iter_live
from skyquilt.server.access import Guard
from skyquilt.server.server_thread import ServerThread
from skyquilt.server.survey import LiveSurvey
from skyquilt.simulate import FlightSettings
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Reporting, Route, Thermal
from tests.once import flown_once, pictures_seen_before  # noqa: F401 - a fixture


@dataclass(frozen=True, kw_only=True)
class Flight:
    """A simulated flight."""

    folder: Path
    truth: dict[str, Any]

    @property
    def photos(self) -> list[Path]:
        return sorted((self.folder / "photos").glob("*.jpg"))

    def centre(self, name: str) -> np.ndarray:
        """True camera centre (3,) in the CRS."""
        return np.array(next(p["position"] for p in self.truth["photos"] if p["name"] == name))

    def rotation(self, name: str) -> np.ndarray:
        return np.array(next(p["cam_R_map"] for p in self.truth["photos"] if p["name"] == name))


def made(temporary: pytest.TempPathFactory, name: str, **settings: Any) -> Flight:
    """A flight of 480 x 360 px, unless `settings` have another lens."""
    flown = FlightSettings(**{"lens": Lens().scaled(480, 360), **settings})
    folder = flown_once(temporary, name, flown)
    return Flight(folder=folder, truth=json.loads((folder / "truth" / "truth.json").read_text()))


def fed(live: LiveMap, paths: Sequence[Path]) -> LiveMap:
    """The map after it has worked on all these photos, and on what waits for quiet."""
    for path in paths:
        live.add(path)
    live.blocks.last_arrival = -1e9  # as if it had been quiet for long
    for _ in live.drain_all():
        pass
    return live


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Six photos in two lines."""
    return made(
        tmp_path_factory,
        "small",
        seed=3,
        route=Route(photos=6),
        control=Control(points=0, checks=0),
    )


@pytest.fixture(scope="session")
def drones(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Eighteen photos from two drones whose clocks are 40 s apart; one line reports its yaw 180
    degrees off.
    """
    return made(
        tmp_path_factory,
        "drones",
        seed=5,
        route=Route(photos=18, drones=2),
        control=Control(points=0, checks=0),
        reporting=Reporting(clock_offsets=(0.0, 40.0), yaw_lie="tag"),
    )


@pytest.fixture(scope="session")
def both(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Six visible photos and the thermal frames of a second drone, whose files state their unit."""
    thermal = Thermal(
        lens=Lens(width=320, height=256, focal=386.0, k1=-0.2, k2=0.05, p1=0.0, p2=0.0)
    )
    return made(
        tmp_path_factory,
        "both",
        seed=3,
        route=Route(photos=6),
        control=Control(points=0, checks=0),
        thermal=thermal,
    )


@dataclass(frozen=True, kw_only=True)
class Served:
    """A live map that runs, and a client."""

    live: LiveMap
    web: httpx.Client
    url: str
    folder: Path

    def send(self, path: Path, name: str | None = None, **more: Any) -> httpx.Response:
        return self.web.post(
            "/photos", params={"name": name or path.name}, content=path.read_bytes(), **more
        )

    def until(self, holds: Callable[[], bool], seconds: float = 300.0) -> None:
        """Waits."""
        for _ in range(int(seconds / 0.05)):
            if holds():
                return
            threading.Event().wait(0.05)
        raise AssertionError("it did not happen in time")

    def settle(self) -> None:
        """Waits until nothing is left to place or to draw and photos stay where they are: pictures
        fetched one after the other then show one state.
        """

        def still() -> bool:
            live = self.live
            redraw, schedule = live.redraw, live.schedule
            if live.queues.received or live.queues.untried:
                return False
            if redraw.urgent or redraw.pending:
                return False
            if redraw.dirty or redraw.later or live.background.busy or schedule.under_way:
                return False
            # a quiet moment begins an adjustment of each block that was not adjusted as it is now
            quiet_s = time.monotonic() - live.blocks.last_arrival
            left = live.blocks._unfinished(True) or (schedule.since and quiet_s < QUIET_S + 1)
            if live.settings.reposition and left:
                return False
            before = self.web.get("/photos").json()
            threading.Event().wait(0.5)
            return bool(self.web.get("/photos").json() == before)

        self.until(still)

    def states(self) -> dict[str, str]:
        return {p["name"]: p["state"] for p in self.web.get("/photos").json()["photos"]}


@contextmanager
def served(
    folder: Path,
    settings: LiveSettings | None = None,
    guard: Guard | None = None,
    inbox: Path | None = None,
    port: int = 0,
) -> Iterator[Served]:
    """A live map with its server and its mapping thread; all end with the block."""
    live = LiveMap(folder, settings)
    stop = threading.Event()
    mapping = threading.Thread(
        target=lambda: [None for _ in iter_live([inbox] if inbox else [], live, stop=stop)],
        daemon=True,
    )
    guard = guard or Guard()
    with ServerThread(
        survey=LiveSurvey(folder), guard=guard, folder=folder, writer=live, port=port
    ) as serving:
        mapping.start()
        headers = {"X-Token": guard.token} if guard.token else {}
        # without certificates, which plain HTTP does not need: to load them takes 20 ms
        with httpx.Client(base_url=serving.url, headers=headers, timeout=60, verify=False) as web:
            try:
                yield Served(live=live, web=web, url=serving.url, folder=folder)
            finally:
                stop.set()
                mapping.join(60)
                live.close()


def offsets(live: LiveMap, flight: Flight) -> np.ndarray:
    """Errors (n, 3) in m of the centres of all photos on the map, their common shift removed."""
    origin = np.array([*live.members.frame.origin, 0.0])
    found = [m.pose.map_C + origin - flight.centre(m.photo.name) for m in live.members.on_map()]
    return np.array(found) - np.median(found, axis=0)
