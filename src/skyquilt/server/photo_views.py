"""Photos on the screen: thumbnails, enlarged details, and where a photo shows a place."""

import threading
from collections import OrderedDict
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

import cv2
import numpy as np
from anyio import CapacityLimiter, to_thread
from fastapi import HTTPException, Query, Response
from numpy.typing import NDArray

from skyquilt.errors import UnreadablePhotoError
from skyquilt.outside import check_picture
from skyquilt.raster.map_source import between
from skyquilt.server.access import Context
from skyquilt.server.finished_survey import FinishedSurvey
from skyquilt.server.photo_endpoints import Degrees, Latitude, Number, PhotoEndpoints
from skyquilt.server.readouts import HEIGHTS, value_at
from skyquilt.server.survey import LiveSurvey

if TYPE_CHECKING:
    from skyquilt.server.projection import Projection

THUMBNAIL = 480
"""Longer side of a thumbnail in px."""
KEPT = 3
"""Decoded photos kept."""
KEPT_THUMBNAILS = 200
DECODED_AT_ONCE = 1
Pixel = Annotated[float, Query(ge=-1e5, le=1e5, allow_inf_nan=False)]


class PhotoViews:
    """Endpoints of photos as pictures. One photo is decoded at a time."""

    def __init__(self, context: Context, photos: PhotoEndpoints) -> None:
        self.context, self.photos = context, photos
        self._decoding = CapacityLimiter(DECODED_AT_ONCE)
        self._pictures: OrderedDict[int, NDArray[np.uint8]] = OrderedDict()
        self._thumbnails: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()

    @cached_property
    def projection(self) -> "Projection":
        """Poses and cameras of a finished run.

        Raises:
            HTTPException: there are none.
        """
        survey = self.context.survey
        if not isinstance(survey, FinishedSurvey):
            raise HTTPException(404, "poses are known when the final map is made")
        from skyquilt.server.projection import Projection  # needed by few, and slow to load

        return Projection(survey.folder)

    def picture(self, number: int) -> NDArray[np.uint8]:
        """A photo decoded, (h, w, 3) RGB; only one of those that the map was made from."""
        with self._lock:
            if number in self._pictures:
                self._pictures.move_to_end(number)
                return self._pictures[number]
        path = self.photos.checked(number)
        import simplejpeg

        data = path.read_bytes()
        try:
            if data[:2] == b"\xff\xd8":
                height, width = simplejpeg.decode_jpeg_header(data)[:2]
                check_picture(width, height, 3, file_bytes=len(data))
                rgb = simplejpeg.decode_jpeg(data, "RGB")
            else:
                rgb = _other(data)
        except Exception as error:  # whatever a decoder finds wrong with a file
            raise HTTPException(404, "its file cannot be decoded") from error
        with self._lock:
            self._pictures[number] = rgb
            while len(self._pictures) > KEPT:
                self._pictures.popitem(last=False)
        return np.asarray(rgb)

    async def thumbnail(self, number: Number) -> Response:
        """A photo, reduced to at most 480 px (JPEG)."""
        return await to_thread.run_sync(self._thumbnail, number, limiter=self._decoding)

    def _thumbnail(self, number: int) -> Response:
        data = self._thumbnails.get(number)
        if data is None:
            rgb = self.picture(number)
            scale = THUMBNAIL / max(rgb.shape[:2])
            size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
            data = _jpeg(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
            self._thumbnails[number] = data
            while len(self._thumbnails) > KEPT_THUMBNAILS:
                self._thumbnails.popitem(last=False)
        return Response(data, media_type="image/jpeg", headers={"Cache-Control": "max-age=600"})

    async def detail(
        self,
        number: Number,
        x: Pixel,
        y: Pixel,
        size: Annotated[int, Query(ge=16, le=2000)] = 200,
        shown: Annotated[int, Query(ge=16, le=1000)] = 400,
    ) -> Response:
        """A square of a photo, `size` px about a pixel, shown in `shown` px (PNG); grey outside."""
        return await to_thread.run_sync(
            self._detail, number, x, y, size, shown, limiter=self._decoding
        )

    def _detail(self, number: int, x: float, y: float, size: int, shown: int) -> Response:
        rgb = self.picture(number)
        k = size / shown  # pixel centres at integers, in both
        matrix = np.array([[k, 0, x - (shown - 1) / 2 * k], [0, k, y - (shown - 1) / 2 * k]])
        how = cv2.INTER_AREA if k > 2 else cv2.INTER_NEAREST if k < 0.4 else cv2.INTER_LINEAR
        out = cv2.warpAffine(
            rgb, matrix, (shown, shown),
            flags=(cv2.INTER_LINEAR if how == cv2.INTER_AREA else how) | cv2.WARP_INVERSE_MAP,
            borderValue=(128, 128, 128),
        )  # fmt: skip
        return Response(_jpeg(out), media_type="image/jpeg")

    async def place(self, number: Number, lon: Degrees, lat: Latitude) -> dict[str, Any]:
        """The pixel at which a photo of the map shows a place on the ground."""
        return await to_thread.run_sync(self._place, number, lon, lat, limiter=self._decoding)

    def _place(self, number: int, lon: float, lat: float) -> dict[str, Any]:
        shown = self.context.survey.photo(number)
        if shown is None:
            raise HTTPException(404, f"there is no photo {number}")
        if isinstance(self.context.survey, LiveSurvey):
            return self._live_place(self.context.survey, number, lon, lat)
        x, y, z = self.on_ground(lon, lat)
        px = self.projection.pixel(shown.name, (x, y, z))
        if px is None:
            raise HTTPException(404, "the photo does not show this place")
        width, height = self.projection.size(shown.name)
        return {"x": round(px[0], 2), "y": round(px[1], 2), "width": width, "height": height}

    @staticmethod
    def _live_place(survey: LiveSurvey, number: int, lon: float, lat: float) -> dict[str, Any]:
        from skyquilt.server.live_projection import LiveProjection  # needed by few, slow to load

        crs = (survey.ledger.meta("frame") or {}).get("crs")
        if crs is None:
            raise HTTPException(404, "the map has no place")
        x, y = between("EPSG:4326", crs).transform(lon, lat)
        try:
            found = LiveProjection(survey).pixel(number, x, y)
        except UnreadablePhotoError as error:
            raise HTTPException(404, str(error)) from error
        if found is None:
            raise HTTPException(404, "the photo does not show this place")
        (px, py), camera = found
        return {
            "x": round(px, 2), "y": round(py, 2), "width": camera.width, "height": camera.height
        }  # fmt: skip

    def on_ground(self, lon: float, lat: float) -> tuple[float, float, float]:
        """A place in the map's projection with the height of the surface."""
        layers = self.context.survey.layers()
        _, source = self.context.layer(None)
        x, y = between("EPSG:4326", source.crs).transform(lon, lat)
        for name in HEIGHTS:
            if name in layers and (z := value_at(layers[name], x, y)) is not None:
                return x, y, z
        return x, y, self.projection.ground()


def _other(data: bytes) -> NDArray[np.uint8]:
    """A TIFF, PNG or WebP as RGB; measured values stretched to 8 bits."""
    import io

    from PIL import Image

    with Image.open(io.BytesIO(data)) as image:
        check_picture(image.width, image.height, 8, file_bytes=len(data))
        pixels = np.asarray(image)
    flat = pixels if pixels.ndim == 2 else pixels[..., :3]
    if flat.dtype != np.uint8:
        low, high = np.nanpercentile(flat, [1, 99])
        flat = np.clip((flat - low) / max(high - low, 1e-9) * 255, 0, 255).astype(np.uint8)
    if flat.ndim == 2:
        flat = np.repeat(flat[..., None], 3, 2)
    return np.ascontiguousarray(flat)


def _jpeg(rgb: NDArray[Any]) -> bytes:
    import simplejpeg

    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), quality=88))
