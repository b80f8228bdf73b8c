"""Where the photos of a growing map show a place: poses, cameras and heights as they are now."""

import json

import numpy as np

from skyquilt.errors import UnreadablePhotoError
from skyquilt.live.ledger import DAMAGED
from skyquilt.live.members import camera_from, pose_from
from skyquilt.model.camera import Camera
from skyquilt.model.photo import Photo
from skyquilt.ortho.height_cells import HeightCells
from skyquilt.photos.read import read_photo
from skyquilt.server.projection import Xyz, pixel_of
from skyquilt.server.survey import LiveSurvey

NEAR = 40
"""Height cells about a place that are read, on each side."""


class LiveProjection:
    """Projects places into the photos of a live survey; everything is read anew each time, since
    poses change while photos arrive.
    """

    def __init__(self, survey: LiveSurvey) -> None:
        self.survey, self.ledger = survey, survey.ledger

    def pixel(self, number: int, x: float, y: float) -> tuple[tuple[float, float], Camera] | None:
        """The pixel at which a photo shows a place (map's projection, m) on the ground, and its
        camera; None if it does not show it, or has no pose yet.

        Raises:
            UnreadablePhotoError: its file is gone.
        """
        row = self.ledger.row("select pose, camera from photo where id = ?", number)
        frame = self.ledger.meta("frame")
        if row is None or not row[0] or not frame:
            return None
        place = self._on_ground(x - frame["origin"][0], y - frame["origin"][1])
        camera = self._camera(number, str(row[1] or ""))
        try:
            pose = pose_from(json.loads(row[0]))
        except DAMAGED as error:
            raise UnreadablePhotoError("what is stored of it is damaged") from error
        px = pixel_of(pose, camera, place)
        return None if px is None else (px, camera)

    def _camera(self, number: int, name: str) -> Camera:
        """The calibration of a photo: the map's, otherwise that of its metadata."""
        shown = self.survey.photo(number)
        photo = None if shown is None or shown.path is None else read_photo(shown.path)
        if not isinstance(photo, Photo):
            raise UnreadablePhotoError("its file cannot be read")
        for key in (name, photo.camera_key):
            found = self.ledger.row("select body from camera where key = ?", key)
            if found and (camera := camera_from(found[0])):
                return camera
        return photo.lens

    def _on_ground(self, x: float, y: float) -> Xyz:
        """A place (map frame, m) with the height of the ground."""
        cells = HeightCells(cell=float(self.ledger.meta("cell", 2.0)))
        c, r = (int(np.floor(v / cells.cell)) for v in (x, y))
        near = (c - NEAR, c + NEAR, r - NEAR, r + NEAR)
        query = "select col, row, z from height where col between ? and ? and row between ? and ?"
        known = np.array(self.ledger.rows(query, *near), np.float64).reshape(-1, 3)
        cells.put(known[:, :2].astype(np.int64), known[:, 2])
        bounds = (x - cells.cell, y - cells.cell, x + cells.cell, y + cells.cell)
        surface = cells.surface(bounds, float(self.ledger.meta("ground", 0.0)))
        return x, y, float(surface.at(np.array([x]), np.array([y]))[0])
