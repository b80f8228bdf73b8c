"""The web application: all endpoints of the server. It reads what the mapping has written and
passes on what clients send; it does not compute poses.
"""

import asyncio
import mimetypes
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import FastAPI, Request, Response
from fastapi.responses import FileResponse, JSONResponse, StreamingResponse
from fastapi.staticfiles import StaticFiles

from skyquilt.errors import SideFileError
from skyquilt.server.access import RESUMABLE, Context, Guard, Guarded, Packed, Writer
from skyquilt.server.control_endpoints import ControlEndpoints
from skyquilt.server.event_endpoints import EventEndpoints
from skyquilt.server.file_endpoints import FileEndpoints
from skyquilt.server.images import Images
from skyquilt.server.layer_endpoints import LayerEndpoints
from skyquilt.server.map_endpoints import STATIC, MapEndpoints
from skyquilt.server.photo_endpoints import PhotoEndpoints
from skyquilt.server.photo_views import PhotoViews
from skyquilt.server.plan_endpoints import PlanEndpoints
from skyquilt.server.readouts import Readouts
from skyquilt.server.shown import Survey
from skyquilt.server.upload_endpoints import UploadEndpoints
from skyquilt.server.wms import WmsEndpoints
from skyquilt.version import __version__

if TYPE_CHECKING:
    from skyquilt.server.mission_watch import MissionWatch  # only for live surveys


KINDS = {".css": "text/css", ".html": "text/html", ".js": "text/javascript"}
"""Types of the page's files. The registry of Windows may give others, and browsers run no script
that is said to be text.
"""


def _damaged(_: Request, error: Exception) -> Response:
    """A file of the map that could be read when it was opened."""
    return JSONResponse({"detail": str(error)}, 503)


def make_app(
    survey: Survey,
    guard: Guard,
    writer: Writer | None,
    folder: Path,
    watch: "MissionWatch | None" = None,
) -> FastAPI:
    """The application; `watch` follows the plan of a live survey."""
    context, images = Context(survey, guard, writer), Images(survey)
    received = UploadEndpoints(context, folder)

    @asynccontextmanager
    async def sweeping(_: FastAPI) -> AsyncIterator[None]:
        task = asyncio.create_task(received.uploads.sweeping())
        yield
        task.cancel()

    app = FastAPI(
        lifespan=sweeping,
        title="Skyquilt",
        version=__version__,
        docs_url=None,
        redoc_url=None,
        description="A map that grows while drones fly: tiles, WMS, photos, layers, events.",
    )
    maps, wms, listed = (
        MapEndpoints(context, images),
        WmsEndpoints(context, images),
        PhotoEndpoints(context),
    )
    views, read, files = (
        PhotoViews(context, listed),
        Readouts(context, images),
        FileEndpoints(context),
    )
    control = ControlEndpoints(context, views)
    layers, events = LayerEndpoints(context), EventEndpoints(context)
    app.state.ending = events.ending
    plans = PlanEndpoints(context, folder, watch)

    get, post = {"methods": ["GET"]}, {"methods": ["POST"]}
    for path, work, options in (
        ("/", maps.page, {**get, "include_in_schema": False}),
        ("/info", maps.info, get),
        ("/tiles/{z}/{x}/{y}", maps.tile, {**get, "response_class": Response}),
        ("/tiles.json", maps.tilejson, get),
        ("/wms", wms.wms, {**get, "response_class": Response}),
        ("/export", maps.export, {**get, "response_class": FileResponse}),
        ("/photos", listed.photos, get),
        ("/photos", received.upload, post),
        (RESUMABLE, received.upload_offer, {"methods": ["OPTIONS"]}),
        (RESUMABLE, received.upload_begin, post),
        (RESUMABLE + "/{number}", received.upload_offer, {"methods": ["OPTIONS"]}),
        (RESUMABLE + "/{number}", received.upload_state, {"methods": ["HEAD"]}),
        (RESUMABLE + "/{number}", received.upload_part, {"methods": ["PATCH"]}),
        (RESUMABLE + "/{number}", received.upload_end, {"methods": ["DELETE"]}),
        ("/photos/{number}", listed.photo, get),
        ("/photos/{number}/thumbnail", views.thumbnail, {**get, "response_class": Response}),
        ("/photos/{number}/detail", views.detail, {**get, "response_class": Response}),
        ("/photos/{number}/place", views.place, get),
        ("/at", read.at, get),
        ("/profile", read.profile, get),
        ("/volume", read.volume, get),
        ("/files", files.files, get),
        ("/files/{name:path}", files.file, {**get, "response_class": FileResponse}),
        ("/control", control.control, get),
        ("/control", control.control_put, {"methods": ["PUT"]}),
        ("/control/read", control.control_read, post),
        ("/control/photos", control.photos, get),
        ("/control/run", control.run_state, get),
        ("/control/run", control.run_start, post),
        ("/photos/{number}/file", listed.photo_file, {**get, "response_class": FileResponse}),
        ("/layers", layers.layer_list, get),
        ("/layers", layers.layer_post, post),
        ("/layers/{name}", layers.layer_get, {**get, "response_class": Response}),
        ("/layers/{name}", layers.layer_delete, {"methods": ["DELETE"]}),
        ("/events", events.events, {**get, "response_class": StreamingResponse}),
        ("/finish", layers.finish, post),
        ("/plan", plans.plan, get),
        ("/plan", plans.new, post),
        ("/plan/missing", plans.missing, post),
        ("/areas", plans.areas, get),
        ("/areas", plans.areas_put, {"methods": ["PUT"]}),
        ("/plans/{name}/{file}", plans.plan_file, {**get, "response_class": FileResponse}),
        ("/coverage", plans.coverage, get),
        ("/coverage.png", plans.coverage_picture, {**get, "response_class": Response}),
    ):
        app.add_api_route(path, work, **options)
    app.add_exception_handler(SideFileError, _damaged)
    for ending, kind in KINDS.items():
        mimetypes.add_type(kind, ending)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    app.add_middleware(Packed)
    app.add_middleware(Guarded, guard=guard, log=None if writer is None else folder)
    return app
