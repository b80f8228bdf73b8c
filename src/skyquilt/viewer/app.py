"""The server's addresses. It reads what the mapping has written and hands in what clients send; poses are not its
business.
"""

import asyncio
import os
import tempfile
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated, Any, Protocol

from anyio import CapacityLimiter, to_thread
from fastapi import FastAPI, HTTPException, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, JSONResponse, StreamingResponse
from fastapi.staticfiles import StaticFiles
from starlette.background import BackgroundTask
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skyquilt import __version__
from skyquilt.errors import OutputError
from skyquilt.pipelines.live.intake import Accepted, Intake, shown_name
from skyquilt.raster.map_source import between, picture
from skyquilt.run.ledger import Ledger
from skyquilt.viewer.export import write_cog
from skyquilt.viewer.guard import HEADERS, Guard
from skyquilt.viewer.images import Images, image_bytes
from skyquilt.viewer.layers import LayerError, checked, drop_layer, put_layer
from skyquilt.viewer.survey import LiveSurvey, Shown, Survey, covering
from skyquilt.viewer.uploads import Uploads
from skyquilt.viewer.wms import WmsError, asked, capabilities, map_request, refusal

STATIC = Path(__file__).parent / "static"
WAIT_S = 0.1
"""Between looks for news at most."""
LISTEN_S = 0.02
"""Between looks whether there may be any."""
DRAWN_AT_ONCE = 2
"""Tiles drawn at a time: more would not be quicker, and take turns from others."""
KEEP_ALIVE_S = 15.0
"""A comment is sent to quiet listeners so often, so that the connection is known to live."""
Degrees = Annotated[float, Query(ge=-180, le=180)]


class Writer(Protocol):
    """The growing map that photos and layers are handed to."""

    intake: Intake
    ledger: Ledger


