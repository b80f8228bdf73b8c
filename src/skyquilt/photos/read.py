"""Reads one file as a `Photo`."""

import traceback
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from datetime import datetime, timedelta
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

import numpy as np

from skyquilt.engine.store import Store, digest
from skyquilt.errors import UnreadablePhotoError
from skyquilt.model.camera import Camera
from skyquilt.model.photo import Focal, Photo, RejectedPhoto, Stored, Zoom
from skyquilt.outside import MOST_MP, check_picture, open_regular, plain, whole
from skyquilt.photos import tags as tag
from skyquilt.photos.capture import Native, native_picture, part_of_shutter
from skyquilt.photos.flir import MOST_THERMAL_MP
from skyquilt.photos.headers import Header, content_digest, read_header
from skyquilt.photos.lens import (
    Sensor,
    already_undistorted,
    digital_zoom,
    find_focal,
    find_sensor,
    focal_notes,
    read_calibration,
)
from skyquilt.photos.metadata import (
    find_editor,
    modified_time,
    read_attitude,
    read_flight_tilt,
    read_flight_yaw,
    read_height,
    read_image_direction,
    read_position,
    read_time,
    read_velocity,
)
from skyquilt.photos.pixels import read_tiff
from skyquilt.photos.thermal import (
    UNREAD,
    ThermalFrame,
    has_raw_data,
    like_reflectance,
    linear_gain,
    stated_scale,
    stated_unit,
    thermal_frame_of_jpeg,
    thermal_frame_of_values,
)
from skyquilt.version import __version__

T = TypeVar("T")
_LARGEST_THERMAL = 1280
TABLES = "sensors.csv", "shutters.csv"
"""Tables with which metadata are read."""
RECORDS = "records"
"""Folder in the store of the metadata read."""


class ReadPhoto(Protocol):
    """Reads the metadata of a file, as `read_photo` does."""

    def __call__(
        self, path: Path, *, name: str | None, thermal_unit: str | None, most_mp: float
    ) -> Photo | RejectedPhoto:
        """The photo, or why it is none."""
        ...


def read_photo(
    path: Path,
    *,
    name: str | None = None,
    thermal_unit: str | None = None,
    most_mp: float = MOST_MP,
) -> Photo | RejectedPhoto:
    """The metadata of a file, without decoding its pixels; a bad file is a `RejectedPhoto`.

    `thermal_unit`: meaning of the values of a single-band TIFF (`model.photo.Stored`); `auto` = it
    is thermal, and its unit is read from the file or derived from its values; None = whether it is
    thermal is determined too. `most_mp`: largest area in megapixels.
    """
    name = name or plain(path.name)
    try:
        header = read_header(path, most_mp=most_mp)
        header = replace(header, exif=tag.with_xmp(header.exif, header.xmp))
        return _photo(path, name, header, thermal_unit)
    except Exception as error:  # one unexpected file must not stop a survey of thousands
        return rejected(name, error)


def rejected(name: str, error: Exception) -> RejectedPhoto:
    """What an error of one photo, whatever it is, means for that photo: its name, a reason, and,
    where the error was not foreseen, the place in the program for the log of errors.
    """
    if isinstance(error, UnreadablePhotoError):
        return RejectedPhoto(name=name, reason=plain(str(error)))
    if isinstance(error, OSError):
        return RejectedPhoto(name=name, reason=f"it cannot be read ({error.strerror or error})")
    words = plain(f"it is of an unknown kind ({type(error).__name__}: {error})", 300)
    return RejectedPhoto(
        name=name, reason=words, trace="".join(traceback.format_exception(error))[-20_000:]
    )


PANORAMAS = ("equirectangular", "cylindrical")
"""Projections of panoramas; no camera takes such a picture at once."""


