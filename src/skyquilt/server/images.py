"""Encoded map images, cached until their content changes."""

import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.raster.map_source import MERCATOR, Bounds, MapSource, between, mercator, picture
from skyquilt.raster.picture_files import image_bytes
from skyquilt.runs.layers import RunLayer, range_of, unit_of
from skyquilt.server.shown import Survey
from skyquilt.server.survey import LiveSurvey, is_final

KEPT = 3000
"""Number of tiles kept in memory."""
TILE = 256
"""Pixels of a web tile's side."""


@dataclass(frozen=True, kw_only=True)
class WebTile:
    """A web tile as it is sent to clients."""

    data: bytes | None
    """WebP; None if the map is empty there."""

    @cached_property
    def tag(self) -> str:
        """ETag of the content, for the caches of browsers."""
        return f'"{hashlib.blake2b(self.data or b"", digest_size=8).hexdigest()}"'


class Images:
    """Web tiles of a survey."""

    def __init__(self, survey: Survey) -> None:
        self.survey = survey
        self._kept: OrderedDict[tuple[str, int, int, int], WebTile] = OrderedDict()
        self._lock = threading.Lock()
        self._known, self._stamp = survey.version(), survey.stamp()
        self._scales: dict[str, tuple[int, tuple[float, float] | None]] = {}

    def kept(self, layer: str, z: int, x: int, y: int) -> WebTile | None:
        """A cached web tile that is up to date; None if it must be drawn."""
        self._forget_changed()
        key = (layer, z, x, y)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
            return self._kept.get(key)

    def tile(self, layer: str, source: MapSource, z: int, x: int, y: int) -> WebTile:
        """A web tile of a layer, from the cache or drawn now."""
        if (found := self.kept(layer, z, x, y)) is not None:
            return found
        before = self._known
        scale, palette = self.scale(layer, source), self.style(layer).palette
        rgba = picture(source, "EPSG:3857", mercator(z, x, y), TILE, TILE, scale, palette)
        made = WebTile(data=None if rgba is None else image_bytes(rgba, "image/webp"))
        with self._lock:
            if self._known == before:  # otherwise it may have changed while it was drawn
                self._kept[layer, z, x, y] = made
                while len(self._kept) > KEPT:
                    self._kept.popitem(last=False)
        return made

    def scale(self, layer: str, source: MapSource) -> tuple[float, float] | None:
        """Values in the first and the last colour of a measured layer, renewed as it grows; None
        for colour images.
        """
        version = self.survey.version()
        known = self._scales.get(layer)
        if known is not None and version - known[0] < 50:
            return known[1]
        found = range_of(self.style(layer), source)
        self._scales[layer] = (version, found)
        return found

    def style(self, layer: str) -> RunLayer:
        """How a layer is shown."""
        return self.survey.styles().get(layer) or RunLayer(name=layer, title=layer, file="")

    def unit(self, layer: str) -> str:
        """Unit of a layer's values as printed; empty where they have none."""
        growing = self.survey.unit(layer) if isinstance(self.survey, LiveSurvey) else ""
        return growing or unit_of(self.style(layer), self.survey.figures())

    def _forget_changed(self) -> None:
        """Removes cached tiles whose content was redrawn since the last call."""
        survey, stamp = self.survey, self.survey.stamp()
        if not isinstance(survey, LiveSurvey) or stamp == self._stamp:
            return
        while told := survey.ledger.told(self._known):
            changed = [json.loads(b) for _, kind, b in told if kind == "tiles"]
            with self._lock:
                for said in changed:
                    self._drop(said)
                if any(kind == "finish" for _, kind, _ in told):
                    self._drop_final()
                self._known = told[-1][0]
        self._stamp = stamp

    def _drop_final(self) -> None:
        """Forgets the tiles of a final map: there is another one."""
        for layer in [k for k in self._scales if is_final(k)]:
            del self._scales[layer]
        for key in [k for k in self._kept if is_final(k[0])]:
            del self._kept[key]

    def _drop(self, said: Mapping[str, Any]) -> None:
        keys = [k for k in self._kept if k[0] == said["layer"]]
        if not keys:
            return
        boxes = np.array(changed_boxes(said))
        for k in np.flatnonzero(_meet(np.array([k[1:] for k in keys], float), boxes)).tolist():
            del self._kept[keys[k]]


def changed_boxes(said: Mapping[str, Any]) -> list[Bounds]:
    """Bounding boxes of the changes reported by a `tiles` event, in EPSG:3857."""
    to_web = between("EPSG:4326", "EPSG:3857")
    found = []
    for west, south, east, north in said.get("boxes") or [said["bounds"]]:
        found.append(to_web.transform_bounds(west, south, east, north))
    return found


def _meet(tiles: NDArray[np.float64], boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether web tiles (n, 3) z, x, y intersect any of the boxes (m, 4) in EPSG:3857."""
    size = (2 * MERCATOR / 2 ** tiles[:, 0])[:, None]
    west, north = tiles[:, 1:2] * size - MERCATOR, MERCATOR - tiles[:, 2:3] * size
    beside = (west >= boxes[:, 2]) | (west + size <= boxes[:, 0])
    above = (north - size >= boxes[:, 3]) | (north <= boxes[:, 1])
    return np.asarray((~(beside | above)).any(1), bool)
