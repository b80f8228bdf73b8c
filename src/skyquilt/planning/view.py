"""The camera of a plan: by the name of a model, a calibration, or a photo."""

import csv
from importlib.resources import files
from pathlib import Path

import numpy as np

from skyquilt.errors import UsageError
from skyquilt.geometry.camera import undistort
from skyquilt.model.camera import Camera
from skyquilt.model.photo import RejectedPhoto
from skyquilt.outside import is_file, plain
from skyquilt.photos.cameras_json import read_cameras_json
from skyquilt.photos.lens import find_sensor
from skyquilt.photos.read import read_photo
from skyquilt.planning.records import View

SIZES = "picture_sizes.csv"
"""Pixels of full-size still pictures of the models in the sensor table."""


def find_view(text: str) -> View:
    """The view of a camera given as a model of the sensor table (`FC6310`), as a `cameras.json`, or
    as a photo taken with it.

    Raises:
        UsageError: it is none of these, or its focal length is not known.
        SideFileError: the calibrations cannot be read.
    """
    path = Path(text)
    if path.suffix.lower() == ".json":
        name, camera = next(iter(read_cameras_json(path).items()))
        return view_of(camera, name)
    if is_file(path):
        return _of_photo(path)
    return _of_model(text)


def _of_photo(path: Path) -> View:
    photo = read_photo(path)
    if isinstance(photo, RejectedPhoto):
        raise UsageError(f"--camera: {photo.name} cannot be used: {photo.reason}")
    if photo.focal.source == "guess":
        raise UsageError(
            f"--camera: nothing in {photo.name} tells its focal length; give a cameras.json"
        )
    camera = photo.calibration or ideal(photo.width, photo.height, photo.focal.px)
    return view_of(camera, photo.camera_key)


def _of_model(text: str) -> View:
    size = _sizes().get(text.strip().upper())
    sensor = find_sensor(model=text, long_side=size[0] if size else 0)
    if size is None or sensor is None or sensor.focal_mm is None:
        raise UsageError(
            f"--camera: no camera '{plain(text, 60)}' is known; give a model such as FC6310, a"
            " cameras.json, or a photo taken with it"
        )
    focal = sensor.focal_mm / sensor.width_mm * size[0]
    return view_of(ideal(*size, focal), text.strip().upper())


def _sizes() -> dict[str, tuple[int, int]]:
    text = files("skyquilt.planning").joinpath(SIZES).read_text("utf-8")
    return {
        row["model"]: (int(row["width"]), int(row["height"]))
        for row in csv.DictReader(text.splitlines())
    }


def ideal(width: int, height: int, focal: float) -> Camera:
    """A camera without distortion."""
    return Camera(width=width, height=height, focal=focal, cx=(width - 1) / 2, cy=(height - 1) / 2)


def view_of(camera: Camera, name: str) -> View:
    """The largest upright rectangle inside the undistorted picture, as tangents."""
    w, h = camera.width, camera.height
    x, y = np.linspace(-0.5, w - 0.5, 65), np.linspace(-0.5, h - 0.5, 65)
    sides = [
        np.column_stack([np.full_like(y, -0.5), y]),
        np.column_stack([np.full_like(y, w - 0.5), y]),
        np.column_stack([x, np.full_like(x, -0.5)]),
        np.column_stack([x, np.full_like(x, h - 0.5)]),
    ]
    left, right, top, bottom = (undistort(camera, side) for side in sides)
    found = View(
        name=plain(name, 120),
        width=w,
        height=h,
        focal=camera.focal,
        left=float(-left[:, 0].max()),
        right=float(right[:, 0].min()),
        up=float(-top[:, 1].max()),
        down=float(bottom[:, 1].min()),
    )
    tangents = np.array([found.left, found.right, found.up, found.down])
    if not (np.isfinite(tangents).all() and tangents.min() > 0.005 and tangents.max() < 3):
        raise UsageError(f"--camera: {found.name} has an angle of view that cannot be meant")
    return found


def narrowest(views: list[View]) -> View:
    """What every one of several cameras sees, with the pixels of the coarsest: points planned for
    it suit all.
    """
    coarse = min(views, key=lambda v: v.focal)
    return View(
        name=" + ".join(sorted({v.name for v in views})),
        width=coarse.width,
        height=coarse.height,
        focal=coarse.focal,
        left=min(v.left for v in views),
        right=min(v.right for v in views),
        up=min(v.up for v in views),
        down=min(v.down for v in views),
    )
