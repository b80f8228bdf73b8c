"""Writes the truth: `truth.json` and the true rasters."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin
from rasterio.windows import Window

from skyquilt.simulate.camera import Lens
from skyquilt.simulate.control import Observation, Surveyed
from skyquilt.simulate.expose import footprint
from skyquilt.simulate.flight import Shot
from skyquilt.simulate.grid import Grid
from skyquilt.simulate.multispectral import WAVELENGTHS, reflectance, rig_of
from skyquilt.simulate.reported import Place, Report, Start
from skyquilt.simulate.scene import Scene
from skyquilt.simulate.settings import FlightSettings

_HALF_TURN = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Taken:
    """A photo with its true pose, its metadata and its exposure."""

    shot: Shot
    """The true pose."""
    report: Report
    """The metadata."""
    band: str
    """`visible`, `thermal` or the name of a multispectral camera's band."""
    file: str
    """Path below the output folder."""
    exposure: float
    """Brightness factor (visible), offset in K (thermal), or exposure time in s (bands)."""
    blurred: bool = False
    """Whether a shake of the camera spoilt it."""


@dataclass(frozen=True, kw_only=True)
class TakenClip:
    """A clip with the truth of each frame."""

    file: str
    """Path below the output folder."""
    fps: float
    """Frames per second."""
    frames: Sequence[Taken]
    """In order of time."""
    blurred: Sequence[bool]
    """Whether a gust blurred the frame."""


def write_truth(
    path: Path,
    settings: FlightSettings,
    place: Place,
    start: Start,
    taken: Sequence[Taken],
    points: Sequence[Surveyed],
    seen: Sequence[Observation],
    clips: Sequence["TakenClip"] = (),
) -> None:
    """Writes `truth.json`: everything that is needed to check an adjustment."""
    lenses = {"visible": settings.lens}
    if settings.thermal is not None:
        lenses["thermal"] = settings.thermal.lens
    if settings.multispectral is not None:
        rig = rig_of(settings.multispectral, settings.lens, settings.seed)
        lenses |= {band.name: band.lens for band in rig}
    cameras = {name: _camera(lens) for name, lens in lenses.items()}
    cameras |= {f"{name}-turned": _camera(lens.turned()) for name, lens in lenses.items()}
    document = {
        "crs": place.crs,
        "origin": [place.easting, place.northing],
        "vertical": {
            "datum": "sea_level",
            "takeoff_m": round(start.base + start.takeoff, 4),
            "note": "all heights here are above the sea; surface and control points too",
        },
        "meridian_convergence_deg": place.convergence,
        "gsd_m": settings.resolution,
        "conventions": "pixel centres at integers; OpenCV distortion; x_cam = cam_R_map (x_map -"
        " position)",
        "start": settings.weather.moment.isoformat(),
        "seed": settings.seed,
        "settings": asdict(settings),
        "cameras": cameras,
        "photos": [_photo(t, place, start) for t in taken],
        "control_points": [_point(p, seen) for p in points],
        "clips": [
            {
                "file": clip.file,
                "fps": clip.fps,
                "frames": [
                    {**_photo(t, place, start), "name": t.shot.name, "blurred": blurred}
                    for t, blurred in zip(clip.frames, clip.blurred, strict=True)
                ],
            }
            for clip in clips
        ],
    }
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _camera(lens: Lens) -> dict[str, float]:
    lengths = ("width", "height", "focal", "cx", "cy", "aspect")
    names = (*lengths, "k1", "k2", "k3", "p1", "p2", "readout", "fisheye")
    return {name: getattr(lens, name) for name in names}


def _photo(taken: Taken, place: Place, start: Start) -> dict[str, Any]:
    shot, report = taken.shot, taken.report
    x, y, z = shot.centre
    rotation = _HALF_TURN @ shot.rotation if report.turned else shot.rotation
    return {
        "name": Path(taken.file).name,
        "file": taken.file,
        "band": taken.band,
        "camera": taken.band + ("-turned" if report.turned else ""),
        "drone": shot.waypoint.drone,
        "line": shot.waypoint.line,
        "point": shot.waypoint.point,
        "blurred": taken.blurred,
        "time_s": round(shot.waypoint.time, 3),
        "position": [place.easting + x, place.northing + y, start.base + z],
        "cam_R_map": rotation.tolist(),
        "yaw_deg": shot.yaw,
        "pitch_deg": shot.pitch,
        "roll_deg": shot.roll,
        "velocity_ms": list(shot.velocity),
        "spin_deg_s": list(shot.spin),
        "turned": report.turned,
        "exposure": taken.exposure,
        "lies": list(report.lies),
        "reported": asdict(report),
    }


