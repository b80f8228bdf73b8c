"""`position` and `pose`: every photo is placed by its metadata (Y 4.1.2)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.start import OWN_ZERO, ground_of
from skyquilt.errors import AlignmentError
from skyquilt.geometry.frames import cam_R_map_from_angles, commonest_deg
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, MapFrame, Pose, Prior, no_ties


@dataclass(frozen=True, kw_only=True)
class ByMetadata:
    """Places photos by metadata alone; subclasses differ in the data that they use."""

    height_m: float | None = None
    """Height above ground in m if the altitudes do not give it; None = heights above take-off."""
    version: ClassVar[int] = 3
    name: ClassVar[str] = "pose"

    def __call__(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        heights_m: NDArray[np.float64] | None = None,
    ) -> Alignment:
        """Places all photos that have a position. A single photo without position is placed in a
        local frame.

        `heights_m` (n,): heights above ground that replace those of the metadata; NaN = use the
        metadata.

        Raises:
            AlignmentError: positions or the height above ground are missing.
        """
        rejected: dict[int, str] = {}
        poses: dict[int, Pose] = {}
        if len(photos) == 1 and frame.crs is None:
            poses[0] = Pose(
                cam_R_map=cam_R_map_from_angles(0.0),
                map_C=np.array([0.0, 0.0, self.height_m or 50.0]),
            )
        else:
            heights = self._heights(photos, frame, priors, heights_m)
            frame = on_ground(frame, priors, heights)
            poses, rejected = self._placed(photos, priors, heights)
            ground = np.array([0.0, 0.0, ground_of(frame)])
            poses = {i: replace(p, map_C=p.map_C + ground) for i, p in poses.items()}
        if not poses:
            raise AlignmentError(_nothing_placed(self.name, len(photos), rejected))
        return Alignment(
            method=self.name,
            why="",
            frame=replace(frame, metric=frame.crs is not None or self.height_m is not None),
            poses=poses,
            cameras={p.camera_key: p.lens for p in photos},
            camera_of={i: p.camera_key for i, p in enumerate(photos)},
            blocks=tuple((i,) for i in sorted(poses)),
            ties=no_ties(),
            rejected=rejected,
        )

    def _heights(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        known: NDArray[np.float64] | None,
    ) -> NDArray[np.float64]:
        """Camera heights (n,) in m above the ground, which is level."""
        if self.height_m is None and known is not None and np.isfinite(known).any():
            return np.where(np.isfinite(known), known, np.nanmedian(known))
        z = np.array([p.map_C[2] for p in priors])
        if self.height_m is not None:
            return (
                np.where(np.isfinite(z), self.height_m + z - np.nanmedian(z), self.height_m)
                if np.isfinite(z).any()
                else np.full(len(z), self.height_m)
            )
        if frame.vertical_datum != "takeoff":
            z = np.array([p.above_takeoff_m for p in photos], np.float64)  # NaN for None
        if frame.vertical_datum != "takeoff" and not np.isfinite(z).any():
            told = frame.vertical_datum != "unknown"
            given = (
                f"heights above {frame.vertical_datum.replace('_', ' ')}" if told else "no heights"
            )
            raise AlignmentError(
                f"method {self.name} needs heights above ground, and the photos contain {given};"
                " add --height METRES"
            )
        return np.where(np.isfinite(z), z, np.nanmedian(z) if np.isfinite(z).any() else np.nan)

    def _placed(
        self, photos: Sequence[Photo], priors: Sequence[Prior], heights: NDArray[np.float64]
    ) -> tuple[dict[int, Pose], dict[int, str]]:
        poses, rejected = {}, {}
        for i, prior in enumerate(priors):
            if not np.isfinite(prior.map_C[:2]).all():
                rejected[i] = "it has no position"
            elif not np.isfinite(prior.yaw_deg):
                rejected[i] = "it has a position but no heading"
            elif heights[i] <= 0:
                rejected[i] = f"its height above ground would be {heights[i]:.1f} m"
            else:
                poses[i] = self._pose(prior, heights, i)
        return poses, rejected

    def _pose(self, prior: Prior, heights: NDArray[np.float64], i: int) -> Pose:
        R = cam_R_map_from_angles(prior.yaw_deg, prior.pitch_deg, prior.roll_deg)
        return Pose(cam_R_map=R, map_C=np.array([prior.map_C[0], prior.map_C[1], heights[i]]))


def on_ground(frame: MapFrame, priors: Sequence[Prior], heights_m: NDArray[np.float64]) -> MapFrame:
    """A frame that knows where its level ground lies, from heights of the photos above it (n,):
    heights above take-off are taken for such.
    """
    if frame.vertical_datum in OWN_ZERO:
        return frame
    zero = np.array([p.map_C[2] for p in priors]) - heights_m
    if not np.isfinite(zero).any():
        return replace(frame, vertical_datum="unknown", takeoff_m=None)
    return replace(frame, takeoff_m=float(np.nanmedian(zero)))


def _nothing_placed(method: str, photos: int, rejected: dict[int, str]) -> str:
    """Message: why no photo could be placed, and what to do."""
    reasons = "; ".join(dict.fromkeys(rejected.values()))
    advice = "give positions and headings with --geo, or use --method bundle"
    if "height" in reasons:
        advice = "add --height METRES"
    return (
        f"method {method} places photos by their metadata, and none of {photos} can be placed"
        f" ({reasons[:200]}); {advice}"
    )


@dataclass(frozen=True, kw_only=True)
class ByPose(ByMetadata):
    """`pose`: position plus roll, pitch, yaw: an 8-dof projective transform (Y 4.3, 4.4)."""

    name: ClassVar[str] = "pose"


@dataclass(frozen=True, kw_only=True)
class ByPosition(ByMetadata):
    """`position`: translations only, one common scale and one survey heading (Y 4.2)."""

    heading_deg: float | None = None
    """Grid heading of the image top, common to all photos, in degrees clockwise from north. None =
    the most frequent reported heading, or north if none is reported.
    """
    name: ClassVar[str] = "position"

    def _placed(
        self, photos: Sequence[Photo], priors: Sequence[Prior], heights: NDArray[np.float64]
    ) -> tuple[dict[int, Pose], dict[int, str]]:
        common = float(np.median(heights))
        R = cam_R_map_from_angles(self._heading(priors))
        poses = {
            i: Pose(cam_R_map=R, map_C=np.array([p.map_C[0], p.map_C[1], common]))
            for i, p in enumerate(priors)
            if np.isfinite(p.map_C[:2]).all()
        }
        return poses, {i: "it has no position" for i in range(len(photos)) if i not in poses}

    def _heading(self, priors: Sequence[Prior]) -> float:
        """The survey's heading in degrees: the mean of the reported headings around the most
        frequent one.
        """
        if self.heading_deg is not None:
            return self.heading_deg
        yaw = np.array([p.yaw_deg for p in priors])
        told = yaw[np.isfinite(yaw)]
        return commonest_deg(told)[0] if told.size else 0.0