class ReadFiles:
    """Reads the metadata of photos; of files that an earlier run in the same output folder read,
    they are taken from its store: a run that goes on need not read thousands of files.

    A file is the same if its name, its place on the disk, its size and the times of its last
    changes, of content and of attributes, are the same.
    """

    def __init__(self, store: Store) -> None:
        """What an earlier run read is taken from its store."""
        tables = (files("skyquilt.photos").joinpath(name).read_text("utf-8") for name in TABLES)
        self._key = digest(read_photo, [f.name for f in fields(Photo)], *tables, __version__)
        self._held: dict[str, dict[str, Any]] = dict(store.get(RECORDS, self._key) or {})
        self._read: dict[str, dict[str, Any]] = {}

    def __call__(
        self, path: Path, *, name: str | None, thermal_unit: str | None, most_mp: float
    ) -> Photo | RejectedPhoto:
        """A file's metadata, see `read_photo`."""
        try:
            info = path.stat()
        except OSError:
            return read_photo(path, name=name, thermal_unit=thermal_unit, most_mp=most_mp)
        stamp = f"{info.st_dev}:{info.st_ino}:{info.st_size}:{info.st_mtime_ns}:{info.st_ctime_ns}"
        stamp = f"{stamp}:{thermal_unit}:{most_mp}:{name}"
        held = self._held.get(stamp)
        if held is not None:
            self._read[stamp] = held
            time = held["time"] and datetime.fromisoformat(held["time"])
            return Photo(**{**held, "path": path, "time": time})
        found = read_photo(path, name=name, thermal_unit=thermal_unit, most_mp=most_mp)
        if isinstance(found, Photo):
            told = {f.name: getattr(found, f.name) for f in fields(found) if f.name != "path"}
            self._read[stamp] = told | {"time": found.time and found.time.isoformat()}
        return found

    def keep(self, store: Store) -> None:
        """Stores what was read; where it is all there already, nothing is done.

        Raises:
            OutputError: the disk is full or the folder read-only.
        """
        if self._read.keys() != self._held.keys():
            store.put(RECORDS, self._key, self._read)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Lens:
    sensor: Sensor | None
    thermal: bool
    calibration: Camera | None
    nonsense: tuple[str, ...]
    focal: Focal
    native: Native
    notes: tuple[str, ...]


def _photo(path: Path, name: str, header: Header, thermal_unit: str | None) -> Photo:
    joined = header.xmp.text("GPano:ProjectionType", "panorama:ProjectionType").lower()
    if joined in PANORAMAS:
        raise UnreadablePhotoError(f"it is a panorama ({joined}), joined from several photos")
    frame = _thermal_frame(path, header, thermal_unit)
    height, width = frame.values.shape if frame else (header.height, header.width)
    strange: list[str] = []
    lens = _ignoring(
        lambda: _lens(header, width, height, thermal=frame is not None),
        lambda: _lens(_bare(header), width, height, thermal=frame is not None),
        "lens",
        strange,
    )
    position, place_notes = _ignoring(
        lambda: read_position(header.exif, header.xmp), lambda: (None, ()), "position", strange
    )
    attitude, angle_notes = _ignoring(
        lambda: read_attitude(header.xmp), lambda: (None, ()), "camera angles", strange
    )
    flight_yaw, yaw_notes = read_flight_yaw(header.xmp)
    heading_of = "xmp-flight"
    if flight_yaw is None and attitude is None:
        flight_yaw, heading_of = read_image_direction(header.exif), "exif"
    time = _ignoring(
        lambda: read_time(header.exif, header.xmp), lambda: None, "capture time", strange
    )
    rolling = _rolling(header, lens.sensor)
    seen = (*lens.notes, frame.note if frame else "", *place_notes, *angle_notes, *yaw_notes)
    more = _ignoring(
        lambda: _other_notes(header, lens, read=frame is not None), lambda: (), "editing", strange
    )
    return Photo(
        name=name,
        path=path,
        digest=content_digest(path),
        width=width,
        height=height,
        channels=1 if frame else header.channels,
        dtype="float32" if frame else header.dtype,
        placed=_is_placed(header),
        alpha=header.alpha,
        band="thermal" if lens.thermal else "visible",
        unit=frame.unit if frame else "",
        stored=frame.stored if frame else "",
        camera_key=_camera_key(header, width, height, digital_zoom(header.exif)),
        zoom=_zoom(header, width, height),
        calibration=lens.calibration,
        band_name=tag.band_shown(header.xmp),
        unusable_calibration=" and ".join(lens.nonsense),
        focal=lens.focal,
        whole_told=lens.native.part,
        position=position,
        height_m=None if position else _height(header),
        attitude=attitude,
        flight_yaw_deg=flight_yaw,
        flight_yaw_source=heading_of,
        flight_tilt_deg=read_flight_tilt(header.xmp),
        time=time,
        orientation_tag=whole(header.exif.tags.get(tag.ORIENTATION), 1, 8) or 1,
        rolling_shutter=rolling,
        shutter=part_of_shutter(header.exif.text(tag.MODEL), lens.native, rolling),
        velocity_ned=read_velocity(header.xmp),
        editor=find_editor(header.exif, header.xmp),
        coding="" if header.jpeg is None else header.jpeg.coding,
        notes=tuple(n for n in (*_broken_notes(header), *strange, *seen, *more) if n),
    )


