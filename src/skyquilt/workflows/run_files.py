"""The small files of a run, in the formats of OpenDroneMap and OpenSfM."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from skyquilt.geometry.camera_formats import camera_to_opensfm
from skyquilt.geometry.frames import angles_from_cam_R_map, rotation_from_vector
from skyquilt.imaging.nodes import View
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Pose
from skyquilt.raster import vector
from skyquilt.raster.atomic import write_text
from skyquilt.version import __version__

MOST_POINTS = 20000
"""Tie points written to reconstruction.json."""


def rotation_vector(R: NDArray[Any]) -> list[float]:
    """Rotation vector: axis times angle in rad."""
    return [float(v) for v in cv2.Rodrigues(R)[0].ravel()]


def in_crs(alignment: Alignment, xyz: NDArray[Any]) -> NDArray[np.float64]:
    """Map coordinates (..., 3) in the output CRS."""
    return np.asarray(np.asarray(xyz) + np.array([*alignment.frame.origin, 0.0]))


def write_cameras(path: Path, alignment: Alignment) -> None:
    """cameras.json: calibrations by camera."""
    used = {alignment.camera_of[i] for i in alignment.poses}
    records = {
        key: camera_to_opensfm(replace(alignment.cameras[key], sigmas=None)) for key in sorted(used)
    }
    write_text(path, json.dumps(records, indent=1))


def seconds_of(time: datetime | None) -> float | None:
    """Seconds since 1970 as OpenSfM counts them: a time without an offset is taken as UTC, so that
    it does not depend on the machine.
    """
    if time is None:
        return None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def shot_properties(
    photo: Photo, alignment: Alignment, i: int, block: int, tie_points: int
) -> dict[str, Any]:
    """The properties of a photo in shots.geojson."""
    pose, camera = alignment.poses[i], alignment.camera(i)
    yaw, pitch, roll = angles_from_cam_R_map(pose.cam_R_map)
    return {
        "filename": photo.name,
        "digest": photo.digest,
        "camera": alignment.camera_of[i],
        "focal": camera.focal / max(photo.width, photo.height),
        "width": photo.width,
        "height": photo.height,
        "capture_time": seconds_of(photo.time),
        "translation": [float(v) for v in in_crs(alignment, pose.map_C)],
        "rotation": rotation_vector(pose.cam_R_map),
        **_motion(pose),
        "yaw": round((yaw + alignment.frame.convergence_deg) % 360, 3),
        "pitch": round(pitch, 3),
        "roll": round(roll, 3),
        "block": block,
        "tie_points": tie_points,
    }


def _motion(pose: Pose) -> dict[str, list[float]]:
    """How the camera moved while its rows were read out: metres (east, north, up), and radians
    about its axes; nothing where it did not.
    """
    if pose.motion is None:
        return {}
    return {
        "readout_shift": [float(v) for v in pose.motion.shift_m],
        "readout_turn": [float(v) for v in pose.motion.turn_rad],
    }


def write_shots(
    path: Path, photos: Sequence[Photo], alignment: Alignment, order: Sequence[int]
) -> None:
    """shots.geojson: a point per photo; the k-th feature is number k in provenance.tif."""
    number = np.bincount(alignment.ties.photo, minlength=len(photos)).tolist()
    block = {i: k for k, b in enumerate(alignment.blocks) for i in b}
    features = [
        (
            in_crs(alignment, alignment.poses[i].map_C),
            shot_properties(photos[i], alignment, i, block.get(i, -1), number[i]),
        )
        for i in order
    ]
    vector.points(path, features, crs=alignment.frame.crs)


def write_footprints(
    path: Path, photos: Sequence[Photo], alignment: Alignment, views: Sequence[View]
) -> None:
    """footprints.geojson: the ground covered by each photo."""
    x, y = alignment.frame.origin
    features = [
        ([v.footprint + np.array([x, y])], {"filename": photos[v.photo].name}) for v in views
    ]
    vector.polygons(path, features, crs=alignment.frame.crs)


def write_reconstruction(
    path: Path, photos: Sequence[Photo], alignment: Alignment, colours: NDArray[np.uint8]
) -> None:
    """reconstruction.json in the format of OpenSfM: topocentric east-north-up coordinates about
    `reference_lla`. `colours`: (P, 3) of the tie points.
    """
    enu = Topocentric(alignment)
    shots = {}
    for i, pose in sorted(alignment.poses.items()):
        R = pose.cam_R_map @ enu.map_R_enu
        C = enu(pose.map_C[None])[0]
        shots[photos[i].name] = {
            "camera": alignment.camera_of[i],
            "rotation": rotation_vector(R),
            "translation": [float(v) for v in -R @ C],
            "orientation": 1,
            "capture_time": seconds_of(photos[i].time) or 0.0,
            "gps_position": [float(v) for v in C],
            "gps_dop": 15.0,
        }
    chosen = np.linspace(
        0, len(alignment.ties.xyz) - 1, min(MOST_POINTS, len(alignment.ties.xyz))
    ).astype(int)
    coordinates = enu(alignment.ties.xyz[chosen]) if len(chosen) else np.zeros((0, 3))
    points = {
        str(k): {
            "coordinates": [round(float(v), 4) for v in c],
            "color": [float(v) for v in colours[k]],
        }
        for k, c in zip(chosen.tolist(), coordinates, strict=True)
    }
    used = {alignment.camera_of[i] for i in alignment.poses}
    record = {
        "cameras": {key: camera_to_opensfm(alignment.cameras[key]) for key in sorted(used)},
        "shots": shots,
        "points": points,
        "reference_lla": enu.reference,
        "vertical_datum": alignment.frame.vertical_datum,
        "biases": {},
        "rig_cameras": {},
        "rig_instances": {},
    }
    write_text(path, json.dumps([record]))


class Topocentric:
    """Conversion from the map frame to east-north-up coordinates about the frame's origin."""

    def __init__(self, alignment: Alignment) -> None:
        frame = alignment.frame
        self.alignment, self.reference = (
            alignment,
            {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0},
        )
        self.map_R_enu = np.eye(3)
        self._to_ecef: Transformer | None = None
        if frame.crs is None:
            return
        self._to_wgs = Transformer.from_crs(frame.crs, 4326, always_xy=True)
        self._to_ecef = Transformer.from_crs(4979, 4978, always_xy=True)
        lon, lat = self._to_wgs.transform(*frame.origin)
        self.reference = {"latitude": lat, "longitude": lon, "altitude": 0.0}
        a, b = np.radians([lon, lat])
        self._east_north_up = np.array(
            [
                [-np.sin(a), np.cos(a), 0],
                [-np.sin(b) * np.cos(a), -np.sin(b) * np.sin(a), np.cos(b)],
                [np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)],
            ]
        )
        self._origin = np.array(self._to_ecef.transform(lon, lat, 0.0))
        # grid north is `convergence` clockwise from true north
        self.map_R_enu = rotation_from_vector(
            np.array([0.0, 0.0, np.radians(frame.convergence_deg)])
        )

    def __call__(self, xyz: NDArray[Any]) -> NDArray[np.float64]:
        """East, north, up (N, 3) in m of map coordinates (N, 3)."""
        if self._to_ecef is None:
            return np.asarray(xyz)
        place = in_crs(self.alignment, xyz)
        lon, lat = self._to_wgs.transform(place[:, 0], place[:, 1])
        ecef = np.column_stack(self._to_ecef.transform(lon, lat, place[:, 2]))
        return np.asarray((ecef - self._origin) @ self._east_north_up.T)


