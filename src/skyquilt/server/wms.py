"""WMS 1.1.1 and 1.3.0 (OGC 06-042): GetCapabilities, GetMap, GetFeatureInfo; QGIS and Mission
Planner are clients.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np
from anyio import CapacityLimiter, to_thread
from fastapi import HTTPException, Request, Response
from fastapi.responses import JSONResponse
from pyproj import CRS
from pyproj.exceptions import CRSError

from skyquilt.engine.free_memory import give_back
from skyquilt.errors import SideFileError
from skyquilt.outside import real, whole
from skyquilt.raster.map_source import Bounds, MapSource, between, picture
from skyquilt.raster.picture_files import image_bytes
from skyquilt.server.access import Context
from skyquilt.server.images import Images
from skyquilt.server.shown import covering


class WmsEndpoints:
    """GetCapabilities, GetMap, and GetFeatureInfo, which lists the photos at a pixel."""

    def __init__(self, context: Context, images: Images) -> None:
        self.context, self.images = context, images
        self._drawing = CapacityLimiter(DRAWN_AT_ONCE)

    async def wms(self, request: Request) -> Response:
        """WMS 1.1.1 and 1.3.0."""
        if self._drawing.statistics().tasks_waiting >= MOST_WAITING:
            raise HTTPException(503, "too many images are being drawn", {"Retry-After": "5"})
        return await to_thread.run_sync(self._answer, request, limiter=self._drawing)

    def _answer(self, request: Request) -> Response:
        query = asked(request.query_params)
        version = query.get("VERSION", query.get("WMTVER", "1.3.0"))
        known = self.context.survey.layers()
        try:
            what = query.get("REQUEST", "").lower()
            if what in ("getcapabilities", "capabilities"):
                kind = "application/vnd.ogc.wms_xml" if version.startswith("1.1") else "text/xml"
                return Response(
                    capabilities(known, f"{self.context.guard.base(request)}wms?", version),
                    media_type=kind,
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
        for name in dict.fromkeys(reversed(want.layers)):  # the topmost first
            if out is not None and out[..., 3].all():
                break
            scale = self.images.scale(name, known[name])
            palette = self.images.style(name).palette
            rgba = picture(
                known[name], want.crs, want.bounds, want.width, want.height, scale, palette
            )
            if rgba is not None and out is not None:
                np.copyto(out, rgba, where=(out[..., 3] == 0)[..., None])
            out = rgba if out is None else out
        if out is None:
            out = np.zeros((want.height, want.width, 4), np.uint8)
        data = image_bytes(out, want.format, transparent=want.transparent)
        if want.width * want.height > LARGE:
            del out
            give_back()
        return Response(data, media_type=want.format)

    def _feature_info(self, query: dict[str, str]) -> Response:
        want = map_request(query, self.context.survey.layers())
        i = whole(query.get("I", query.get("X", "")), 0, want.width - 1)
        j = whole(query.get("J", query.get("Y", "")), 0, want.height - 1)
        if i is None or j is None:
            raise WmsError("I and J are whole numbers, those of a pixel", "InvalidPoint")
        west, south, east, north = want.bounds
        x, y = (
            west + (i + 0.5) / want.width * (east - west),
            north - (j + 0.5) / want.height * (north - south),
        )
        lon, lat = (
            between(want.crs, "EPSG:4326").transform(x, y) if want.crs != "EPSG:4326" else (x, y)
        )
        if not (math.isfinite(lon) and math.isfinite(lat)):
            raise WmsError("there is no place on Earth at this pixel", "InvalidPoint")
        found = [p.record for p in covering(self.context.survey.photos(), lon, lat)]
        return JSONResponse({"lon": lon, "lat": lat, "photos": found})


LARGEST, MOST_PIXELS = 4096, 2048 * 2048
"""Largest width and height of an image in px, and its largest area."""
MOST_LAYERS = 10
"""Largest number of layers of an image; their areas together may be `MOST_LAYERED` times that of
the largest image.
"""
MOST_LAYERED = 2
DRAWN_AT_ONCE, MOST_WAITING = 2, 100
"""Number of images drawn at a time, and of requests that wait for it."""
LARGE = 500_000
"""Pixels of an image after which freed memory is given back to the system."""
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
    layers = tuple(n for n in query.get("LAYERS", "").split(",", MOST_LAYERS + 1) if n)
    if not layers:
        raise WmsError("LAYERS is missing", "LayerNotDefined")
    if len(layers) > MOST_LAYERS:
        raise WmsError(f"LAYERS are {MOST_LAYERS} at most")
    for name in layers:
        if name not in known:
            raise WmsError(
                f"there is no layer {name[:60]!r}; there are {', '.join(known) or 'none yet'}",
                "LayerNotDefined",
            )
    crs = query.get("CRS") or query.get("SRS") or ""
    if crs not in supported(known):
        raise WmsError(
            f"CRS {crs[:60]!r} is none of {', '.join(supported(known))}",
            "InvalidCRS" if version == "1.3.0" else "InvalidSRS",
        )
    width, height = (_whole(query, n) for n in ("WIDTH", "HEIGHT"))
    if width * height > MOST_PIXELS or (
        width * height * len(set(layers)) > MOST_LAYERED * MOST_PIXELS
    ):
        raise WmsError(
            f"an image has {MOST_PIXELS} px at most, and {MOST_LAYERED * MOST_PIXELS} px in all"
            f" layers together; got {width} x {height} px in {len(set(layers))} layers"
        )
    form = query.get("FORMAT", "image/png").split(";")[0]
    if form not in FORMATS:
        raise WmsError(f"FORMAT {form[:60]!r} is none of {', '.join(FORMATS)}", "InvalidFormat")
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
    found = whole(text, 1, LARGEST)
    if found is None:
        raise WmsError(f"{name} is a whole number from 1 to {LARGEST}, got {text[:20]!r}")
    return found


def _bounds(text: str, crs: str, version: str) -> Bounds:
    numbers = [real(v, -1e9, 1e9) for v in text.split(",", 4)]
    if len(numbers) != 4 or None in numbers:
        raise WmsError(f"BBOX is four numbers, got {text[:80]!r}")
    a, b, c, d = (v for v in numbers if v is not None)
    if version == "1.3.0" and crs != "CRS:84" and northing_first(crs):
        a, b, c, d = b, a, d, c
    if not (a < c and b < d):
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
    own = [s.crs for s in known.values() if _readable(s) and s.crs.startswith("EPSG:")]
    return list(dict.fromkeys(["EPSG:3857", "EPSG:4326", "CRS:84", *own]))


def capabilities(known: Mapping[str, MapSource], url: str, version: str) -> str:
    """The capabilities document of the service."""
    old = version.startswith("1.1")
    known = {name: source for name, source in known.items() if _readable(source)}
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
    side = math.isqrt(MOST_PIXELS)
    limits = (
        ""
        if old
        else (
            f"<LayerLimit>{MOST_LAYERS}</LayerLimit><MaxWidth>{side}</MaxWidth>"
            f"<MaxHeight>{side}</MaxHeight>"
        )
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        + root
        + f"<Service><Name>{service}</Name><Title>Skyquilt</Title>{online}{limits}</Service>"
        + f"<Capability><Request><GetCapabilities><Format>{kind}</Format>{get}</GetCapabilities>"
        + f"<GetMap>{formats}{get}</GetMap>"
        + f"<GetFeatureInfo><Format>application/json</Format>{get}</GetFeatureInfo></Request>"
        + f"<Exception><Format>{problem}</Format></Exception>"
        + f"<Layer><Title>Skyquilt</Title>{crs}{layers}</Layer></Capability>"
        + end
    )


def _readable(source: MapSource) -> bool:
    """False for a file that is damaged: the others are offered."""
    try:
        source.about()
    except SideFileError:
        return False
    return True


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
