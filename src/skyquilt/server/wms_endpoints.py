"""The WMS endpoint."""

import numpy as np
from fastapi import Request, Response
from fastapi.responses import JSONResponse

from skyquilt.raster.map_source import between, picture
from skyquilt.server.access import Context
from skyquilt.server.images import Images, image_bytes
from skyquilt.server.survey import covering
from skyquilt.server.wms import WmsError, asked, capabilities, map_request, refusal


class WmsEndpoints:
    """GetCapabilities, GetMap, and GetFeatureInfo, which lists the photos at a pixel."""

    def __init__(self, context: Context, images: Images) -> None:
        self.context, self.images = context, images

    def wms(self, request: Request) -> Response:
        """WMS 1.1.1 and 1.3.0."""
        query = asked(request.query_params)
        version = query.get("VERSION", query.get("WMTVER", "1.3.0"))
        known = self.context.survey.layers()
        try:
            what = query.get("REQUEST", "").lower()
            if what in ("getcapabilities", "capabilities"):
                kind = "application/vnd.ogc.wms_xml" if version.startswith("1.1") else "text/xml"
                return Response(
                    capabilities(known, f"{request.base_url}wms?", version), media_type=kind
                )
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
        known = self.context.survey.layers()
        want = map_request(query, known)
        out = None
        for name in want.layers:
            scale = self.images.scale(name, known[name])
            rgba = picture(known[name], want.crs, want.bounds, want.width, want.height, scale)
            if rgba is not None and out is not None:
                rgba[rgba[..., 3] == 0] = out[rgba[..., 3] == 0]
            out = rgba if rgba is not None else out
        if out is None:
            out = np.zeros((want.height, want.width, 4), np.uint8)
        return Response(
            image_bytes(out, want.format, transparent=want.transparent), media_type=want.format
        )

    def _feature_info(self, query: dict[str, str]) -> Response:
        want = map_request(query, self.context.survey.layers())
        try:
            i, j = int(query.get("I", query.get("X", ""))), int(query.get("J", query.get("Y", "")))
        except ValueError as error:
            raise WmsError("I and J are whole numbers", "InvalidPoint") from error
        west, south, east, north = want.bounds
        x, y = (
            west + (i + 0.5) / want.width * (east - west),
            north - (j + 0.5) / want.height * (north - south),
        )
        lon, lat = (
            between(want.crs, "EPSG:4326").transform(x, y) if want.crs != "EPSG:4326" else (x, y)
        )
        found = [p.record for p in covering(self.context.survey.photos(), lon, lat)]
        return JSONResponse({"lon": lon, "lat": lat, "photos": found})
