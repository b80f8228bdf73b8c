"""Endpoints of control points in the browser. They write only below the run's folder, for those who
may write; poses are computed by `skyquilt mosaic` in a process of its own.
"""

import json
import math
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from anyio import CapacityLimiter, to_thread
from fastapi import HTTPException, Query, Request
from starlette.requests import ClientDisconnect

from skyquilt.errors import OutputError, SkyquiltError
from skyquilt.raster.map_source import between
from skyquilt.server.access import Context, blocks_of
from skyquilt.server.control_list import MOST_BYTES, Control, checked, read_list, store, stored
from skyquilt.server.control_run import ControlRun
from skyquilt.server.finished_survey import FinishedSurvey
from skyquilt.server.photo_views import PhotoViews

MOST_PHOTOS = 40
"""Photos listed for a point."""
MOST_PROPOSED = 16
"""Photos compared for a proposal."""
Number = Annotated[float, Query(ge=-1e8, le=1e8, allow_inf_nan=False)]
Text = Annotated[str, Query(max_length=2000)]
MaybePixel = Annotated[float | None, Query(ge=-10, le=1e6, allow_inf_nan=False)]


class ControlEndpoints:
    """Endpoints of control points. One list is read, and one search made, at a time."""

    def __init__(self, context: Context, views: PhotoViews) -> None:
        self.context, self.views = context, views
        self._one = CapacityLimiter(1)
        survey = context.survey
        self.job = ControlRun(survey.folder) if isinstance(survey, FinishedSurvey) else None

    def _survey(self) -> FinishedSurvey:
        survey = self.context.survey
        if not isinstance(survey, FinishedSurvey):
            raise HTTPException(404, "control points are marked in a finished map: skyquilt view")
        return survey

    def _names(self) -> dict[str, int]:
        return {p.name: p.id for p in self._survey().photos()}

    def control(self) -> dict[str, Any]:
        """Points and marks as stored, whether photos are there to mark them in, and the run."""
        survey = self._survey()
        names = set(self._names())
        crs = self.context.layer("mosaic")[1].crs
        found = stored(survey.folder, names) or {"crs": crs, "points": [], "marks": []}
        files = sum(p.path is not None for p in survey.photos())
        return {**found, "photos": files, "run": self.job.state() if self.job else {}}

    async def control_put(self, request: Request) -> dict[str, Any]:
        """Stores points and marks, and writes those that are marked as gcp_list.txt."""
        self.context.admitted(request)
        survey, data = self._survey(), await self._body(request)
        try:
            control = checked(json.loads(data), set(self._names()))
            path = await to_thread.run_sync(store, survey.folder, control, limiter=self._one)
        except OutputError as error:
            raise HTTPException(507, str(error)) from error
        except (ValueError, RecursionError, SkyquiltError) as error:
            raise HTTPException(422, str(error)) from error
        return {"path": str(path), "marks": len(control["marks"])}

    async def control_read(self, request: Request, crs: Text) -> Control:
        """Reads a gcp_list.txt or a CSV (name, x, y, z, check; in `crs`) without storing it."""
        data = await self._body(request)
        return await to_thread.run_sync(self._read, data, crs, limiter=self._one)

    def _read(self, data: bytes, crs: str) -> Control:
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "gcp_list.txt"
            path.write_bytes(data)
            try:
                return read_list(path, list(self._names()), crs)
            except (SkyquiltError, ValueError, OSError) as error:
                raise HTTPException(422, str(error)) from error

    async def photos(
        self, x: Number, y: Number, crs: Text,
        marked: int | None = None, px: MaybePixel = None, py: MaybePixel = None,
        propose: bool = False,
    ) -> dict[str, Any]:  # fmt: skip
        """Photos that should show a point (x, y in `crs`), the most central first, with the
        predicted pixel; `marked`, `px`, `py`: a photo in which it is marked, by which predictions
        are corrected; `propose`: by correlation, too.
        """
        mark = None if marked is None or px is None or py is None else (marked, px, py)
        return await to_thread.run_sync(self._photos, x, y, crs, mark, propose, limiter=self._one)

    def _photos(
        self, x: float, y: float, crs: str, mark: tuple[int, float, float] | None, propose: bool
    ) -> dict[str, Any]:
        from skyquilt.server import control_search

        survey, names = self._survey(), self._names()
        try:
            lon, lat = between(crs, "EPSG:4326").transform(x, y)
        except Exception as error:  # pyproj's own
            raise HTTPException(422, "this is no coordinate system") from error
        if not (math.isfinite(lon) and math.isfinite(lat)):
            raise HTTPException(422, "this place is not in that coordinate system")
        place = self.views.on_ground(lon, lat)
        projection, chosen = self.views.projection, None
        if mark is not None:
            shown = survey.photo(mark[0])
            if shown is not None:
                found = control_search.place_of_mark(
                    projection, shown.name, (mark[1], mark[2]), place
                )
                place, chosen = found or place, shown.name
        seen = []
        for name, number in names.items():
            at = projection.pixel(name, place)
            photo = survey.photo(number)
            if at is not None and photo is not None and photo.path is not None:
                width, height = projection.size(name)
                middle = np.hypot(at[0] - width / 2, at[1] - height / 2)
                seen.append((float(middle), number, name, at))
        rows = []
        for k, (_, number, name, at) in enumerate(sorted(seen)[:MOST_PHOTOS]):
            row: dict[str, Any] = {"id": number, "name": name, "x": at[0], "y": at[1]}
            if propose and chosen is not None and name != chosen and k < MOST_PROPOSED:
                made = control_search.propose(
                    projection, lambda n: self.views.picture(names[n]), chosen, place, name
                )
                if made is not None:
                    row |= {"proposed": [made.x, made.y], "score": round(made.score, 3)}
            rows.append(row)
        return {"photos": rows, "lon": lon, "lat": lat}

    def run_state(self) -> dict[str, Any]:
        """The state of the run with control points."""
        self._survey()
        return self.job.state() if self.job else {"state": "none"}

    def run_start(self, request: Request) -> dict[str, Any]:
        """Starts `skyquilt mosaic` with the stored points, into a folder beside."""
        self.context.admitted(request)
        survey = self._survey()
        control = stored(survey.folder, set(self._names()))
        if self.job is None or control is None or not control["marks"]:
            raise HTTPException(422, "no point is marked yet")
        if survey.home is None:
            raise HTTPException(422, "the photos are not where they were; view OUT --photos DIR")
        try:
            path = store(survey.folder, control)
            if not self.job.start(survey.home, path.resolve(), self.context.layer("mosaic")[1].crs):
                raise HTTPException(409, "a run with control points is going on")
        except SkyquiltError as error:
            raise HTTPException(422, str(error)) from error
        return self.job.state()

    async def _body(self, request: Request) -> bytes:
        data = bytearray()
        try:
            async for block in blocks_of(request, self.context.guard.upload_stall_s):
                data += block
                if len(data) > MOST_BYTES:
                    raise HTTPException(413, f"a list may have {MOST_BYTES} bytes")
        except (ClientDisconnect, TimeoutError) as error:
            raise HTTPException(408, "the connection was lost; send it again") from error
        return bytes(data)
