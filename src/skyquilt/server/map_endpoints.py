"""Endpoints of the map: page, web tiles, TileJSON, exports."""

import os
import tempfile
from pathlib import Path
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import HTTPException, Request, Response
from fastapi.responses import FileResponse
from starlette.types import Receive, Scope, Send

from skyquilt.engine.free_memory import give_back
from skyquilt.errors import SideFileError, UsageError
from skyquilt.outside import real
from skyquilt.raster.colours import ramp
from skyquilt.raster.map_source import MapSource, between
from skyquilt.server.access import Context
from skyquilt.server.finished_survey import FinishedSurvey
from skyquilt.server.images import Images
from skyquilt.server.readouts import HEIGHTS
from skyquilt.server.survey import LiveSurvey
from skyquilt.version import __version__

STATIC = Path(__file__).parent / "static"
DRAWN_AT_ONCE = 2
"""Number of tiles drawn at a time. More would not be faster and would delay other requests."""


class _Part(FileResponse):
    """A file that is gone once it is sent, or once its client is gone."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            Path(self.path).unlink(missing_ok=True)


class MapEndpoints:
    """Endpoints of maps."""

    def __init__(self, context: Context, images: Images) -> None:
        self.context, self.images = context, images
        self._drawing = CapacityLimiter(DRAWN_AT_ONCE)
        self._writing = CapacityLimiter(1)

    def page(self) -> FileResponse:
        """The page of the viewer."""
        return FileResponse(STATIC / "index.html", headers={"Cache-Control": "no-cache"})

    def info(self) -> dict[str, Any]:
        """Describes the survey: layers with their extent in degrees, counts, number of the newest
        event. `placeless`: nothing says where the map is; its extents are where the page draws it.
        `began`: when a live survey began (seconds since 1970), which tells it from another one.
        """
        found, placeless = [], self.context.placeless()
        for name, source in (placeless or self.context.survey.layers()).items():
            try:
                bounds = source.bounds()
                box = (
                    None
                    if bounds is None
                    else between(source.crs, "EPSG:4326").transform_bounds(*bounds)
                )
                look = self._look(name, source)
            except SideFileError:
                if isinstance(self.context.survey, FinishedSurvey):
                    raise
                continue  # a final map is just being replaced
            crs = None if placeless else source.crs
            found.append({"name": name, "crs": crs, "bounds": box, **look})
        counts = (
            self.context.survey.ledger.counts()
            if isinstance(self.context.survey, LiveSurvey)
            else {}
        )
        finish = began = None
        if isinstance(self.context.survey, LiveSurvey):
            ledger = self.context.survey.ledger
            finish, began = ledger.meta("finish"), real(ledger.meta("began"))
        return {
            "layers": found,
            "placeless": bool(placeless),
            "growing": self.context.survey.growing and self.context.writer is not None,
            "counts": counts,
            "event": self.context.survey.version(),
            "began": began,
            "version": __version__,
            "token": self.context.guard.token is not None,
            "finish": finish,
            "control": isinstance(self.context.survey, FinishedSurvey),
            "title": self.context.survey.folder.resolve().name,
            "heights": next((n for n in HEIGHTS if n in self.context.survey.layers()), None),
        }

    def _look(self, name: str, source: MapSource) -> dict[str, Any]:
        """Title of a layer and, for values, the legend: colours, what the first and the last one
        stand for, unit.
        """
        style = self.images.style(name)
        scale = self.images.scale(name, source) if style.measured else None
        found: dict[str, Any] = {"title": style.title, "measured": style.measured}
        if scale is not None:
            found["legend"] = {
                "colours": ramp(style.palette, 9),
                "low": round(scale[0], 3),
                "high": round(scale[1], 3),
                "unit": self.images.unit(name),
            }
        return found

    async def tile(
        self, request: Request, z: int, x: int, y: int, layer: str | None = None
    ) -> Response:
        """A web tile (EPSG:3857, 256 px, WebP); 204 if the map is empty there, 304 if the client
        has the current version.
        """
        name, source = self.context.drawn(layer)
        if not (0 <= z <= 26 and 0 <= x < 2**z and 0 <= y < 2**z):
            raise HTTPException(404, f"there is no tile {z}/{x}/{y}")
        found = self.images.kept(name, z, x, y)
        if found is None:
            found = await to_thread.run_sync(
                self.images.tile, name, source, z, x, y, limiter=self._drawing
            )
        headers = {"Cache-Control": "no-cache", "ETag": found.tag}
        if found.tag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        if found.data is None:
            return Response(status_code=204, headers=headers)
        return Response(found.data, media_type="image/webp", headers=headers)

    def tilejson(self, request: Request, layer: str | None = None) -> dict[str, Any]:
        """TileJSON 3.0."""
        name, source = self.context.layer(layer)
        bounds = source.bounds()
        box = (
            None
            if bounds is None
            else list(between(source.crs, "EPSG:4326").transform_bounds(*bounds))
        )
        return {
            "tilejson": "3.0.0",
            "name": name,
            "scheme": "xyz",
            "minzoom": 0,
            "maxzoom": 24,
            "tiles": [f"{self.context.guard.base(request)}tiles/{{z}}/{{x}}/{{y}}?layer={name}"],
            **({"bounds": box} if box else {}),
        }

    async def export(self, bbox: str, layer: str | None = None) -> FileResponse:
        """A part of a layer as Cloud Optimized GeoTIFF; `bbox`: west,south,east,north in
        degrees.
        """
        handle, path = tempfile.mkstemp(suffix=".tif")
        os.close(handle)
        try:
            await to_thread.run_sync(self._exported, bbox, layer, Path(path), limiter=self._writing)
        except BaseException:
            Path(path).unlink(missing_ok=True)
            raise
        return _Part(path, media_type="image/tiff", filename="skyquilt-export.tif")

    def _exported(self, bbox: str, layer: str | None, path: Path) -> None:
        name, source = self.context.layer(layer)
        numbers = [real(v, -180, 180) for v in bbox.split(",", 4)]
        if len(numbers) != 4 or None in numbers:
            raise HTTPException(400, "bbox is west,south,east,north in degrees")
        west, south, east, north = (v for v in numbers if v is not None)
        if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):
            raise HTTPException(400, "bbox has no area; it is west,south,east,north in degrees")
        bounds = between("EPSG:4326", source.crs).transform_bounds(west, south, east, north)
        from skyquilt.server.parts import write_part  # asked for by few

        try:
            some = write_part(source, self.images.style(name), bounds, path)
        except UsageError:
            some = False
        give_back()
        if not some:
            raise HTTPException(404, "the map is empty there")