def _height(header: Header) -> float | None:
    """Height above take-off in m of a file without a position."""
    return _ignoring(lambda: read_height(header.exif, header.xmp), lambda: None, "height", [])


def _ignoring(read: Callable[[], T], otherwise: Callable[[], T], what: str, notes: list[str]) -> T:
    """What a reader of metadata finds; where it fails on values that nobody foresaw, they are
    ignored and named, since the pixels are good.
    """
    try:
        return read()
    except (ArithmeticError, ValueError, TypeError, LookupError) as error:
        notes.append(
            f"Its {what} in the metadata cannot be used and was ignored"
            f" ({type(error).__name__}: {plain(str(error), 100)})."
        )
        return otherwise()


def _is_placed(header: Header) -> bool:
    """Whether a TIFF has a coordinate system and places its pixels in it (GeoTIFF 1.1)."""
    tags = header.exif.tags
    return tag.GEO_KEYS in tags and (tag.PIXEL_SCALE in tags or tag.PIXEL_MATRIX in tags)


def _bare(header: Header) -> Header:
    """The header without metadata."""
    return replace(header, exif=tag.Exif(), xmp=tag.Xmp())


def _lens(header: Header, width: int, height: int, *, thermal: bool) -> _Lens:
    exif = header.exif
    native = native_picture(exif, width, height, whole=thermal)
    long_side = round(max(native.width, native.height))
    sensor = find_sensor(model=exif.text(tag.MODEL), long_side=long_side)
    thermal = thermal or (sensor is not None and sensor.band == "thermal") or _says_thermal(header)
    found = read_calibration(exif=exif, xmp=header.xmp, sensor=sensor, picture=native)
    focal = find_focal(
        exif=exif, sensor=sensor, calibration=found.camera, native=native, thermal=thermal
    )
    told = tuple(f"Its calibration was ignored: {n}." for n in found.nonsense)
    notes = (native.note, *focal_notes(exif, sensor, native), *told)
    return _Lens(
        sensor=sensor,
        thermal=thermal,
        calibration=found.camera,
        nonsense=found.nonsense,
        focal=focal,
        native=native,
        notes=notes,
    )


def _thermal_frame(path: Path, header: Header, said: str | None) -> ThermalFrame | None:
    if header.jpeg:
        if not header.jpeg.radiometric:
            return None
        return thermal_frame_of_jpeg(header.jpeg, make=header.exif.text(tag.MAKE))
    if (
        header.kind != "tiff"
        or header.channels != 1
        or (said is None and max(header.width, header.height) > _LARGEST_THERMAL)
    ):
        return None
    stored = cast(Stored, said) if said not in (None, "auto") else _stated(header)
    sensor = find_sensor(
        model=header.exif.text(tag.MODEL), long_side=max(header.width, header.height)
    )
    known = said is not None or bool(stored) or _says_thermal(header)
    known = known or (sensor is not None and sensor.band == "thermal")
    if not known and (not header.stored.startswith("float") or tag.band_name(header.xmp)):
        return None
    check_picture(header.width, header.height, 4, most_mp=MOST_THERMAL_MP, option="")
    try:
        with open_regular(path) as file:
            size = (header.width, header.height)
            values = read_tiff(file, size, scaled=True, stored=stored)[..., 0]
        if not known and like_reflectance(values):
            return None
        converted = values.dtype.kind == "f" and header.stored.startswith("uint")
        scaled = stated_scale(header.exif.text(tag.GDAL_METADATA)) is not None or converted
        kind = values.dtype.name if scaled else header.stored
        frame = thermal_frame_of_values(np.asarray(values), stored, kind)
    except UnreadablePhotoError:
        raise
    except Exception as error:  # tifffile raises many exceptions; all mean: no pixels
        raise UnreadablePhotoError(f"its pixels cannot be decoded ({error})") from error
    return frame if known or frame.unit == "celsius" else None


