"""Writes the growing map as files for other programs: `map.mbtiles` and a snapshot, `map.tif`."""

import json
import math
import threading
import time
from pathlib import Path

from skyquilt.engine.error_log import log_error
from skyquilt.errors import OutputError
from skyquilt.live.ledger import hit
from skyquilt.raster.map_source import MERCATOR, Bounds, between, mercator, picture
from skyquilt.raster.mbtiles import touched, write_mbtiles
from skyquilt.raster.picture_files import image_bytes
from skyquilt.server.images import TILE, changed_boxes
from skyquilt.server.parts import write_part
from skyquilt.server.survey import LiveSurvey

PAUSE_S = 3.0
"""Pause in s between checks for changes."""
SNAPSHOT_S = 20.0
"""Shortest time in s between snapshots."""
MOST_TILES = 3000
"""Largest number of web tiles written in one step; the others follow in the next step."""
ZOOMS = 7
"""Number of zoom levels of the MBTiles file, from the map's own resolution to coarser ones."""


class PublishedFiles:
    """Writes both files when the map has changed. As a context manager it runs in a separate
    thread.
    """

    def __init__(self, survey: LiveSurvey, folder: Path) -> None:
        self.survey, self.folder = survey, folder
        self._known = 0
        self._boxes: list[Bounds] = []
        self._snapshot, self._stale = 0.0, True
        self._failed = ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="publishing")

    def __enter__(self) -> "PublishedFiles":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join(30)

    def _run(self) -> None:
        while not self._stop.wait(PAUSE_S):
            try:
                self.step()
            except OutputError:
                # the disk is full: retry later; the mapping reports it to the user
                continue
            except Exception as error:  # whatever it is, later maps are still to be published
                if repr(error) != self._failed:
                    log_error(self.folder, "the files for other programs", error)
                self._failed = repr(error)

    def step(self, *, now: bool = False) -> None:
        """Updates both files; the snapshot at most every `SNAPSHOT_S` seconds, unless `now`."""
        layer = next(iter(self.survey.layers()), None)
        if layer is None or layer in ("finished", "base"):
            return
        self._look(layer)
        if self._boxes:
            self._tiles(layer)
            self._stale = True
        if self._stale and (now or time.monotonic() - self._snapshot > SNAPSHOT_S):
            self._snapshot, self._stale = time.monotonic(), False
            source = self.survey.layers()[layer]
            if source.about() is not None:
                write_part(source, self.survey.styles()[layer], None, self.folder / "map.tif")
        hit("published")

    def _look(self, layer: str) -> None:
        """Records where the map has changed."""
        while told := self.survey.ledger.told(self._known):
            for _, kind, body in told:
                said = json.loads(body)
                if kind == "tiles" and said["layer"] == layer and not said.get("placeless"):
                    self._boxes += changed_boxes(said)
            self._known = told[-1][0]

    def _tiles(self, layer: str) -> None:
        source = self.survey.layers()[layer]
        extent = source.bounds()
        gsd = float(self.survey.ledger.meta("gsd"))
        if extent is None:
            return
        west, south, east, north = between(source.crs, "EPSG:4326").transform_bounds(*extent)
        fine = math.log2(2 * MERCATOR / TILE * math.cos(math.radians((south + north) / 2)) / gsd)
        top = min(24, round(fine))
        wanted = [
            (z, x, y)
            for z in range(max(0, top - ZOOMS + 1), top + 1)
            for x, y in sorted(touched(self._boxes, z))
        ]
        made = []
        for z, x, y in wanted:
            if self._stop.is_set():
                return
            rgba = picture(source, "EPSG:3857", mercator(z, x, y), TILE, TILE)
            made.append((z, x, y, None if rgba is None else image_bytes(rgba, "image/webp")))
            if len(made) >= MOST_TILES:
                self._write(made, layer, (west, south, east, north), top)
                made = []
        self._write(made, layer, (west, south, east, north), top)
        self._boxes = []

    def _write(
        self, made: list[tuple[int, int, int, bytes | None]], layer: str, bounds: Bounds, top: int
    ) -> None:
        zooms = (max(0, top - ZOOMS + 1), top)
        write_mbtiles(
            self.folder / "map.mbtiles", made, name=f"Skyquilt {layer}", bounds=bounds, zooms=zooms
        )
