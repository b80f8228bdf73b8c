"""`hybrid`: every photo is placed by metadata and corrected by image correlation within its error
range (Y 4.1.2, 6.1.3).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.imaging.plane import Overview, Patch, to_grid
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Join, Pose, Prior
from skyquilt.papers.hybrid_objective import Distances, Objective, pyramid
from skyquilt.papers.hybrid_search import Optimiser
from skyquilt.papers.pieces import map_H_cam_of

Array = NDArray[np.float64]
GreyPicture = Callable[[int, int], NDArray[np.uint8]]
"""Gives the grey image of a photo (index), with at most the given px on its longest side."""
NEIGHBOURS = 4
"""Number of nearest placed photos whose distances are compared."""


@dataclass(frozen=True, kw_only=True)
class Hybrid:
    """In order of capture, each photo is shifted and rotated to the maximum of lambda, and then
    fixed.
    """

    optimise: Optimiser
    """How lambda is maximised."""
    alpha: float = 0.5
    """Weight of distances against image correlation."""
    across: int = 400
    """Width in px of a photo on the finest level (the thesis's scale)."""
    deviations: float = 2.0
    """Search range in standard deviations of position, tilt and heading."""
    seed: int = 0
    """Seed of the annealing."""
    version: ClassVar[int] = 1
    name: ClassVar[str] = "hybrid"

    def __call__(
        self,
        placed: Alignment,
        photos: Sequence[Photo],
        priors: Sequence[Prior],
        order: Sequence[int],
        grey: GreyPicture,
    ) -> Alignment:
        """Corrects an alignment by metadata; photos are processed in the given order (indices)."""
        order = [i for i in order if i in placed.poses]
        gsd = self._gsd(placed)
        overview = Overview()
        done: dict[int, Pose] = {}
        joins = []
        for photo in order:
            pose = placed.poses[photo]
            if done:
                join, pose = self._moved(photo, placed, priors[photo], done, overview, gsd, grey)
                joins += [join] if join else []
            done[photo] = pose
            patch = self._patch(photo, pose, placed, gsd, grey)
            if patch is not None:
                overview.merge(patch)
        return replace(
            placed, method=self.name, poses=done, blocks=(tuple(sorted(done)),), joins=tuple(joins)
        )

    def reach(self, prior: Prior, height_m: float) -> tuple[float, float]:
        """Error range of a photo: m on the ground, GPS error plus tan(tilt) times height (Y Fig.
        4.2), and degrees.
        """
        k = self.deviations
        sigma = float(prior.sigma_C[0]) if np.isfinite(prior.sigma_C[0]) else 0.25 * height_m
        tilt = np.tan(np.radians(min(k * prior.sigma_tilt_deg, 60.0)))
        return k * sigma + float(tilt) * height_m, float(
            np.clip(k * prior.sigma_yaw_deg, 1.0, 45.0)
        )

    def _gsd(self, placed: Alignment) -> float:
        """Ground size in m of the overview's pixels: photos `across` px wide."""
        sizes = [
            p.map_C[2] * placed.camera(i).width / placed.camera(i).focal
            for i, p in placed.poses.items()
        ]
        return float(np.median(sizes)) / self.across

    def _patch(
        self, photo: int, pose: Pose, placed: Alignment, gsd: float, grey: GreyPicture
    ) -> Patch | None:
        """The photo on the overview's grid (column = east / gsd, row = -north / gsd)."""
        camera = placed.camera(photo)
        cam_H_grid = np.linalg.inv(map_H_cam_of(pose)) @ np.diag([gsd, -gsd, 1.0])
        return to_grid(grey(photo, int(1.25 * self.across)), camera, cam_H_grid)

    def _moved(
        self,
        photo: int,
        placed: Alignment,
        prior: Prior,
        done: dict[int, Pose],
        overview: Overview,
        gsd: float,
        grey: GreyPicture,
    ) -> tuple[Join | None, Pose]:
        """Moves the photo to the maximum of lambda."""
        pose = placed.poses[photo]
        patch = self._patch(photo, pose, placed, gsd, grey)
        if patch is None:
            return None, pose
        reach_m, turn_deg = self.reach(prior, float(pose.map_C[2]))
        nadir = pose.map_C[:2]
        levels = pyramid(patch, overview, gsd, reach_m, np.array([nadir[0], -nadir[1]]) / gsd)
        objective = Objective(
            levels=levels, distances=distances(nadir, placed, done), nadir=nadir, alpha=self.alpha
        )
        if (
            not np.isfinite(objective.levels[-1].correlation(np.zeros(3)))
            and not levels[-1].filled.any()
        ):
            return None, pose
        best = self.optimise(objective, reach_m, turn_deg, self.seed + photo)
        moved = turned(pose, best.move)
        return Join(
            photo=photo,
            onto=-1,
            matches=0,
            inliers=0,
            ste_px2=np.nan,
            score=best.quality,
            moved_m=float(np.hypot(*best.move[:2])),
            px=np.zeros((0, 2)),
            d_px=np.zeros((0, 2)),
            levelled=np.zeros(0, bool),
        ), moved


def distances(nadir: Array, placed: Alignment, done: dict[int, Pose]) -> Distances:
    """Measured distances to the nearest photos already placed, and their current positions."""
    index = np.array(list(done))
    reported = np.array([placed.poses[i].map_C[:2] for i in index])
    d = np.linalg.norm(reported - nadir, axis=1)
    near = np.argsort(d, kind="stable")[:NEIGHBOURS]
    now = np.array([done[i].map_C[:2] for i in index[near]])
    height = float(np.median([done[i].map_C[2] for i in index[near]]))
    return Distances(reported=d[near], placed=now, weight=(d[near] > 0.02 * height).astype(float))


def turned(pose: Pose, move: Array) -> Pose:
    """The pose shifted east and north in m and rotated clockwise in degrees about the vertical."""
    turn = rotation_from_vector(np.array([0.0, 0.0, -np.radians(move[2])]))
    return Pose(
        cam_R_map=pose.cam_R_map @ turn.T, map_C=pose.map_C + np.array([move[0], move[1], 0.0])
    )
