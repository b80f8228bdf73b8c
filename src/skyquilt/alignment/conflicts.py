"""Contradictions between metadata and image content."""

from collections.abc import Sequence

import numpy as np

from skyquilt.alignment.crowded_positions import believed
from skyquilt.alignment.displaced_parts import as_taken
from skyquilt.alignment.false_heights import outvoted
from skyquilt.alignment.late_positions import as_moved
from skyquilt.alignment.motion import Speeds
from skyquilt.alignment.oblique_guess import lowered
from skyquilt.alignment.start import GROSS_DEG, heading_errors
from skyquilt.geometry.camera import distort
from skyquilt.geometry.frames import angle_difference_deg
from skyquilt.model.camera import Camera
from skyquilt.model.event import MetadataConflict
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, MapFrame, Prior

CERTAIN = 5.0
"""Deviations, as the flight determines them, by which a calibration's values must be missed, and"""
CONTRADICTED_PX = 2.0
"""the px in the photo by which they must differ, for it to be contradicted."""
YAW_DEG = 15.0
"""Yaw angles in degrees that differ by more than this contradict each other."""


def conflicts(
    photos: Sequence[Photo], priors: Sequence[Prior], alignment: Alignment
) -> list[MetadataConflict]:
    """All contradictions of photos that are connected by tie points, in order of capture."""
    held = alignment.held or (tuple(sorted(alignment.poses)) if alignment.method == "pose" else ())
    found = _yaws(photos, priors, alignment, held)
    if alignment.frame.crs is not None:
        found += _altitudes(photos, priors, alignment, held) + _positions(
            photos, priors, alignment, held
        )
    found += _unusable(photos, alignment)
    return found + _focals(photos, alignment, held) + _lenses(photos, alignment, held)


def _unusable(photos: Sequence[Photo], alignment: Alignment) -> list[MetadataConflict]:
    """Calibrations that no lens can have, once for each camera."""
    out: dict[str, MetadataConflict] = {}
    for i in sorted(alignment.poses):
        photo = photos[i]
        if photo.unusable_calibration and photo.camera_key not in out:
            out[photo.camera_key] = MetadataConflict(
                photo=photo.name,
                field="calibration",
                reported=None,
                estimated=round(alignment.camera(i).focal, 1),
                meaning="the calibration in the metadata is not that of a lens"
                f" ({photo.unusable_calibration}) and was ignored",
            )
    return list(out.values())


def _yaws(
    photos: Sequence[Photo], priors: Sequence[Prior], alignment: Alignment, held: Sequence[int]
) -> list[MetadataConflict]:
    """Headings that are off; what those of one camera are off in common is no file's turn."""
    off, common = heading_errors(photos, priors, {i: alignment.poses[i] for i in held})
    return [
        c
        for i in off
        for c in _yaw(photos[i], priors[i], alignment, off[i], common[photos[i].camera_key])
    ]


def _yaw(
    photo: Photo, prior: Prior, alignment: Alignment, off: float, common: float
) -> list[MetadataConflict]:
    own = angle_difference_deg(off, common)
    turned = abs(abs(own) - 180) < GROSS_DEG and photo.editor is not None
    if abs(off) < max(YAW_DEG, 3 * prior.sigma_yaw_deg) and not turned:
        return []
    convergence = alignment.frame.convergence_deg
    why = (
        f"the reported heading ({prior.yaw_source}) is wrong by {off:+.0f} degrees: a compass or"
        " gimbal that was not calibrated"
    )
    if abs(abs(common) - 180) < GROSS_DEG and abs(own) < GROSS_DEG:
        why += ", or latitude and longitude both have the wrong sign: look where the map lies"
    if turned:
        why = "another program has turned the file upside down, not its metadata"
    elif abs(abs(off) - 90) < 20 and photo.height > photo.width:
        why = "the file was turned upright, by a quarter, and its metadata were not"
    return [
        MetadataConflict(
            photo=photo.name,
            field="yaw",
            reported=round(angle_difference_deg(prior.yaw_deg + convergence, 0), 1),
            estimated=round(angle_difference_deg(prior.yaw_deg - off + convergence, 0), 1),
            meaning=why,
        )
    ]


def _altitudes(
    photos: Sequence[Photo], priors: Sequence[Prior], alignment: Alignment, held: Sequence[int]
) -> list[MetadataConflict]:
    """Altitudes that differ from the solution by more than three deviations and 5 % of the flying
    height.

    An offset common to all photos comes from the height datum and is not a contradiction. Where
    some heights were not used, the others have none: the map lies by them.
    """
    z = np.array([alignment.poses[i].map_C[2] for i in held])
    off = np.array([priors[i].map_C[2] for i in held]) - z
    if not np.isfinite(off).any():
        return []
    if not outvoted(alignment):
        off = off - np.nanmedian(off)
    out = []
    for i, e, height in zip(held, off, z - alignment.ground_m, strict=True):
        if np.isfinite(e) and abs(e) > max(2 * priors[i].sigma_C[2], 0.05 * height):
            reported = float(priors[i].map_C[2])
            where = "lower" if e > 0 else "higher"
            out.append(
                MetadataConflict(
                    photo=photos[i].name,
                    field="altitude",
                    reported=round(reported, 1),
                    estimated=round(reported - float(e), 1),
                    meaning=f"by image scale and neighbours it is {abs(e):.0f} m {where}:"
                    " a drifting barometer or receiver, camera angles that are all off alike, or a"
                    " digital zoom",
                )
            )
    return out