class Site:
    """All addresses of one survey."""

    def __init__(self, survey: Survey, guard: Guard, writer: Writer | None, folder: Path) -> None:
        self.survey, self.guard, self.writer, self.folder = survey, guard, writer, folder
        self.images = Images(survey)
        self._drawing = CapacityLimiter(DRAWN_AT_ONCE)
        self.ending = threading.Event()
        self.uploads = Uploads(folder / "uploads", most=guard.most_uploads) if writer is not None else None

    # -- maps -------------------------------------------------------------------------------------------------

    def page(self) -> FileResponse:
        """The viewer."""
        return FileResponse(STATIC / "index.html", headers={"Cache-Control": "no-cache"})

    def info(self) -> dict[str, Any]:
        """What there is: layers with their extent in degrees, counts, the newest event's number."""
        found = []
        for name, source in self.survey.layers().items():
            bounds = source.bounds()
            box = None if bounds is None else between(source.crs, "EPSG:4326").transform_bounds(*bounds)
            found.append({"name": name, "crs": source.crs, "bounds": box})
        counts = self.survey.ledger.counts() if isinstance(self.survey, LiveSurvey) else {}
        finish = self.survey.ledger.meta("finish") if isinstance(self.survey, LiveSurvey) else None
        return {"layers": found, "growing": self.survey.growing and self.writer is not None, "counts": counts,
                "event": self.survey.version(), "version": __version__, "token": self.guard.token is not None,
                "finish": finish}  # fmt: skip

    async def tile(self, request: Request, z: int, x: int, y: int, layer: str | None = None) -> Response:
        """A web tile (EPSG:3857, 256 px, WebP); 204 where the map has nothing, 304 where the client has it."""
        name = self._layer(layer)
        if not (0 <= z <= 26 and 0 <= x < 2**z and 0 <= y < 2**z):
            raise HTTPException(404, f"there is no tile {z}/{x}/{y}")
        found = self.images.kept(name, z, x, y)
        if found is None:
            found = await to_thread.run_sync(self.images.tile, name, z, x, y, limiter=self._drawing)
        headers = {"Cache-Control": "no-cache", "ETag": found.tag}
        if found.tag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        if found.data is None:
            return Response(status_code=204, headers=headers)
        return Response(found.data, media_type="image/webp", headers=headers)

    def _layer(self, name: str | None) -> str:
        known = self.survey.layers()
        if name is None and known:
            return next(iter(known))
        if name not in known:
            raise HTTPException(
                404, f"there is no layer {str(name)[:60]!r}; there are {', '.join(known) or 'none yet'}"
            )
        return str(name)

    def tilejson(self, request: Request, layer: str | None = None) -> dict[str, Any]:
        """TileJSON 3.0."""
        name = self._layer(layer)
        source = self.survey.layers()[name]
        bounds = source.bounds()
        box = None if bounds is None else list(between(source.crs, "EPSG:4326").transform_bounds(*bounds))
        return {"tilejson": "3.0.0", "name": name, "scheme": "xyz", "minzoom": 0, "maxzoom": 24,
                "tiles": [f"{request.base_url}tiles/{{z}}/{{x}}/{{y}}?layer={name}"],
                **({"bounds": box} if box else {})}  # fmt: skip

    def wms(self, request: Request) -> Response:
        """WMS 1.1.1 and 1.3.0."""
        query = asked(request.query_params)
        version = query.get("VERSION", query.get("WMTVER", "1.3.0"))
        known = self.survey.layers()
        try:
            what = query.get("REQUEST", "").lower()
            if what in ("getcapabilities", "capabilities"):
                kind = "application/vnd.ogc.wms_xml" if version.startswith("1.1") else "text/xml"
                return Response(capabilities(known, f"{request.base_url}wms?", version), media_type=kind)
            if what in ("getmap", "map"):
                return self._map(query, version)
            if what == "getfeatureinfo":
                return self._feature_info(query)
            raise WmsError(
                f"REQUEST {what[:40]!r} is none of GetCapabilities, GetMap, GetFeatureInfo",
                "OperationNotSupported",
            )
        except WmsError as error:
            kind = "application/vnd.ogc.se_xml" if version.startswith("1.1") else "text/xml"
            return Response(refusal(error, version), media_type=kind, status_code=400)

    def _map(self, query: dict[str, str], version: str) -> Response:
        known = self.survey.layers()
        want = map_request(query, known)
        out = None
        for name in want.layers:
            scale = self.images.scale(name, known[name])
            rgba = picture(known[name], want.crs, want.bounds, want.width, want.height, scale)
            if rgba is not None and out is not None:
                rgba[rgba[..., 3] == 0] = out[rgba[..., 3] == 0]
            out = rgba if rgba is not None else out
        if out is None:
            import numpy as np

            out = np.zeros((want.height, want.width, 4), np.uint8)
        return Response(image_bytes(out, want.format, transparent=want.transparent), media_type=want.format)

    def _feature_info(self, query: dict[str, str]) -> Response:
        want = map_request(query, self.survey.layers())
        try:
            i, j = int(query.get("I", query.get("X", ""))), int(query.get("J", query.get("Y", "")))
        except ValueError as error:
            raise WmsError("I and J are whole numbers", "InvalidPoint") from error
        west, south, east, north = want.bounds
        x, y = (
            west + (i + 0.5) / want.width * (east - west),
            north - (j + 0.5) / want.height * (north - south),
        )
        lon, lat = between(want.crs, "EPSG:4326").transform(x, y) if want.crs != "EPSG:4326" else (x, y)
        found = [p.record for p in covering(self.survey.photos(), lon, lat)]
        return JSONResponse({"lon": lon, "lat": lat, "photos": found})

    def export(self, bbox: str, layer: str | None = None) -> FileResponse:
        """A part of a layer as Cloud Optimized GeoTIFF; `bbox`: west,south,east,north in degrees."""
        name = self._layer(layer)
        source = self.survey.layers()[name]
        try:
            west, south, east, north = (float(v) for v in bbox.split(","))
        except ValueError as error:
            raise HTTPException(400, "bbox is west,south,east,north in degrees") from error
        if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):
            raise HTTPException(400, "bbox holds no area; it is west,south,east,north in degrees")
        bounds = between("EPSG:4326", source.crs).transform_bounds(west, south, east, north)
        extent = source.bounds()
        if extent is None:
            raise HTTPException(404, "the map is empty")
        bounds = (
            max(bounds[0], extent[0]),
            max(bounds[1], extent[1]),
            min(bounds[2], extent[2]),
            min(bounds[3], extent[3]),
        )
        handle, path = tempfile.mkstemp(suffix=".tif")
        os.close(handle)
        gone = BackgroundTask(Path(path).unlink, missing_ok=True)
        done = (
            None
            if bounds[0] >= bounds[2] or bounds[1] >= bounds[3]
            else write_cog(source, bounds, Path(path), 0.0)
        )
        if done is None:
            Path(path).unlink(missing_ok=True)
            raise HTTPException(404, "the map has nothing there")
        return FileResponse(path, media_type="image/tiff", filename="skyquilt-export.tif", background=gone)

    # -- photos -----------------------------------------------------------------------------------------------

    def photos(
        self, lon: Degrees | None = None, lat: Annotated[float | None, Query(ge=-90, le=90)] = None
    ) -> dict[str, Any]:
        """All photos; with `lon` and `lat` in degrees those that cover the point, the most vertical first."""
        everything = self.survey.photos()
        if lon is not None and lat is not None:
            return {"photos": [p.record for p in covering(everything, lon, lat)]}
        refused = self.survey.refused() if hasattr(self.survey, "refused") else []
        return {"photos": [p.record for p in everything], "refused": refused}

    def photo(self, number: int) -> dict[str, Any]:
        """One photo."""
        return dict(self._known(number).record)

    def _known(self, number: int) -> Shown:
        found = self.survey.photo(number)
        if found is None:
            raise HTTPException(404, f"there is no photo {number}")
        return found

    def photo_file(self, number: int) -> FileResponse:
        """A photo at full resolution, as it was sent."""
        found = self._known(number)
        if found.path is None or not found.path.is_file():
            raise HTTPException(404, "its file is no longer where it was")
        kind = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png"}.get(
            found.path.suffix.lower(), "image/tiff"
        )
        return FileResponse(found.path, media_type=kind, headers={"Content-Disposition": "inline"})

    async def upload(self, request: Request, name: str = "photo", source: str = "upload") -> JSONResponse:
        """Takes a photo (the body). It answers when the photo is safe: 201, 200 for a duplicate, 422 refused."""
        intake, uploads = self._writing(request)
        held = self._begun(uploads, name, source, self._length(request))
        try:
            size = await self._received(request, held.id, intake.inbox.most_bytes)
            if "content-length" in request.headers and size != int(request.headers["content-length"]):
                raise HTTPException(400, "the connection was lost before the photo was whole; send it again")
            return await run_in_threadpool(self._handed_in, intake, held.id, name, source)
        finally:
            uploads.drop(held.id)

    def _length(self, request: Request) -> int:
        text = request.headers.get("content-length", "0")
        size = int(text) if text.isdigit() else 0
        assert self.writer is not None
        most = self.writer.intake.inbox.most_bytes
        if size > most:
            raise HTTPException(413, f"a photo may have {most} bytes, this one has {size}")
        return size

    def _begun(self, uploads: Uploads, name: str, source: str, size: int) -> Any:
        try:
            held = uploads.begin(shown_name(name), shown_name(source), size)
        except OSError as error:
            raise HTTPException(
                507, f"the server's disk cannot take it ({error.strerror}); send it again later"
            ) from error
        if held is None:
            raise HTTPException(
                429, "too many uploads are under way; wait for some to end", {"Retry-After": "5"}
            )
        return held

    async def _received(self, request: Request, number: str, most: int) -> int:
        assert self.uploads is not None
        size = 0
        try:
            with self.uploads.path(number).open("ab") as file:
                async for block in request.stream():
                    size += len(block)
                    if size > most:
                        raise HTTPException(413, f"a photo may have {most} bytes, this one has more")
                    file.write(block)
        except OSError as error:
            raise HTTPException(
                507, f"the server's disk cannot take it ({error.strerror}); send it again later"
            ) from error
        return size

    def _handed_in(self, intake: Intake, number: str, name: str, source: str) -> JSONResponse:
        assert self.uploads is not None
        try:
            with self.uploads.path(number).open("rb") as file:
                done = intake.take(iter(lambda: file.read(1 << 20), b""), name, source)
        except OutputError as error:
            raise HTTPException(507, str(error)) from error
        if not isinstance(done, Accepted):
            return JSONResponse({"name": done.name, "state": "refused", "reason": done.reason}, 422)
        said = {"id": done.id, "name": done.name, "state": "duplicate" if done.duplicate else "received"}
        return JSONResponse(said, 200 if done.duplicate else 201)

    def upload_begin(
        self, request: Request, name: str, size: Annotated[int, Query(ge=1)], source: str = "upload"
    ) -> JSONResponse:
        """Begins a resumable upload of `size` bytes; its parts go to /photos/uploads/{id}."""
        intake, uploads = self._writing(request)
        if size > intake.inbox.most_bytes:
            raise HTTPException(413, f"a photo may have {intake.inbox.most_bytes} bytes, this one has {size}")
        held = self._begun(uploads, name, source, size)
        return JSONResponse({"id": held.id, "offset": 0}, 201, {"Location": f"/photos/uploads/{held.id}"})

    def upload_state(self, request: Request, number: str) -> Response:
        """How far a resumable upload is: header `Upload-Offset`."""
        _, uploads = self._writing(request)
        held = uploads.get(number)
        if held is None:
            raise HTTPException(404, "there is no such upload")
        return Response(headers={"Upload-Offset": str(held.offset), "Upload-Length": str(held.size)})

    async def upload_part(self, request: Request, number: str) -> JSONResponse:
        """Appends a part at header `Upload-Offset`; the last one makes it a photo."""
        intake, uploads = self._writing(request)
        held = uploads.get(number)
        if held is None:
            raise HTTPException(404, "there is no such upload")
        if request.headers.get("upload-offset") != str(held.offset):
            raise HTTPException(
                409, f"Upload-Offset is {held.offset} here", {"Upload-Offset": str(held.offset)}
            )
        offset = held.offset
        try:
            async for block in request.stream():
                if offset + len(block) > held.size:
                    raise HTTPException(413, f"the upload was announced with {held.size} bytes")
                offset = await run_in_threadpool(uploads.append, held, block) if block else offset
        except OSError as error:
            raise HTTPException(
                507, f"the server's disk is full ({error.strerror}); send the rest later"
            ) from error
        if offset < held.size:
            return JSONResponse({"id": number, "offset": offset}, 200, {"Upload-Offset": str(offset)})
        answer = await run_in_threadpool(self._handed_in, intake, number, held.name, held.source)
        uploads.drop(number)
        return answer

    def _writing(self, request: Request) -> tuple[Intake, Uploads]:
        """Whether a request may write."""
        if self.writer is None or self.uploads is None:
            raise HTTPException(405, "this survey is only looked at; 'skyquilt live' takes photos and layers")
        given = request.headers.get("authorization") or request.headers.get("x-token")
        if not self.guard.admits(given):
            raise HTTPException(
                401,
                "writing needs the token that the server was started with",
                {"WWW-Authenticate": "Bearer"},
            )
        origin = request.headers.get("origin")
        if origin is not None and origin.split("://")[-1] != request.headers.get("host", ""):
            raise HTTPException(403, "pages of other sites may not write here")
        return self.writer.intake, self.uploads

    # -- layers and news --------------------------------------------------------------------------------------

    def layer_list(self) -> dict[str, Any]:
        """Layers laid over the map."""
        if not isinstance(self.survey, LiveSurvey):
            return {"layers": []}
        rows = self.survey.ledger.rows("select name, at from layer order by name")
        return {"layers": [{"name": n, "at": a} for n, a in rows]}

    def layer_get(self, name: str) -> Response:
        """A layer as GeoJSON."""
        row = None
        if isinstance(self.survey, LiveSurvey):
            row = self.survey.ledger.row("select body from layer where name = ?", name)
        if row is None:
            raise HTTPException(404, "there is no such layer")
        return Response(row[0], media_type="application/geo+json")

    async def layer_post(self, request: Request, name: str) -> JSONResponse:
        """Lays GeoJSON (the request's body) over the map, or replaces the layer of that name."""
        self._writing(request)
        assert self.writer is not None
        data = b""
        async for block in request.stream():
            data += block
            if len(data) > self.guard.most_layer_bytes:
                raise HTTPException(413, f"a layer may have {self.guard.most_layer_bytes} bytes")
        try:
            layer = await run_in_threadpool(checked, data)
            stored = await run_in_threadpool(
                put_layer, self.writer.ledger, shown_name(name), layer, self.guard.most_layers
            )
        except LayerError as error:
            raise HTTPException(422, f"this is no layer: {error}") from error
        except OutputError as error:
            raise HTTPException(507, str(error)) from error
        if not stored:
            raise HTTPException(429, f"there are {self.guard.most_layers} layers already; remove one")
        return JSONResponse({"name": shown_name(name), "features": len(layer["features"])}, 201)

    def layer_delete(self, request: Request, name: str) -> dict[str, str]:
        """Removes a layer."""
        self._writing(request)
        assert self.writer is not None
        if not drop_layer(self.writer.ledger, name):
            raise HTTPException(404, "there is no such layer")
        return {"name": name}

    def finish(self, request: Request) -> dict[str, str]:
        """Asks for the final map: all photos adjusted together, drawn at full resolution, kept beside the live one."""
        self._writing(request)
        assert self.writer is not None
        self.writer.ledger.put_meta("finish", "asked")
        self.writer.ledger.tell("finish", {"state": "asked"})
        return {"state": "asked"}

    async def events(self, request: Request, after: int | None = None) -> StreamingResponse:
        """Server-sent events: photo, tiles, layer, note, refused, finish; `Last-Event-ID` or `after` take them up."""
        said = request.headers.get("last-event-id", "")
        start = int(said) if said.isdigit() else after if after is not None else self.survey.version()
        return StreamingResponse(
            self._news(request, start), media_type="text/event-stream",
            headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
        )  # fmt: skip

    async def _news(self, request: Request, last: int) -> AsyncIterator[str]:
        yield f": skyquilt {__version__}\nretry: 1000\n\n"
        quiet = 0.0
        while not self.ending.is_set() and not await request.is_disconnected():
            told = self.survey.ledger.told(last) if isinstance(self.survey, LiveSurvey) else []
            for number, kind, body in told:
                yield f"id: {number}\nevent: {kind}\ndata: {body}\n\n"
                last = number
            quiet = 0.0 if told else quiet + WAIT_S
            if quiet >= KEEP_ALIVE_S:
                quiet = 0.0
                yield ": still here\n\n"
            if len(told) < 100:
                await self._pause()

    async def _pause(self) -> None:
        """Until there may be news."""
        known = self.survey.stamp()
        for _ in range(round(WAIT_S / LISTEN_S)):
            await asyncio.sleep(LISTEN_S)
            if self.survey.stamp() != known:
                return


