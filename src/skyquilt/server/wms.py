"""WMS 1.1.1 and 1.3.0 (OGC 06-042): GetCapabilities, GetMap, GetFeatureInfo; QGIS and Mission
Planner are clients.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np
from fastapi import Request, Response
from fastapi.responses import JSONResponse
from pyproj import CRS
from pyproj.exceptions import CRSError

from skyquilt.raster.map_source import Bounds, MapSource, between, picture
from skyquilt.server.access import Context
from skyquilt.server.images import Images, image_bytes
from skyquilt.server.survey import covering


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


LARGEST = 4096
"""Largest width and height of an image in px."""
FORMATS = ("image/png", "image/jpeg", "image/webp")


class WmsError(Exception):
    """An invalid request; `code`: the exception code of the standard."""

    def __init__(self, text: str, code: str = "InvalidParameterValue") -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True, kw_only=True)
class MapRequest:
    """A GetMap request."""

    version: str
    """1.1.1 or 1.3.0."""
    layers: tuple[str, ...]
    """Names of the layers, bottom first."""
    crs: str
    """CRS in a form that pyproj reads."""
    bounds: Bounds
    """West, south, east, north in x, y order, whatever the axis order of the CRS."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    format: str
    """One of `FORMATS`."""
    transparent: bool
    """Whether empty pixels stay transparent."""


def asked(query: Mapping[str, str]) -> dict[str, str]:
    """Parameters by upper-case name, since names are not case-sensitive in WMS."""
    return {k.upper(): v for k, v in query.items()}


def map_request(query: Mapping[str, str], known: Mapping[str, MapSource]) -> MapRequest:
    """The request described by parameters (upper-case names).

    Raises:
        WmsError: they are invalid.
    """
    version = (
        "1.1.1" if query.get("VERSION", query.get("WMTVER", "1.3.0")).startswith("1.1") else "1.3.0"
    )
    layers = tuple(n for n in query.get("LAYERS", "").split(",") if n)
    if not layers:
        raise WmsError("LAYERS is missing", "LayerNotDefined")
    for name in layers:
        if name not in known:
            raise WmsError(
                f"there is no layer {name!r}; there are {', '.join(known) or 'none yet'}",
                "LayerNotDefined",
            )
    crs = query.get("CRS") or query.get("SRS") or ""
    if crs not in supported(known):
        raise WmsError(
            f"CRS {crs!r} is none of {', '.join(supported(known))}",
            "InvalidCRS" if version == "1.3.0" else "InvalidSRS",
        )
    width, height = (_whole(query, n) for n in ("WIDTH", "HEIGHT"))
    form = query.get("FORMAT", "image/png").split(";")[0]
    if form not in FORMATS:
        raise WmsError(f"FORMAT {form!r} is none of {', '.join(FORMATS)}", "InvalidFormat")
    return MapRequest(
        version=version,
        layers=layers,
        crs="EPSG:4326" if crs == "CRS:84" else crs,
        bounds=_bounds(query.get("BBOX", ""), crs, version),
        width=width,
        height=height,
        format=form,
        transparent=query.get("TRANSPARENT", "FALSE").upper() == "TRUE",
    )


def _whole(query: Mapping[str, str], name: str) -> int:
    text = query.get(name, "")
    if not text.isascii() or not text.isdigit() or not 1 <= int(text[:9]) <= LARGEST:
        raise WmsError(f"{name} is a whole number from 1 to {LARGEST}, got {text[:20]!r}")
    return int(text)


def _bounds(text: str, crs: str, version: str) -> Bounds:
    try:
        a, b, c, d = (float(v) for v in text.split(","))
    except ValueError as error:
        raise WmsError(f"BBOX is four numbers, got {text[:80]!r}") from error
    if version == "1.3.0" and crs != "CRS:84" and northing_first(crs):
        a, b, c, d = b, a, d, c
    if not (a < c and b < d and all(abs(v) < 1e9 for v in (a, b, c, d))):
        raise WmsError(f"BBOX has no area: {text[:80]!r}")
    return a, b, c, d


def northing_first(crs: str) -> bool:
    """Whether the first axis of a CRS is the northing or latitude; WMS 1.3.0 follows that order."""
    try:
        return CRS.from_user_input(crs).axis_info[0].direction.lower() == "north"
    except (CRSError, IndexError):
        return False


