"""Reads one file as a `Photo`."""

from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import cast

import numpy as np

from skyquilt.errors import UnreadablePhotoError
from skyquilt.model.camera import Camera
from skyquilt.model.photo import Focal, Photo, RejectedPhoto, Stored
from skyquilt.photos import tags as tag
from skyquilt.photos.headers import Header, content_digest, read_header
from skyquilt.photos.lens import (
    Sensor,
    find_focal,
    find_sensor,
    focal_notes,
    native_scale,
    read_calibration,
)
from skyquilt.photos.metadata import (
    find_editor,
    modified_time,
    read_attitude,
    read_flight_tilt,
    read_flight_yaw,
    read_position,
    read_time,
    read_velocity,
)
from skyquilt.photos.pixels import read_tiff
from skyquilt.photos.shutter import find_shutter
from skyquilt.photos.thermal import (
    ThermalFrame,
    stated_unit,
    thermal_frame_of_jpeg,
    thermal_frame_of_values,
)

_SMALLEST = 32
_STRANGE = "its metadata are of an unknown kind"
_LARGEST_THERMAL = 1280


def read_photo(
    path: Path, *, name: str | None = None, thermal_unit: str | None = None
) -> Photo | RejectedPhoto:
    """The metadata of a file, without decoding its pixels; a bad file is a `RejectedPhoto`.

    `thermal_unit`: meaning of the values of a single-band TIFF (`model.photo.Stored`); `auto` = it
    is thermal, and its unit is read from the file or derived from its values; None = whether it is
    thermal is determined too.
    """
    name = name or path.name
    try:
        header = read_header(path)
        return _photo(path, name, header, thermal_unit)
    except UnreadablePhotoError as error:
        return RejectedPhoto(name=name, reason=str(error))
    except OSError as error:
        return RejectedPhoto(name=name, reason=f"it cannot be read ({error.strerror or error})")
    except Exception as error:  # one unexpected file must not stop a survey of thousands
        return RejectedPhoto(name=name, reason=f"{_STRANGE} ({type(error).__name__}: {error})")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Lens:
    sensor: Sensor | None
    thermal: bool
    calibration: Camera | None
    focal: Focal
    captured_mp: float
    notes: tuple[str, ...]


def _photo(path: Path, name: str, header: Header, thermal_unit: str | None) -> Photo:
    frame = _thermal_frame(path, header, thermal_unit)
    height, width = frame.values.shape if frame else (header.height, header.width)
    if min(width, height) < _SMALLEST:
        raise UnreadablePhotoError(
            f"it has only {width}x{height} px; at least {_SMALLEST} a side are needed"
        )
    lens = _lens(header, width, height, thermal=frame is not None)
    position, place_notes = read_position(header.exif, header.xmp)
    attitude, angle_notes = read_attitude(header.xmp)
    rolling = _rolling(header, lens.sensor)
    seen = (*lens.notes, frame.note if frame else "", *place_notes, *angle_notes)
    return Photo(
        name=name,
        path=path,
        digest=content_digest(path),
        width=width,
        height=height,
        channels=1 if frame else header.channels,
        dtype="float32" if frame else header.dtype,
        band="thermal" if lens.thermal else "visible",
        unit=frame.unit if frame else "",
        stored=frame.stored if frame else "",
        camera_key=_camera_key(header, width, height),
        calibration=lens.calibration,
        focal=lens.focal,
        position=position,
        attitude=attitude,
        flight_yaw_deg=read_flight_yaw(header.xmp),
        flight_tilt_deg=read_flight_tilt(header.xmp),
        time=read_time(header.exif, header.xmp),
        orientation_tag=int(header.exif.number(tag.ORIENTATION) or 1),
        rolling_shutter=rolling,
        shutter=find_shutter(header.exif.text(tag.MODEL), lens.captured_mp, rolling),
        velocity_ned=read_velocity(header.xmp),
        editor=find_editor(header.exif, header.xmp),
        notes=tuple(n for n in (*_broken_notes(header), *seen, *_other_notes(header, lens)) if n),
    )


def _lens(header: Header, width: int, height: int, *, thermal: bool) -> _Lens:
    exif = header.exif
    scale, note = native_scale(exif, width, height)
    sensor = find_sensor(model=exif.text(tag.MODEL), long_side=round(max(width, height) / scale))
    thermal = thermal or (sensor is not None and sensor.band == "thermal") or _is_lwir(header)
    calibration = read_calibration(
        exif=exif, xmp=header.xmp, sensor=sensor, width=width, height=height, scale=scale
    )
    focal = find_focal(
        exif=exif,
        sensor=sensor,
        calibration=calibration,
        width=width,
        height=height,
        thermal=thermal,
    )
    notes = (note, *focal_notes(exif, sensor, width, height))
    return _Lens(
        sensor=sensor,
        thermal=thermal,
        calibration=calibration,
        focal=focal,
        captured_mp=width * height / scale**2 / 1e6,
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
        or (said is None and header.width > _LARGEST_THERMAL)
    ):
        return None
    stored = cast(Stored, said) if said not in (None, "auto") else _stated(header)
    sensor = find_sensor(
        model=header.exif.text(tag.MODEL), long_side=max(header.width, header.height)
    )
    known = said is not None or bool(stored) or _is_lwir(header)
    known = known or (sensor is not None and sensor.band == "thermal")
    if not known and header.dtype != "float32":
        return None
    try:
        frame = thermal_frame_of_values(np.asarray(read_tiff(path)[..., 0]), stored)
    except Exception as error:  # tifffile raises many exceptions; all mean: no pixels
        raise UnreadablePhotoError(f"its pixels cannot be decoded ({error})") from error
    return frame if known or frame.unit == "celsius" else None


def _stated(header: Header) -> Stored:
    return stated_unit(f"{header.exif.text(tag.DESCRIPTION)} {header.exif.text(tag.GDAL_METADATA)}")


def _is_lwir(header: Header) -> bool:
    return "lwir" in header.xmp.text("Camera:BandName").lower()


def _camera_key(header: Header, width: int, height: int) -> str:
    exif, xmp = header.exif, header.xmp
    mm = exif.number(tag.FOCAL_MM)
    make, model = exif.text(tag.MAKE) or "unknown", exif.text(tag.MODEL) or "camera"
    parts = (
        "" if model.lower().startswith(make.lower()) else make,
        model,
        exif.text(tag.SERIAL) or xmp.text("CameraSerialNumber", "drone-dji:DroneSerialNumber"),
        exif.text(tag.LENS),
        xmp.text("Camera:BandName"),
        f"{width}x{height}",
        f"{mm:.1f}mm" if mm else "",
    )
    return " ".join(" ".join(p.lower().split()) for p in parts if p)


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


def _other_notes(header: Header, lens: _Lens) -> tuple[str, ...]:
    time = read_time(header.exif, header.xmp)
    guess = _focal_note(lens.focal.source, header.exif.text(tag.MODEL))
    return "" if time else "It has no capture time.", guess, _edit_note(header)


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
