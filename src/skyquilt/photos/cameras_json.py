"""Reads `cameras.json` as OpenDroneMap and OpenSfM write it."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from skyquilt.errors import SideFileError
from skyquilt.geometry.camera_formats import camera_from_opensfm
from skyquilt.model.camera import Camera
from skyquilt.model.photo import Focal, Photo
from skyquilt.outside import plain
from skyquilt.photos.side_rows import read_text, sentence_of

_SIGMA_SHARE = 0.01


def read_cameras_json(path: Path) -> dict[str, Camera]:
    """Cameras by the file's own keys; raises `SideFileError`."""
    try:
        records = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise SideFileError(
            f"{path.name} is not JSON ({plain(str(error), 200)}). Use the file as it was written."
        ) from error
    if (
        not isinstance(records, dict)
        or not records
        or not all(isinstance(r, dict) for r in records.values())
    ):
        raise SideFileError(f"{path.name} should hold cameras by name, as OpenDroneMap writes it.")
    try:
        return {key: camera_from_opensfm(record) for key, record in records.items()}
    except (ValueError, TypeError) as error:
        raise SideFileError(
            f"{path.name}: a camera cannot be used: {plain(str(error), 200)}."
        ) from error


def apply_cameras(
    photos: Sequence[Photo], cameras: Mapping[str, Camera], *, file: Path
) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """The photos with the calibrations that fit them, and notes; raises `SideFileError` where no
    calibration fits.
    """
    fitting = {p.camera_key: _fitting(p, cameras) for p in photos}
    if not any(fitting.values()):
        raise SideFileError(
            f"{file.name} has cameras {plain(sentence_of(list(cameras)), 400)}; the photos are by"
            f" {sentence_of(list(fitting))}."
            " "
            "Rename a camera to 'all', or provide a calibration of this camera."
        )
    without = [key for key, camera in fitting.items() if camera is None]
    notes = (f"{file.name} has no calibration for {', '.join(without)}.",) if without else ()
    return tuple(_calibrated(p, fitting[p.camera_key]) for p in photos), notes


def _fitting(photo: Photo, cameras: Mapping[str, Camera]) -> Camera | None:
    """The camera with the photo's key, else one whose key contains all words of the photo's model
    name, else `all` or the only one.
    """
    exact = [c for key, c in cameras.items() if key == photo.camera_key]
    words = set(re.split(r"[\s_]+", photo.camera_key.lower().rpartition(f" {photo.width}x")[0]))
    similar = [
        c for key, c in cameras.items() if words and words <= set(re.split(r"[\s_]+", key.lower()))
    ]
    generic = [c for key, c in cameras.items() if key == "all" or len(cameras) == 1]
    shape = photo.width / photo.height
    return next(
        (c for c in (*exact, *similar, *generic) if abs(c.width / c.height / shape - 1) < 0.02),
        None,
    )


def _calibrated(photo: Photo, camera: Camera | None) -> Photo:
    if camera is None:
        return photo
    own = camera.rescaled(photo.width, photo.height)
    sigma = own.sigmas[0] if own.sigmas else _SIGMA_SHARE * own.focal
    notes = tuple(n for n in photo.notes if "focal length" not in n)
    focal = Focal(px=own.focal, sigma_px=sigma, source="calibrated")
    return replace(photo, calibration=own, unusable_calibration="", focal=focal, notes=notes)