def write_run(
    path: Path, settings: Mapping[str, Any], photos: str, commit: str | None, method: str
) -> None:
    """run.toml: the settings and the version of the program."""
    about = {
        "version": __version__,
        "commit": commit or "unknown",
        "photos": photos,
        "method_used": method,
    }
    lines = [f"{key} = {_toml(value)}" for key, value in about.items()]
    lines += ["", "[settings]", *(f"{key} = {_toml(value)}" for key, value in settings.items())]
    write_text(path, "\n".join(lines) + "\n")


def _toml(value: Any) -> str:
    """Formats a value as TOML. Its JSON form is valid TOML except for characters beyond 16 bits,
    lone surrogates (undecodable file names) and DEL.
    """
    text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return text.encode("utf-8", "replace").decode()


def source_commit() -> str | None:
    """The commit of the source this runs from, read from git's files; None for an installed
    package.
    """
    for folder in Path(__file__).resolve().parents:
        head = folder / ".git" / "HEAD"
        if head.is_file():
            try:
                text = head.read_text("utf-8").strip()
                if not text.startswith("ref: "):
                    return text
                ref = folder / ".git" / text.removeprefix("ref: ")
                return ref.read_text("utf-8").strip() if ref.is_file() else None
            except OSError:
                return None
    return None
