"""Correction of metadata from links, for methods that place photos by metadata."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.conflicts import YAW_DEG
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.alignment.motion import FEWEST_HEADED, headings_by_course
from skyquilt.alignment.start import find_start, ground_of
from skyquilt.geometry.frames import angle_difference_deg
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Prior
from skyquilt.photos.side_rows import sentence_of

SIGMA_YAW_DEG = 3.0
"""Standard deviation in degrees of a heading from links. Tilts and relief disturb the similarities
a little.
"""
SIGMA_COURSE_DEG = 15.0
"""That of a heading by the direction of flight: wind and turns."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Repaired:
    """Metadata, corrected where the links contradict them."""

    priors: tuple[Prior, ...]
    """One per photo."""
    heights_m: NDArray[np.float64]
    """(n,) heights above ground in m from image scale; NaN for photos without links, or if no
    positions determine the scale.
    """
    notes: tuple[str, ...]
    """Messages about each correction, with both values."""


def repaired_metadata(inputs: AlignmentInputs) -> Repaired:
    """Metadata, corrected where the links contradict them; headings that are still missing are
    those of the flight.
    """
    photos, priors, frame = inputs.photos, inputs.priors, inputs.frame
    found = Repaired(priors=tuple(priors), heights_m=np.full(len(photos), np.nan), notes=())
    if inputs.links:
        ground = ground_of(frame)
        found = repair(photos, priors, inputs.features, inputs.links, frame.convergence_deg, ground)
    return _headed(_without_few(found, priors), photos)


def _without_few(found: Repaired, priors: Sequence[Prior]) -> Repaired:
    """The metadata as reported, where no photo reports a heading and links give one to a few only:
    they may be wrong, and all other photos would be headed by them.
    """
    linked = sum(p.yaw_source == "pixels" for p in found.priors)
    told = any(np.isfinite(p.yaw_deg) for p in priors)
    if told or not 0 < linked < FEWEST_HEADED or linked == len(priors):
        return found
    return Repaired(priors=tuple(priors), heights_m=np.full(len(priors), np.nan), notes=())


def _headed(found: Repaired, photos: Sequence[Photo]) -> Repaired:
    """The same with headings by the direction of flight where there are none, and a note."""
    at = np.array([p.map_C[:2] for p in found.priors])
    yaw = np.array([p.yaw_deg for p in found.priors])
    known = np.flatnonzero(np.isfinite(at).all(1))
    if np.isfinite(yaw[known]).all():
        return found
    own = [photos[i] for i in known.tolist()]
    course = np.full(len(yaw), np.nan)
    course[known] = headings_by_course(own, at[known], yaw[known], assumed=True)
    flown = np.isfinite(course)
    if not flown.any():
        return found
    priors = tuple(
        replace(p, yaw_deg=float(c), sigma_yaw_deg=SIGMA_COURSE_DEG, yaw_source="flight")
        if headed
        else p
        for p, c, headed in zip(found.priors, course, flown, strict=True)
    )
    guessed = not np.isfinite(yaw[known]).any()
    how = "their tops are taken to show where it goes" if guessed else "as the others are headed"
    names = sentence_of([photos[i].name for i in np.flatnonzero(flown).tolist()])
    said = f"Photos without a heading are drawn along the direction of flight, {how}: {names}."
    return replace(found, priors=priors, notes=(*found.notes, said))


def repair(
    photos: Sequence[Photo],
    priors: Sequence[Prior],
    features: Sequence[Features],
    links: Sequence[Link],
    convergence_deg: float = 0.0,
    ground_m: float = 0.0,
) -> Repaired:
    """Replaces headings that contradict the links, fills in missing ones, and computes heights
    above ground from image scale.

    Positions are not changed; their deviation is set to their scatter in the block where that is
    larger than stated. `ground_m`: see `find_start`.
    """
    start = find_start(photos, priors, features, links, ground_m)
    repaired, notes = list(priors), []
    heights = np.full(len(photos), np.nan)
    for i, (a, _) in sorted(start.placed.items()):
        if start.metric and i in start.georeferenced:
            heights[i] = abs(a)
        found = angle_difference_deg(-float(np.degrees(np.angle(a))), 0.0)
        repaired[i], told = _heading(photos[i], priors[i], found, convergence_deg)
        notes += told
        spread = start.sigma_xy.get(i, 0.0)
        if spread > repaired[i].sigma_C[0]:
            repaired[i] = replace(
                repaired[i], sigma_C=np.array([spread, spread, priors[i].sigma_C[2]])
            )
    return Repaired(priors=tuple(repaired), heights_m=heights, notes=tuple(notes))


def _heading(
    photo: Photo, prior: Prior, found_deg: float, convergence_deg: float
) -> tuple[Prior, list[str]]:
    """The prior with the heading from the links if the reported one is missing or
    contradicts it.
    """
    known = np.isfinite(prior.yaw_deg)
    off = angle_difference_deg(prior.yaw_deg, found_deg) if known else np.nan
    if known and abs(off) < max(YAW_DEG, 3 * prior.sigma_yaw_deg):
        return prior, []
    better = replace(prior, yaw_deg=found_deg, sigma_yaw_deg=SIGMA_YAW_DEG, yaw_source="pixels")
    if not known:
        return better, []
    if (
        abs(abs(off) - 180) < 20 and photo.editor
    ):  # the file was saved upside down, so its axes are turned too
        better = replace(better, pitch_deg=-prior.pitch_deg, roll_deg=-prior.roll_deg)
    said, shows = (
        angle_difference_deg(y + convergence_deg, 0.0) for y in (prior.yaw_deg, found_deg)
    )
    return better, [
        f"{photo.name} reports a heading of {said:.0f} degrees, its pixels show {shows:.0f}."
    ]