def supported(known: Mapping[str, MapSource]) -> list[str]:
    """CRSs in which images are offered."""
    own = [s.crs for s in known.values() if s.crs.startswith("EPSG:")]
    return list(dict.fromkeys(["EPSG:3857", "EPSG:4326", "CRS:84", *own]))


def capabilities(known: Mapping[str, MapSource], url: str, version: str) -> str:
    """The capabilities document of the service."""
    old = version.startswith("1.1")
    crs_tag = "SRS" if old else "CRS"
    layers = "".join(_layer(n, s, known, old=old) for n, s in known.items())
    crs = "".join(
        f"<{crs_tag}>{c}</{crs_tag}>" for c in supported(known) if not (old and c == "CRS:84")
    )
    href = escape(url, {chr(34): "&quot;"})
    online = (
        '<OnlineResource xmlns:xlink="http://www.w3.org/1999/xlink" xlink:type="simple"'
        f' xlink:href="{href}"/>'
    )
    get = f"<DCPType><HTTP><Get>{online}</Get></HTTP></DCPType>"
    kind = "application/vnd.ogc.wms_xml" if old else "text/xml"
    formats = "".join(f"<Format>{f}</Format>" for f in FORMATS)
    root, end = (
        ('<WMT_MS_Capabilities version="1.1.1">', "</WMT_MS_Capabilities>")
        if old
        else (
            '<WMS_Capabilities version="1.3.0" xmlns="http://www.opengis.net/wms">',
            "</WMS_Capabilities>",
        )
    )
    service, problem = ("OGC:WMS", "application/vnd.ogc.se_xml") if old else ("WMS", "XML")
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        + root
        + f"<Service><Name>{service}</Name><Title>Skyquilt</Title>{online}</Service>"
        + f"<Capability><Request><GetCapabilities><Format>{kind}</Format>{get}</GetCapabilities>"
        + f"<GetMap>{formats}{get}</GetMap>"
        + f"<GetFeatureInfo><Format>application/json</Format>{get}</GetFeatureInfo></Request>"
        + f"<Exception><Format>{problem}</Format></Exception>"
        + f"<Layer><Title>Skyquilt</Title>{crs}{layers}</Layer></Capability>"
        + end
    )


def _layer(name: str, source: MapSource, known: Mapping[str, MapSource], *, old: bool) -> str:
    bounds = source.bounds()
    boxes = ""
    if bounds is not None:
        west, south, east, north = between(source.crs, "EPSG:4326").transform_bounds(*bounds)
        if old:
            boxes = (
                f'<LatLonBoundingBox minx="{west}" miny="{south}" maxx="{east}" maxy="{north}"/>'
            )
        else:
            boxes = (
                "<EX_GeographicBoundingBox>"
                f"<westBoundLongitude>{west}</westBoundLongitude>"
                f"<eastBoundLongitude>{east}</eastBoundLongitude>"
                f"<southBoundLatitude>{south}</southBoundLatitude><northBoundLatitude>{north}"
                "</northBoundLatitude></EX_GeographicBoundingBox>"
            )
        for crs in supported(known):
            if old and crs == "CRS:84":
                continue
            box = list(
                between(source.crs, "EPSG:4326" if crs == "CRS:84" else crs).transform_bounds(
                    *bounds
                )
            )
            if not old and crs != "CRS:84" and northing_first(crs):
                box = [box[1], box[0], box[3], box[2]]
            tag = "SRS" if old else "CRS"
            boxes += (
                f'<BoundingBox {tag}="{crs}" minx="{box[0]}" miny="{box[1]}" maxx="{box[2]}"'
                f' maxy="{box[3]}"/>'
            )
    return (
        "<Layer"
        f' queryable="1"><Name>{escape(name)}</Name><Title>{escape(name)}</Title>{boxes}</Layer>'
    )


def refusal(error: WmsError, version: str) -> str:
    """An error as the XML document of the standard."""
    old = version.startswith("1.1")
    head = (
        '<ServiceExceptionReport version="1.1.1">'
        if old
        else '<ServiceExceptionReport version="1.3.0" xmlns="http://www.opengis.net/ogc">'
    )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n{head}<ServiceException'
        f' code="{error.code}">{escape(str(error))}'
        "</ServiceException></ServiceExceptionReport>"
    )
