"""Layers over the map, their endpoints, and that of the button that ends a flight."""

import json
import time
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import HTTPException, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse
from starlette.requests import ClientDisconnect

from skyquilt.errors import OutputError, SideFileError
from skyquilt.live.ledger import Ledger
from skyquilt.live.photo_intake import shown_name
from skyquilt.outside import MOST_DIGITS, real
from skyquilt.server.access import Context, blocks_of
from skyquilt.server.survey import LiveSurvey

GEOMETRIES = ("Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon")
MOST_NESTED = 8
SHAPES = (".kml", ".kmz", ".gpkg", ".zip")
"""Endings of files of GIS programs, beside GeoJSON, that are taken as layers; Shapefiles zipped."""


class LayerError(ValueError):
    """Invalid layer data; the message is a sentence."""


def checked(data: bytes) -> dict[str, Any]:
    """A FeatureCollection from GeoJSON bytes (RFC 7946).

    Raises:
        LayerError: the data are invalid.
    """
    try:
        found = json.loads(
            data,
            parse_constant=lambda name: _no(f"it contains {name}, which is not a number"),
            parse_float=_number,
            parse_int=_number,
        )
        json.dumps(found)  # what is served later: it may be nested too deeply for that
    except LayerError:
        raise
    except (ValueError, RecursionError) as error:
        raise LayerError(f"it is not JSON ({error})") from error
    if not isinstance(found, dict):
        raise LayerError("it is JSON, but not a GeoJSON object")
    kind = found.get("type")
    if kind in GEOMETRIES:
        found = {"type": "Feature", "properties": {}, "geometry": found}
    if found.get("type") == "Feature":
        found = {"type": "FeatureCollection", "features": [found]}
    features = found.get("features")
    if found.get("type") != "FeatureCollection" or not isinstance(features, list):
        raise LayerError(
            f"it is of type {str(kind)[:40]!r}; a FeatureCollection, a Feature or a geometry is"
            " needed"
        )
    return {
        "type": "FeatureCollection",
        "features": [_feature(f, k) for k, f in enumerate(features)],
    }


def _number(text: str) -> float | int:
    """A number that other programs can read too."""
    number = real(text) if len(text) <= MOST_DIGITS else None
    if number is None:
        raise LayerError(f"it contains {text[:40]}, which is not a number in use")
    return int(text) if text.lstrip("-").isdigit() else number


def _no(text: str) -> None:
    raise LayerError(text)


def _feature(feature: Any, k: int) -> dict[str, Any]:
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    if not isinstance(geometry, dict) or geometry.get("type") not in GEOMETRIES:
        raise LayerError(f"feature {k} has no geometry of a known kind")
    _places(geometry.get("coordinates"), k, 0)
    properties = feature.get("properties")
    return {
        "type": "Feature",
        "properties": properties if isinstance(properties, dict) else {},
        "geometry": {"type": geometry["type"], "coordinates": geometry["coordinates"]},
    }


def _places(value: Any, k: int, depth: int) -> None:
    if not isinstance(value, list) or not value or depth > MOST_NESTED:
        raise LayerError(f"feature {k} has invalid coordinates")
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in value):
        if len(value) < 2 or abs(value[0]) > 180 or abs(value[1]) > 90:
            raise LayerError(
                f"feature {k} has {str(value)[:60]}, which is not longitude and latitude in degrees"
            )
        return
    for inner in value:
        _places(inner, k, depth + 1)


def _shapes(data: bytes, name: str) -> dict[str, Any]:
    """A FeatureCollection from the content of a file; its ending says which kind."""
    if not name.lower().endswith(SHAPES):
        return checked(data)
    from skyquilt.server.layer_files import layer_of_bytes  # asked for by few

    return checked(json.dumps(layer_of_bytes(data, name)).encode())


def put_layer(ledger: Ledger, name: str, layer: dict[str, Any], most: int) -> bool:
    """Stores a layer under a name; False if there are too many layers."""
    text = json.dumps(layer)  # seconds for the largest ones, and the mapping waits for the ledger
    with ledger.change() as db:
        count = ledger.row("select count(*) from layer where name != ?", name)
        if count is not None and count[0] >= most:
            return False
        db.execute("insert or replace into layer values (?, ?, ?)", (name, text, time.time()))
        ledger.tell("layer", {"name": name, "features": len(layer["features"])})
    return True


def drop_layer(ledger: Ledger, name: str) -> bool:
    """Removes a layer; False if it does not exist."""
    with ledger.change() as db:
        gone = db.execute("delete from layer where name = ?", (name,)).rowcount > 0
        if gone:
            ledger.tell("layer", {"name": name, "features": 0, "gone": True})
    return gone


class LayerEndpoints:
    """Endpoints of layers."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self._one = CapacityLimiter(1)  # reading a layer takes many times its size

    def layer_list(self) -> dict[str, Any]:
        """Lists the layers over the map."""
        if not isinstance(self.context.survey, LiveSurvey):
            return {"layers": []}
        rows = self.context.survey.ledger.rows("select name, at from layer order by name")
        return {"layers": [{"name": n, "at": a} for n, a in rows]}

    def layer_get(self, name: str) -> Response:
        """A layer as GeoJSON."""
        row = None
        if isinstance(self.context.survey, LiveSurvey):
            row = self.context.survey.ledger.row("select body from layer where name = ?", name)
        if row is None:
            raise HTTPException(404, "there is no such layer")
        return Response(row[0], media_type="application/geo+json")

    async def layer_post(self, request: Request, name: str) -> JSONResponse:
        """Adds a layer (the request's body) over the map, or replaces the layer of that name:
        GeoJSON, or by the ending of its name KML, KMZ, GeoPackage or a zipped Shapefile.
        """
        writer, guard = self.context.writing(request), self.context.guard
        data = bytearray()
        try:
            async for block in blocks_of(request, guard.upload_stall_s):
                data += block
                if len(data) > guard.most_layer_bytes:
                    raise HTTPException(413, f"a layer may have {guard.most_layer_bytes} bytes")
        except (ClientDisconnect, TimeoutError) as error:
            raise HTTPException(408, "the connection was lost; send the layer again") from error
        try:
            layer = await to_thread.run_sync(_shapes, bytes(data), name, limiter=self._one)
            stored = await run_in_threadpool(
                put_layer, writer.ledger, shown_name(name), layer, self.context.guard.most_layers
            )
        except (LayerError, SideFileError) as error:
            raise HTTPException(422, f"this is not a layer: {error}") from error
        except OutputError as error:
            raise HTTPException(507, str(error)) from error
        if not stored:
            raise HTTPException(
                429, f"there are {self.context.guard.most_layers} layers already; remove one"
            )
        return JSONResponse({"name": shown_name(name), "features": len(layer["features"])}, 201)

    def layer_delete(self, request: Request, name: str) -> dict[str, str]:
        """Removes a layer."""
        writer = self.context.writing(request)
        if not drop_layer(writer.ledger, name):
            raise HTTPException(404, "there is no such layer")
        return {"name": name}

    def finish(self, request: Request) -> dict[str, str]:
        """Requests the final map: all photos are adjusted together and drawn at full resolution. It
        is kept beside the live map.
        """
        writer = self.context.writing(request)
        writer.ledger.put_meta("finish", "asked")
        writer.ledger.tell("finish", {"state": "asked"})
        return {"state": "asked"}
