"""Endpoints of layers over the map and of the button that ends a flight."""

from typing import Any

from fastapi import HTTPException, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse

from skyquilt.errors import OutputError
from skyquilt.live.photo_intake import shown_name
from skyquilt.server.access import Context
from skyquilt.server.layers import LayerError, checked, drop_layer, put_layer
from skyquilt.server.survey import LiveSurvey


class LayerEndpoints:
    """Endpoints of layers."""

    def __init__(self, context: Context) -> None:
        self.context = context

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
        """Adds GeoJSON (the request's body) as a layer over the map, or replaces the layer of that
        name.
        """
        writer = self.context.writing(request)
        data = b""
        async for block in request.stream():
            data += block
            if len(data) > self.context.guard.most_layer_bytes:
                raise HTTPException(
                    413, f"a layer may have {self.context.guard.most_layer_bytes} bytes"
                )
        try:
            layer = await run_in_threadpool(checked, data)
            stored = await run_in_threadpool(
                put_layer, writer.ledger, shown_name(name), layer, self.context.guard.most_layers
            )
        except LayerError as error:
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
