"""What a flight has done of its plan: photos matched to points, blur, coverage, progress.

It reads the ledger and the files of photos only, so any process can keep it, and the mapping does
not wait for it.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely import Polygon, union_all

from skyquilt.alignment.priors import utm_epsg
from skyquilt.errors import UnreadablePhotoError
from skyquilt.live.ledger import Ledger, footprint_from
from skyquilt.model.photo import RejectedPhoto
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo
from skyquilt.planning.ground_cover import Cover, cover_of, to_mercator, write_cover
from skyquilt.planning.missing import COVERAGE, STATE, planned_cover
from skyquilt.planning.records import Plan
from skyquilt.planning.site import in_zone
from skyquilt.raster.atomic import write_text
from skyquilt.video.looks import sharpness

ON_MAP = ("placed", "refined")
BLURRED = 1.0
"""How far the logarithm of a photo's fine detail over its coarse detail lies below the flight's
median where it counts as unsharp: simulated shakes of 16 px lie 1.6 to 2.7 below, sharp photos up
to 0.5.
"""
FEWEST = 5
"""Photos from which there is a median."""
NEAR = 0.6
"""Largest distance of a photo from its point, in shares of the distance of neighbouring points."""
LEAST_NEAR_M = 4.0
"""Receivers err by metres."""
VIEWS = 3
"""Views asked for where there is no plan."""
BEHIND = 2
"""A point is missing when so many later ones of its sortie have their photo."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MissionState:
    """A moment of a flight."""

    points: dict[int, str]
    """State of each point: planned, taken, missing or unsharp."""
    photos: dict[int, int]
    """Point of each photo that has one."""
    unsharp: frozenset[int]
    """Photos that are blurred."""
    drones: tuple[dict[str, Any], ...]
    """Progress: name, photos taken and planned, seconds left."""
    cover: Cover | None
    """The cells; None before there is an area."""
    counts: NDArray[np.int32] | None
    """(rows, columns) sharp photos of each cell."""
    views: int
    """Asked for."""

    @property
    def share(self) -> float:
        """Share of the area that has its views."""
        if self.cover is None or self.counts is None or not self.cover.inside.any():
            return 0.0
        return float((self.counts[self.cover.inside] >= self.views).mean())

    @property
    def missing_m2(self) -> float:
        """Area under the number asked for."""
        if self.cover is None or self.counts is None:
            return 0.0
        short = self.counts[self.cover.inside] < self.views
        return float(short.sum()) * self.cover.ground_m**2


