"""Predicts the positions of the keypoints of one photo in another from the metadata of both."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.pose import ByPose
from skyquilt.engine.store import digest
from skyquilt.imaging.views import View, make_views, on_ground, project_nodes
from skyquilt.model.photo import Photo
from skyquilt.model.poses import MapFrame, Prior
from skyquilt.ortho.tie_surface import level


class ExpectedPlaces:
    """Photos projected to level ground by their reported poses."""

    def __init__(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        height_m: float | None = None,
    ) -> None:
        """Places the photos; `height_m`: height above ground if the altitudes do not give it.

        Raises:
            AlignmentError: no photo has a position, a heading and a height above ground.
        """
        self.key = digest(frame, list(priors), [(p.camera_key, p.focal.px) for p in photos])
        self._ground = level(0.0)
        placed = ByPose(height_m=height_m)(photos, frame, priors)
        self._views: dict[int, View] = {v.photo: v for v in make_views(placed, self._ground)}

    def __call__(self, a: int, b: int, px: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 2) px of photo b for px (n, 2) of photo a; NaN where metadata do not place both."""
        if a not in self._views or b not in self._views:
            return np.full((len(px), 2), np.nan)
        xyz = on_ground(self._views[a], px, self._ground)
        nodes = project_nodes(self._views[b], xyz[None, :, 0], xyz[None, :, 1], xyz[None, :, 2])
        places = np.stack([nodes.u[0], nodes.v[0]], -1).astype(np.float64)
        return np.where((np.abs(places) < 1e6).all(1, keepdims=True), places, np.nan)