def _point(point: Surveyed, seen: Sequence[Observation]) -> dict[str, Any]:
    target = point.target
    return {
        "name": target.name,
        "check": target.check,
        "true": list(point.true),
        "measured": list(point.measured),
        "sightings": {s.photo: [s.x, s.y] for s in seen if s.point == target.name},
    }


def covered(grid: Grid, lens: Lens, shots: Sequence[Shot], level: float) -> Grid:
    """The part of the scene's grid that is covered by the footprints at a level (above the
    base).
    """
    ground = grid.pixels(np.concatenate([footprint(lens, shot, level) for shot in shots]))
    low, high = np.floor(ground.min(axis=0)).astype(int), np.ceil(ground.max(axis=0)).astype(int)
    return grid.window(low[1], low[0], high[1] - low[1] + 1, high[0] - low[0] + 1)


def write_raster(
    path: Path, raster: NDArray[Any], part: Grid, place: Place, *, add: float = 0.0, **tags: str
) -> None:
    """Writes a tiled GeoTIFF of a part of a scene's raster (h, w) or (h, w, bands), in strips."""
    bands = 1 if raster.ndim == 2 else raster.shape[2]
    corner = (
        place.easting + part.left + part.col * part.res,
        place.northing + part.top - part.row * part.res,
    )
    profile = {
        "driver": "GTiff",
        "width": part.width,
        "height": part.height,
        "count": bands,
        "dtype": raster.dtype.name,
        "crs": place.crs,
        "transform": from_origin(*corner, part.res, part.res),
        "tiled": True,
        "blockxsize": 512,
        "blockysize": 512,
        "compress": "deflate",
        "zlevel": 1,
        "predictor": 3 if raster.dtype.kind == "f" else 2,
        "bigtiff": "if_safer",
    }
    if bands == 3:
        profile |= {"photometric": "rgb", "interleave": "pixel"}
    with rasterio.open(path, "w", **profile) as target:
        target.update_tags(**tags)
        for row in range(0, part.height, 512):
            strip = part.window(row, 0, 512, part.width)
            values = raster[strip.slices] + raster.dtype.type(add) if add else raster[strip.slices]
            where = Window(0, row, strip.width, strip.height)
            target.write(values[None] if bands == 1 else np.moveaxis(values, 2, 0), window=where)


def write_rasters(folder: Path, scene: Scene, part: Grid, place: Place, base: float) -> None:
    """Writes the true orthophoto and the true surface."""
    write_raster(folder / "truth_ortho.tif", scene.rgb, part, place)
    write_raster(
        folder / "truth_surface.tif",
        scene.height,
        part,
        place,
        add=base,
        VERTICAL_DATUM="sea level",
        UNIT="m",
    )


def write_bands(folder: Path, scene: Scene, part: Grid, place: Place) -> None:
    """Writes the true reflectance of each band, in thousandths."""
    rgb = scene.rgb[part.slices]
    whole = np.zeros((part.height, part.width, len(WAVELENGTHS)), np.uint16)
    for row in range(0, part.height, 512):
        seen = rgb[row : row + 512].astype(np.float32)
        for k, name in enumerate(WAVELENGTHS):
            whole[row : row + 512, :, k] = np.rint(1000 * reflectance(seen, name))
    corner = replace(part, left=part.left + part.col * part.res, top=part.top - part.row * part.res)
    at = replace(corner, row=0, col=0)
    write_raster(folder / "truth_bands.tif", whole, at, place, BANDS=" ".join(WAVELENGTHS))


def write_thermal(folder: Path, scene: Scene, part: Grid, place: Place) -> None:
    """Writes the true temperatures as a raster of hundredths of a kelvin."""
    if scene.thermal is not None:
        write_raster(folder / "truth_thermal.tif", scene.thermal, part, place, UNIT="centikelvin")