@dataclass(kw_only=True, eq=False)
class Mission:
    """Follows a flight; each look costs as much as there are new photos."""

    folder: Path
    """The survey's folder with `live.db`."""
    plan: Plan | None
    """What is flown."""
    _sharp: dict[str, float] = field(default_factory=dict)
    _seen: dict[int, tuple[str, NDArray[np.int32]]] = field(default_factory=dict)
    _cover: Cover | None = None
    _waiting: bool = False

    def look(self, ledger: Ledger, photos: Path, *, budget: int = 10**9) -> MissionState:
        """The state by the ledger's photos, whose files lie in `photos`; at most `budget` photos
        are newly measured for blur.
        """
        query = "select id, state, file, footprint from photo order by id"
        rows = [
            (int(number), str(file), place)
            for number, state, file, place in ledger.rows(query)
            if state in ON_MAP and place
        ]
        self._measure((photos / Path(f).name for _, f, _ in rows), budget)
        levels = [self._sharp.get(Path(f).name, np.nan) for _, f, _ in rows]
        known = [v for v in levels if np.isfinite(v)]
        limit = float(np.median(known)) - BLURRED if len(known) >= FEWEST else -np.inf
        blurred = frozenset(n for (n, _, _), v in zip(rows, levels, strict=True) if v < limit)
        places = ((n, footprint_from(place)) for n, _, place in rows)
        placed = {n: place for n, place in places if place is not None}
        cover = self._area({n: p for n, p in placed.items() if n not in blurred})
        counts = None
        if cover is not None:
            sharp = [self._cells(n, p, cover) for n, p in placed.items() if n not in blurred]
            counts = cover.counts(sharp)
        matched = self._matched(placed)
        states = self._states(matched, blurred)
        return MissionState(
            points=states,
            photos=matched,
            unsharp=blurred,
            drones=self._progress(states),
            cover=cover,
            counts=counts,
            views=self.plan.proof.views if self.plan and self.plan.proof else VIEWS,
        )

    @property
    def waiting(self) -> bool:
        """Whether photos wait to be measured for blur."""
        return self._waiting

    def _measure(self, files: Iterable[Path], budget: int) -> None:
        self._waiting = False
        for path in files:
            if path.name in self._sharp:
                continue
            if budget <= 0:
                self._waiting = True
                return
            budget -= 1
            self._sharp[path.name] = _sharpness(path)

    def _area(self, placed: dict[int, Any]) -> Cover | None:
        """The plan's area, or, without a plan, what surrounds all photos."""
        if self.plan is not None:
            if self._cover is None:
                self._cover = planned_cover(self.plan)
            return self._cover
        rings = [np.array(p["ring"]) for p in placed.values() if len(p.get("ring", ())) > 2]
        if not rings:
            return None
        places = np.concatenate(rings)
        crs = utm_epsg(*places.mean(axis=0)[::-1])
        hull = union_all([Polygon(in_zone(crs, r)).buffer(0) for r in rings]).convex_hull
        if self._cover is None or not self._within(places):
            self._cover = cover_of(hull.buffer(0.15 * hull.length / 4), crs)
            self._seen.clear()
        return Cover(**{**vars(self._cover), "inside": self._drawn(hull, crs)})

    def _within(self, places: NDArray[np.float64]) -> bool:
        """Whether the raster is still large enough."""
        assert self._cover is not None
        west, south, east, north = self._cover.bounds
        (a, b), (c, d) = places.min(axis=0), places.max(axis=0)
        return bool(west <= a and south <= b and c <= east and d <= north)

    def _drawn(self, hull: Any, crs: str) -> NDArray[np.bool_]:
        assert self._cover is not None
        whole = Cover(**{**vars(self._cover), "inside": np.ones_like(self._cover.inside)})
        ring = to_mercator(np.array(hull.exterior.coords), crs)
        found = np.zeros(whole.inside.size, bool)
        found[whole.seen(ring)] = True
        return found.reshape(whole.inside.shape)

    def _cells(self, number: int, place: dict[str, Any], cover: Cover) -> NDArray[np.int32]:
        """Cells that a photo sees; computed again when it has moved."""
        key = json.dumps(place.get("ring", ()))
        known = self._seen.get(number)
        if known is None or known[0] != key:
            ring = np.array(place.get("ring", ()), np.float64).reshape(-1, 2)
            whole = Cover(**{**vars(cover), "inside": np.ones_like(cover.inside)})
            found = whole.seen(to_mercator(ring)) if len(ring) > 2 else np.empty(0, np.int32)
            known = self._seen[number] = (key, found)
        return known[1]

    def _matched(self, placed: dict[int, Any]) -> dict[int, int]:
        """The point next to each photo."""
        if self.plan is None or not self.plan.points:
            return {}
        xy = np.array([(p.x, p.y) for p in self.plan.points])
        tree = cKDTree(xy)
        apart = float(np.median(tree.query(xy, k=2)[0][:, 1])) if len(xy) > 1 else 20.0
        reach = max(NEAR * apart, LEAST_NEAR_M)
        numbers = [n for n, p in placed.items() if p.get("at")]
        if not numbers:
            return {}
        at = in_zone(self.plan.site.crs, np.array([placed[n]["at"] for n in numbers]))
        distance, index = tree.query(at, distance_upper_bound=reach)
        return {
            n: self.plan.points[int(i)].id
            for n, d, i in zip(numbers, distance, index, strict=True)
            if np.isfinite(d)
        }

    def _states(self, matched: dict[int, int], blurred: frozenset[int]) -> dict[int, str]:
        if self.plan is None:
            return {}
        good = {point for photo, point in matched.items() if photo not in blurred}
        poor = {point for photo, point in matched.items() if photo in blurred} - good
        states = {p.id: "planned" for p in self.plan.points}
        states.update(dict.fromkeys(good, "taken"))
        states.update(dict.fromkeys(poor, "unsharp"))
        for sortie in self.plan.sorties:
            order = [w.point for w in sortie.way if w.point is not None]
            later = 0
            for point in reversed(order):
                if states[point] == "planned" and later >= BEHIND:
                    states[point] = "missing"
                later += states[point] in ("taken", "unsharp")
        return states

    def _progress(self, states: dict[int, str]) -> tuple[dict[str, Any], ...]:
        if self.plan is None:
            return ()
        found = []
        for k, drone in enumerate(self.plan.drones):
            own = [s for s in self.plan.sorties if s.drone == k]
            stops = [w for s in own for w in s.way if w.point is not None]
            done = [w.time_s for w in stops if states[w.point or 0] in ("taken", "unsharp")]
            end = max((s.way[-1].time_s for s in own), default=0.0)
            found.append({
                "name": drone.name,
                "taken": len(done),
                "planned": len(stops),
                "seconds_left": round(end - max(done, default=0.0), 1),
            })  # fmt: skip
        return tuple(found)

    def write(self, state: MissionState) -> None:
        """Writes `coverage.tif` and, with a plan, the points without a sharp photo: what
        `skyquilt plan FOLDER` reads.
        """
        if state.cover is None or state.counts is None:
            return
        write_cover(self.folder / COVERAGE, state.cover, state.counts)
        if self.plan is not None:
            again = sorted(k for k, s in state.points.items() if s != "taken")
            record = {"again": again, "share": state.share, "views": state.views}
            write_text(self.folder / STATE, json.dumps(record) + "\n")


def _sharpness(path: Path) -> float:
    """Blur of a photo's file; NaN where it cannot be measured."""
    photo = read_photo(path)
    if isinstance(photo, RejectedPhoto) or photo.channels < 3:
        return float("nan")
    try:
        return sharpness(np.ascontiguousarray(read_color(photo)[..., ::-1]))
    except (UnreadablePhotoError, OSError, ValueError):
        return float("nan")
