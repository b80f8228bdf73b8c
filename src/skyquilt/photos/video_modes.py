"""Focal length and shutter of a clip as the tables of cameras and video modes tell.

What a video mode cuts off the sensor is in no file: published calibrations of some modes are in
`video_modes.csv`, each with its source. For other clips the focal length comes from the telemetry's
35 mm equivalent, from the sensor table, or it is guessed, and the adjustment finds the rest.
"""

import csv
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

from skyquilt.model.clip import Clip
from skyquilt.model.photo import Focal, Shutter
from skyquilt.photos.capture import find_shutter, plain_model
from skyquilt.photos.lens import find_sensor

_SENSOR_SIGMA = 0.10
"""Of a focal length from the sensor: modes cut up to a fifth off the width."""
_READOUT_SIGMA = 0.25
"""Of a readout from the table of photos: modes skip or join rows."""
_PHOTO_TALL = 0.75
"""Height over width of a photo, whose rows the readout in the table is of."""
_MOST_READOUT = 0.9
"""Share of the time from frame to frame that a readout can take."""


@dataclass(frozen=True, kw_only=True)
class Mode:
    """One row of `video_modes.csv`."""

    width: int
    """In px."""
    height: int
    """In px."""
    equivalent_mm: float
    """35 mm equivalent that the telemetry states for the lens without zoom."""
    focal_per_width: float
    """Focal length over width."""
    sigma_per_width: float
    """Its standard deviation over width."""
    source: str
    """Where it was published."""


@cache
def _table() -> dict[str, tuple[Mode, ...]]:
    text = files("skyquilt.photos").joinpath("video_modes.csv").read_text("utf-8")
    table: dict[str, tuple[Mode, ...]] = {}
    for row in csv.DictReader(text.splitlines()):
        mode = Mode(
            width=int(row["width"]),
            height=int(row["height"]),
            equivalent_mm=float(row["equivalent_mm"]),
            focal_per_width=float(row["focal_per_width"]),
            sigma_per_width=float(row["sigma_per_width"]),
            source=row["source"],
        )
        for model in row["models"].split("|"):
            table[plain_model(model)] = (*table.get(plain_model(model), ()), mode)
    return table


def find_mode(model: str, width: int, height: int) -> Mode | None:
    """The row for a camera model, as EXIF or the container names it, and a size; None without."""
    modes = _table().get(plain_model(model), ())
    return next((m for m in modes if (m.width, m.height) == (width, height)), None)


def with_mode(clip: Clip) -> Clip:
    """The clip with the focal length and the shutter that the tables tell of its camera, and a note
    where they tell anything. What the tables do not know stays as the files tell it.
    """
    focal, why = _focal(clip)
    shutter = _shutter(clip)
    notes = list(clip.notes)
    if focal is not None:
        notes.append(
            f"Focal length of its video mode ({clip.model}, {clip.width}x{clip.height}):"
            f" {focal.px:.0f} +- {focal.sigma_px:.0f} px, from {why}."
        )
    if shutter is not None:
        notes.append(
            f"Readout of a frame: {1000 * shutter.readout_s:.0f} +- {1000 * shutter.sigma_s:.0f}"
            f" ms, from the time of a photo of {clip.model} and the rows of a frame."
        )
    return replace(
        clip, focal=focal or clip.focal, shutter=shutter or clip.shutter, notes=tuple(notes)
    )


def _focal(clip: Clip) -> tuple[Focal | None, str]:
    """The focal length from a table and which; None where the telemetry knows better or none does.

    A published mode comes first, scaled to the telemetry's equivalent where that differs: a lens
    that zooms.
    """
    long = max(clip.width, clip.height)
    told = clip.track.focal_35mm if clip.track else None
    zoom = clip.track.zoom if clip.track else 1.0
    mode = find_mode(clip.model, long, min(clip.width, clip.height))
    if mode is not None:
        zoomed = zoom * (told or mode.equivalent_mm) / mode.equivalent_mm
        px = mode.focal_per_width * long * zoomed
        sigma = px * mode.sigma_per_width / mode.focal_per_width
        return Focal(px=px, sigma_px=sigma, source="mode"), mode.source
    sensor = find_sensor(model=clip.model, long_side=long)
    if told is not None or sensor is None or sensor.focal_mm is None:
        return None, ""
    px = sensor.focal_mm / sensor.width_mm * long * zoom
    return Focal(px=px, sigma_px=_SENSOR_SIGMA * px, source="sensor"), "the sensor's full width"


def _shutter(clip: Clip) -> Shutter | None:
    """The readout of a frame from that of a photo: a wide frame has fewer rows."""
    found = find_shutter(clip.model, clip.width * clip.height / 1e6, None)
    if found.source != "table":
        return None
    tall = min(clip.width, clip.height) / max(clip.width, clip.height)
    readout = min(found.readout_s * min(tall / _PHOTO_TALL, 1.0), _MOST_READOUT / clip.fps)
    return Shutter(readout_s=readout, sigma_s=_READOUT_SIGMA * readout, source="table")