def _stated(header: Header) -> Stored:
    told = stated_unit(f"{header.exif.text(tag.DESCRIPTION)} {header.exif.text(tag.GDAL_METADATA)}")
    linear = header.dtype == "uint16" and linear_gain(header.xmp) is not None
    return told or ("kelvin" if linear else "")


def _says_thermal(header: Header) -> bool:
    """Whether the file says that it shows a long-wave band, or that DJI's infrared camera took it;
    FLIR's rigs say it of their visible pictures, too.
    """
    large = header.channels > 1 and max(header.width, header.height) > _LARGEST_THERMAL
    told = header.xmp.text("Camera:BandName", "FLIR:BandName").lower()
    infrared = header.xmp.text("ImageSource").lower() == "infraredcamera"
    return not large and ("lwir" in told or infrared)


def _camera_key(header: Header, width: int, height: int, zoom: float) -> str:
    exif, xmp = header.exif, header.xmp
    mm = exif.number(tag.FOCAL_MM)
    make, model = exif.text(tag.MAKE) or "unknown", exif.text(tag.MODEL) or "camera"
    parts = (
        "" if model.lower().startswith(make.lower()) else make,
        model,
        exif.text(tag.SERIAL) or xmp.text("CameraSerialNumber", "drone-dji:DroneSerialNumber"),
        exif.text(tag.LENS),
        tag.band_shown(header.xmp),
        f"{width}x{height}",
        f"{mm:.1f}mm" if mm else "",
        f"zoom {zoom:g}" if zoom > 1 else "",
        "undistorted" if already_undistorted(xmp) else "",
    )
    return " ".join(" ".join(p.lower().split()) for p in parts if p)


def _zoom(header: Header, width: int, height: int) -> Zoom | None:
    factor = digital_zoom(header.exif)
    return Zoom(camera=_camera_key(header, width, height, 1), factor=factor) if factor > 1 else None


def _rolling(header: Header, sensor: Sensor | None) -> bool | None:
    written = header.xmp.text("ShutterType").lower()
    if written:
        return "mechanical" not in written and "global" not in written
    return sensor.shutter == "rolling" if sensor and sensor.shutter else None


def _broken_notes(header: Header) -> tuple[str, ...]:
    exif = "Its EXIF block is broken and was read as far as possible." if header.exif.broken else ""
    xmp = (
        "Its XMP packet is not valid XML; it was searched for values as text."
        if header.xmp.broken
        else ""
    )
    return exif, xmp


def _other_notes(header: Header, lens: _Lens, *, read: bool) -> tuple[str, ...]:
    time = read_time(header.exif, header.xmp)
    guess = _focal_note(lens.focal.source, header.exif.text(tag.MODEL))
    untimed = "" if time else "It has no capture time."
    jpeg = header.jpeg
    unread = not read and jpeg is not None and jpeg.radiometric and has_raw_data(jpeg)
    raw = UNREAD if unread else ""
    return *header.notes, raw, untimed, guess, _edit_note(header)


def _focal_note(source: str, model: str) -> str:
    if source != "guess":
        return ""
    camera = f"the camera database has no '{model}'" if model else "no camera model is named"
    return f"It has no usable focal length and {camera}: one is guessed from the format."


def _edit_note(header: Header) -> str:
    editor = find_editor(header.exif, header.xmp)
    if editor:
        return (
            f"It was rewritten by '{editor}': rotation, size and metadata may no longer fit the"
            " pixels."
        )
    taken, written = read_time(header.exif, header.xmp), modified_time(header.exif)
    if (
        taken
        and written
        and written.replace(tzinfo=None) - taken.replace(tzinfo=None) > timedelta(minutes=1)
    ):
        return f"The file was written again at {written:%Y-%m-%d %H:%M:%S}, after the capture."
    return ""
