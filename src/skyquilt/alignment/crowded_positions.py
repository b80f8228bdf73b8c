"""Positions that crowd in one place although the pictures show photos far apart: those of the
remote control or of a phone, or of a receiver that found no satellites.

They tell nothing of a map's scale and direction, and would shrink it to the size of their error.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.determined import STATED_DEG
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.alignment.oblique_start import map_rays, reach_of, within_noise
from skyquilt.alignment.start import NOMINAL_HEIGHT_M, find_start, ground_of
from skyquilt.model.features import Link
from skyquilt.model.poses import Alignment, MapFrame, Prior

FURTHER = 4.0
"""Positions that lie within their errors of one another crowd if the pictures show photos so many
times further apart, seen from the height that they report, ...
"""
LEAST_HEIGHT_M = 8.0
"""... or from this height, where they report none: with positions that crowd, the map would show
photos taken from below 2 m.
"""
FEWEST_ALIKE, ALIKE = 6, 0.7
"""Positions that crowd do not lie as the pictures show the photos: so many photos, by so large a
share of the square of their distances from the middle.
"""
FROM_ONE_PLACE_DEG = 5.0
"""Matched rays that differ by no more, in the median, by the angles that photos report, were taken
from one place: the photos of a panorama. From places as far apart as `FURTHER` asks for they differ
by 15 degrees and more.
"""
ASKED = 200
"""Pairs of photos that are asked for that."""
ONE_PLACE = (
    "The photos were taken from one place, as a panorama or a hover: nothing tells the heights of"
    " the ground, which is drawn as if it were level. Houses and trees lean outwards, hills shift"
    " what is far from the middle, and the scale rests on the height above take-off."
)
"""What is said of such photos."""
FLOWN = 0.3
"""A tenth of the photos lie further from most than this share of the height where a flight joins a
hover; drones that take a panorama drift by less.
"""
FEWEST_CONTROL = 3
"""Control points that place a map without positions."""


def without_crowded(inputs: AlignmentInputs) -> tuple[AlignmentInputs, tuple[str, ...]]:
    """The inputs without positions that crowd, and a sentence on these; the very same inputs where
    none do. Heights stay: they tell the map's scale.
    """
    told = inputs.priors
    reach = reach_of(np.array([p.map_C[:2] for p in told]).reshape(-1, 2))
    if not inputs.links or inputs.frame.crs is None or not within_noise(told):
        return inputs, ()
    if _only_turned(inputs):
        return inputs, ()
    bare, ground = without_places(told), ground_of(inputs.frame)
    start = find_start(inputs.photos, bare, inputs.features, inputs.links, ground)
    scale = 1.0 if start.metric else LEAST_HEIGHT_M / NOMINAL_HEIGHT_M
    block = max(start.blocks, key=len, default=())
    places = np.array([start.placed[m][1] for m in block], complex)
    shown = scale * reach_of(np.column_stack([places.real, places.imag]))
    if not shown > FURTHER * reach or _as_shown(
        places, np.array([told[m].map_C[:2] for m in block])
    ):
        return inputs, ()
    control = sum(not point.check for point in inputs.control) >= FEWEST_CONTROL
    frame = inputs.frame if control else unplaced(inputs.frame)
    note = (
        f"Half of the positions lie within {reach:.1f} m, where the pictures show the photos within"
        f" {shown:.0f} m: they are those of the remote control, or the receiver was stuck. They"
        " were not used. Provide positions in a geo.txt, or control points."
    )
    return replace(inputs, priors=bare, frame=frame), (note,)


def _as_shown(places: NDArray[np.complex128], xy: NDArray[np.float64]) -> bool:
    """Whether positions (n, 2) lie as the pictures show the photos (n), but nearer to each other:
    then heights or a guessed focal length are wrong, such as that of a long lens.
    """
    known = np.isfinite(xy).all(1)
    if known.sum() < FEWEST_ALIKE:
        return False
    a, b = places[known], xy[known] @ (1, 1j)
    a, b = a - a.mean(), b - b.mean()
    alike = abs(np.vdot(a, b)) ** 2 / max(
        float((np.abs(a) ** 2).sum() * (np.abs(b) ** 2).sum()), 1e-9
    )
    return bool(alike > ALIKE)


def unplaced(frame: MapFrame) -> MapFrame:
    """The frame of a map whose place is not known."""
    return replace(frame, crs=None, origin=(0.0, 0.0), convergence_deg=0.0)


def without_places(priors: Sequence[Prior]) -> tuple[Prior, ...]:
    """The priors without positions, but with their heights."""
    nowhere, any_far = np.full(2, np.nan), np.full(2, np.inf)
    return tuple(
        replace(
            p, map_C=np.r_[nowhere, p.map_C[2:]], sigma_C=np.r_[any_far, np.asarray(p.sigma_C)[2:]]
        )
        for p in priors
    )


def without_heights(priors: Sequence[Prior]) -> tuple[Prior, ...]:
    """The priors without heights, but with their positions."""
    return tuple(
        replace(
            p, map_C=np.r_[p.map_C[:2], np.nan], sigma_C=np.r_[np.asarray(p.sigma_C)[:2], np.inf]
        )
        for p in priors
    )


def believed(found: Alignment, frame: MapFrame, priors: Sequence[Prior]) -> Sequence[Prior]:
    """The priors that an alignment was made with, where it left places or heights of a frame
    out.
    """
    if found.frame.vertical_datum == "unknown" != frame.vertical_datum:
        priors = without_heights(priors)
    return without_places(priors) if frame.crs and not found.frame.crs else priors


def one_place_notes(inputs: AlignmentInputs, found: Alignment) -> tuple[str, ...]:
    """A sentence on the photos of a panorama or a hover; not where some were `found` elsewhere:
    then most were taken before the flight began.
    """
    if inputs.frame.crs is None or not within_noise(inputs.priors) or not _only_turned(inputs):
        return ()
    places = np.array([found.poses[i].map_C for i in found.held]).reshape(-1, 3)
    if len(places):
        away = np.linalg.norm(places[:, :2] - np.median(places[:, :2], axis=0), axis=1)
        if np.quantile(away, 0.9) > FLOWN * (np.median(places[:, 2]) - found.ground_m):
            return ()
    return (ONE_PLACE,)


def at_their_middle(inputs: AlignmentInputs) -> AlignmentInputs:
    """The inputs with all photos in the middle of their positions, where the camera only turned:
    errors of receivers would tear the picture.
    """
    if not _only_turned(inputs):
        return inputs
    middle = np.nanmedian([p.map_C for p in inputs.priors], axis=0)
    return replace(inputs, priors=[replace(p, map_C=middle.copy()) for p in inputs.priors])


def _only_turned(inputs: AlignmentInputs) -> bool:
    """Whether the camera only turned, by the angles that photos report: what they show apart in the
    plane of the ground are their slanting views.
    """
    known = [np.isfinite(p.yaw_deg) and p.sigma_tilt_deg <= STATED_DEG for p in inputs.priors]
    told = [k for k in inputs.links if known[k.a] and known[k.b]]
    if not told or 2 * len(told) < len(inputs.links):
        return False
    some = np.unique(np.linspace(0, len(told) - 1, ASKED).astype(int)).tolist()
    return float(np.median([_rays_apart_deg(inputs, told[k]) for k in some])) <= FROM_ONE_PLACE_DEG


def _rays_apart_deg(inputs: AlignmentInputs, link: Link) -> float:
    """Median angle in degrees between the rays of two photos to what both show."""
    rays = [
        map_rays(inputs.photos[i], inputs.priors[i], inputs.features[i].px[index])
        for i, index in ((link.a, link.index_a), (link.b, link.index_b))
    ]
    sine = np.linalg.norm(np.cross(rays[0], rays[1]), axis=1)
    return float(np.degrees(np.arcsin(np.median(np.minimum(sine, 1)))))