def _positions(
    photos: Sequence[Photo], priors: Sequence[Prior], alignment: Alignment, held: Sequence[int]
) -> list[MetadataConflict]:
    out = []
    for i in held:
        off = float(np.hypot(*(alignment.poses[i].map_C - priors[i].map_C)[:2]))
        if np.isfinite(off) and off > 5 * priors[i].sigma_C[0]:
            out.append(
                MetadataConflict(
                    photo=photos[i].name,
                    field="position",
                    reported=round(off, 1),
                    estimated=0.0,
                    meaning=f"the reported position is {off:.1f} m from the adjusted one"
                    " and got little weight",
                )
            )
    return out


def _focals(
    photos: Sequence[Photo], alignment: Alignment, held: Sequence[int]
) -> list[MetadataConflict]:
    out, seen = [], set()
    for i in held:
        photo, camera = photos[i], alignment.camera(i)
        off = abs(camera.focal - photo.focal.px)
        if photo.camera_key not in seen and off > max(
            3 * photo.focal.sigma_px, 0.05 * photo.focal.px
        ):
            seen.add(photo.camera_key)
            out.append(
                MetadataConflict(
                    photo=photo.name,
                    field="focal",
                    reported=round(photo.focal.px, 1),
                    estimated=round(camera.focal, 1),
                    meaning=f"self-calibration of {photo.camera_key} gives another focal length (in"
                    " px): another camera, a zoom, or a resized file",
                )
            )
    return out


def _lenses(
    photos: Sequence[Photo], alignment: Alignment, held: Sequence[int]
) -> list[MetadataConflict]:
    """Calibrations that came with the photos and that the flight contradicts: by several of the
    deviations that the flight determines them with, and by some pixels in the photo.
    """
    out, seen = [], set()
    for i in held:
        photo, camera, told = photos[i], alignment.camera(i), photos[i].calibration
        if told is None or photo.camera_key in seen or camera.sigmas is None:
            continue
        seen.add(photo.camera_key)
        if alignment.camera_of[i] != photo.camera_key:  # a file saved upside down
            told = told.mirrored()
        sigma = np.maximum(camera.sigmas, 1e-12)
        apart = np.abs(camera.vector - told.vector)
        certain = apart > CERTAIN * sigma
        off = float(np.hypot(*apart[1:3]))
        if off > CONTRADICTED_PX and certain[1:3].any():
            meaning = (
                f"self-calibration puts the principal point of {photo.camera_key} {off:.1f} px from"
                " that of its calibration; the flight's is used"
            )
            out.append(_lens_conflict(photo, "principal_point", off, meaning))
        off = _distortion_px(camera, told)
        if off > CONTRADICTED_PX and certain[3:8].any() and told.vector[3:8].any():
            meaning = (
                f"the distortion of {photo.camera_key} differs from its calibration by {off:.1f} px"
                " in the corners; the flight's is used"
            )
            out.append(_lens_conflict(photo, "lens", off, meaning))
    return out


def _lens_conflict(photo: Photo, field: str, off_px: float, meaning: str) -> MetadataConflict:
    return MetadataConflict(
        photo=photo.name, field=field, reported=0.0, estimated=round(off_px, 1), meaning=meaning
    )


def _distortion_px(camera: Camera, told: Camera) -> float:
    """Largest difference of two lenses' distortion in the corners in px."""
    w, h = camera.width / 2 / camera.focal, camera.height / 2 / camera.focal
    corners = np.array([[w, h], [-w, h], [w, -h], [-w, -h]])
    bent = distort(corners, camera.vector) - distort(corners, told.vector)
    return camera.focal * float(np.linalg.norm(bent, axis=1).max())


def priors_taken(
    found: Alignment,
    frame: MapFrame,
    reported: Sequence[Prior],
    names: Sequence[str],
    cameras: Sequence[str],
    speeds: Speeds,
) -> tuple[Prior, ...]:
    """The reported priors as an alignment took them, by what it says of them; `frame`: that of the
    reported ones, the rest as of `alignment.tries.Survey`.
    """
    priors = lowered(found, believed(found, frame, reported))
    moved = as_moved(found, priors, cameras, speeds)
    return as_taken(found, names, moved, cameras)