def make_app(survey: Survey, guard: Guard, writer: Writer | None, folder: Path) -> FastAPI:
    """The application."""
    app = FastAPI(title="Skyquilt", version=__version__, docs_url=None, redoc_url=None,
                  description="A map that grows while drones fly: tiles, WMS, photos, layers, news.")  # fmt: skip
    site = Site(survey, guard, writer, folder)
    app.state.ending = site.ending

    get, post = {"methods": ["GET"]}, {"methods": ["POST"]}
    for path, work, options in (
        ("/", site.page, {**get, "include_in_schema": False}), ("/info", site.info, get),
        ("/tiles/{z}/{x}/{y}", site.tile, {**get, "response_class": Response}),
        ("/tiles.json", site.tilejson, get), ("/wms", site.wms, {**get, "response_class": Response}),
        ("/export", site.export, {**get, "response_class": FileResponse}),
        ("/photos", site.photos, get), ("/photos", site.upload, post),
        ("/photos/uploads", site.upload_begin, post),
        ("/photos/uploads/{number}", site.upload_state, {"methods": ["HEAD"]}),
        ("/photos/uploads/{number}", site.upload_part, {"methods": ["PATCH"]}),
        ("/photos/{number}", site.photo, get),
        ("/photos/{number}/file", site.photo_file, {**get, "response_class": FileResponse}),
        ("/layers", site.layer_list, get), ("/layers", site.layer_post, post),
        ("/layers/{name}", site.layer_get, {**get, "response_class": Response}),
        ("/layers/{name}", site.layer_delete, {"methods": ["DELETE"]}),
        ("/events", site.events, {**get, "response_class": StreamingResponse}), ("/finish", site.finish, post),
    ):  # fmt: skip
        app.add_api_route(path, work, **options)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    app.add_middleware(Guarded, guard=guard)
    return app


class Guarded:
    """Every request is meant for this server, every answer carries the headers."""

    def __init__(self, app: ASGIApp, guard: Guard) -> None:
        self.app, self.guard = app, guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        if self.guard.knows(Headers(scope=scope).get("host", "")):
            await self.app(scope, receive, with_headers)
            return
        refused = JSONResponse({"detail": "this server answers to localhost only"}, 421)
        await refused(scope, receive, with_headers)
