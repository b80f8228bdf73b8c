"""The aligners of every survey: `bundle`, `pose`, `position`, and `auto`, which chooses."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.addition import added, median_offset
from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.control import control_in_frame
from skyquilt.alignment.copied_views import without_copied_views
from skyquilt.alignment.crowded_positions import at_their_middle, one_place_notes
from skyquilt.alignment.determined import ground_places
from skyquilt.alignment.foreign_positions import usable_positions
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.alignment.motion import FEWEST_HEADED, headings_by_course
from skyquilt.alignment.nothing_shown import CLOSED, ONE_TONE, one_tone, shutter_closed
from skyquilt.alignment.oblique import tilted, without_photos
from skyquilt.alignment.outcome import of_placed
from skyquilt.alignment.pose import ByMetadata, ByPose
from skyquilt.alignment.repair import Repaired, repaired_metadata
from skyquilt.errors import AlignmentError
from skyquilt.geometry.camera import shown
from skyquilt.geometry.frames import angles_from_cam_R_map, cam_R_map_from_angles
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features
from skyquilt.model.poses import Alignment, Pose
from skyquilt.photos.implausible_positions import raised
from skyquilt.photos.side_rows import sentence_of

SHOWN_ALREADY = 0.8
"""Photos without links are left out where connected photos show more than this share of what they
would show, and so are small blocks where the largest one shows more of it.
"""
STRANGE = 0.25
"""Such blocks have fewer photos than this share of the largest one: two flights that do not look
alike, or lines of a wide lens that overlap by far, are both worth their place.
"""
FLOWN_M, PLACE_M = 30.0, 10.0
"""Photos are taken on the ground if they tell so and lie nearer together than the second, while the
others were taken from the first or higher: a strip over a valley, as high as take-off, is longer.
"""
NEIGHBOURS = 40
"""So many of the nearest connected photos are asked."""
KEYPOINTS = 8
"""A photo with fewer shows next to nothing: a lens cap without noise, a white sky."""
UNTIED = "no point that photos share has a place of its own, so each is placed by its metadata"
"""Why a panorama is not adjusted."""
LOOSE = "photos share too little to be adjusted together, so each is placed by its metadata"
"""Why photos that hardly overlap are not."""
REQUESTED = "asked for"
"""The reason recorded for a method that the user requested."""


@dataclass(frozen=True, kw_only=True)
class ByLinks:
    """`bundle`: all linked photos are adjusted together; the others are placed by their
    metadata.
    """

    bundle: Bundle = field(default_factory=Bundle)
    """The adjustment."""
    version: ClassVar[int] = 22
    needs_links: ClassVar[bool] = True

    def __call__(self, inputs: AlignmentInputs) -> Alignment:
        """Aligns the photos.

        Raises:
            AlignmentError: no two photos are linked.
        """
        inputs, said = usable_positions(inputs)
        if inputs.former is not None and (grown := added(inputs, self.bundle)) is not None:
            return of_placed(without_strange_blocks(with_loose_photos(grown, inputs), inputs))
        control = control_in_frame(inputs.control, inputs.photos, inputs.frame)
        found = self.bundle(
            inputs.photos,
            inputs.frame,
            inputs.priors,
            inputs.features,
            inputs.links,
            control,
            inputs.grey,
            inputs.keep,
            inputs.make_room,
        )
        told = {i for i, p in enumerate(inputs.photos) if p.position is not None}
        bare = {
            i
            for i, p in enumerate(inputs.photos)
            if p.position is None and p.attitude is None and p.focal.source == "guess"
        }
        found = without_copied_views(found, [p.name for p in inputs.photos], told, bare)
        found = replace(found, notes=(*found.notes, *said, *one_place_notes(inputs, found)))
        found = without_strange_blocks(with_loose_photos(found, inputs), inputs)
        return replace(of_placed(found), why=REQUESTED)


@dataclass(frozen=True, kw_only=True)
class ByReport:
    """`pose` and `position`: photos are placed by their metadata, with or without correction by
    links.
    """

    method: ByMetadata
    """Which metadata are used."""
    repair: bool = True
    """Whether links may correct the metadata."""
    version: ClassVar[int] = 2

    @property
    def needs_links(self) -> bool:
        """Links are needed only to correct metadata."""
        return self.repair

    def __call__(self, inputs: AlignmentInputs) -> Alignment:
        """Places the photos.

        Raises:
            AlignmentError: positions or heights above ground are missing.
        """
        repaired = repaired_metadata(inputs) if self.repair else None
        return replace(placed_by_metadata(self.method, inputs, repaired), why=REQUESTED)

    def instead_of(self, few: Alignment, inputs: AlignmentInputs) -> Alignment:
        """All photos placed by metadata where an adjustment held next to none and that is twice as
        many; otherwise what the adjustment found. Where that is nothing, photos were taken from one
        place, which is another matter.
        """
        told = sum(bool(np.isfinite(p.map_C[:2]).all()) for p in inputs.priors)
        by_control = any(not point.check for point in inputs.control)
        enough = len(few.held) >= FEWEST_HEADED or 2 * len(few.poses) >= told
        if enough or by_control or not few.poses:
            return few
        try:
            found = self(inputs)
        except AlignmentError as error:
            said = f"More photos could be placed by their metadata, but {error}."
            return replace(few, notes=(*few.notes, said))
        return replace(found, why=LOOSE) if len(found.poses) > 2 * len(few.poses) else few


@dataclass(frozen=True, kw_only=True)
class Auto:
    """Chooses the method from the data: `bundle` if photos are linked, otherwise `pose`."""

    bundle: ByLinks
    """For linked photos."""
    pose: ByReport
    """For photos that only have positions."""
    version: ClassVar[int] = 18
    needs_links: ClassVar[bool] = True

    def __call__(self, inputs: AlignmentInputs) -> Alignment:
        """Aligns the photos; `why` gives the reason as a sentence.

        Raises:
            AlignmentError: photos without links and without positions.
        """
        inputs, said = usable_positions(inputs)
        positions = sum(bool(np.isfinite(p.map_C[:2]).all()) for p in inputs.priors)
        control = sum(not point.check for point in inputs.control)
        blank = () if inputs.links else blank_notes(inputs.features)
        try:
            method, why = choose_method(len(inputs.photos), len(inputs.links), positions, control)
            found = (self.bundle if method == "bundle" else self.pose)(inputs)
            if method == "bundle" and positions:
                found = self.pose.instead_of(found, inputs)
                why = found.why if found.method == "pose" else why
            if not found.poses and positions:
                notes, why = found.notes, UNTIED
                found = replace(self.pose, repair=False)(at_their_middle(inputs))
                found = replace(found, notes=(*notes, *found.notes))
        except AlignmentError as error:
            if blank:
                raise AlignmentError(f"{error}. {blank[0]}") from error
            raise
        return replace(found, why=why, notes=(*found.notes, *blank, *said))


def placed(found: Alignment) -> Alignment:
    """The same alignment.

    Raises:
        AlignmentError: it has no photo.
    """
    if not found.poses:
        why = "; ".join(dict.fromkeys(found.rejected.values()))
        raise AlignmentError(
            f"none of {len(found.rejected)} photos could be placed ({why}): they are copies of one"
            " picture, or were taken from one place, and report no positions that place them; map"
            " one of them by itself, or give positions with --geo"
        )
    return found


def blank_notes(features: Sequence[Features]) -> tuple[str, ...]:
    """What is said where most photos have next to no keypoints."""
    blank = sum(len(found.px) < KEYPOINTS for found in features)
    if 2 * blank <= len(features):
        return ()
    return (
        f"{blank} of {len(features)} photos show next to nothing that can be recognised: are they"
        " black, overexposed, or out of focus?",
    )


def choose_method(photos: int, links: int, positions: int, control: int) -> tuple[str, str]:
    """`bundle` or `pose`, and the reason as one sentence; numbers of photos, links, photos with
    positions, and control points.

    Raises:
        AlignmentError: neither can place the photos.
    """
    if photos == 1:
        return "pose", "a single photo cannot be adjusted"
    if links:
        where = "but no positions: the map is not georeferenced"
        if positions or control:
            where = f"and {'control points' if control else 'positions'} place it"
        return "bundle", f"{links} links connect the photos, {where}"
    if positions:
        return "pose", "no two photos could be linked, so each is placed by its metadata"
    raise AlignmentError(
        f"no two of {photos} photos overlap recognisably and none has a position;"
        " give positions with --geo, or photos that overlap by half or more"
    )


def by_pose(height_m: float | None, repair: bool) -> ByReport:
    """The aligner `pose`."""
    return ByReport(method=ByPose(height_m=height_m), repair=repair)


def placed_by_metadata(
    method: ByMetadata, inputs: AlignmentInputs, repaired: Repaired | None
) -> Alignment:
    """Photos placed by reported or by corrected metadata."""
    if repaired is None:
        return method(inputs.photos, inputs.frame, inputs.priors)
    placed = method(inputs.photos, inputs.frame, repaired.priors, repaired.heights_m)
    return replace(placed, notes=(*placed.notes, *repaired.notes))


def without_strange_blocks(found: Alignment, inputs: AlignmentInputs) -> Alignment:
    """The alignment without blocks that no link connects with the largest one and that show
    something else: small ones where that shows the same ground (photos of people or of a room
    before the flight, or a few of another day), and any taken on the ground, at take-off. They
    would be drawn over it, as far off as positions are.
    """
    first, *others = [b for b in found.blocks if len(b) > 1] or [()]
    reasons, notes = dict[int, str](), list[str]()
    for block in others:
        if _grounded(found, inputs, block, first):
            why = f"not with the {len(first)} of the largest block, which were taken in the air"
            names = sentence_of([inputs.photos[i].name for i in block])
            what = f" They were taken on the ground ({names})."
        elif len(block) < STRANGE * len(first) and _mostly_shown(found, block, first):
            why = f"not with the {len(first)} of the largest block, which show the same ground"
            what = (
                " They show something else, or it looks different on them (another day); if they"
                " belong to the survey, map them by themselves."
            )
        else:
            continue
        reason = f"it is linked with {len(block) - 1} other photos, but {why}"
        reasons |= dict.fromkeys(block, reason)
        notes.append(
            f"{len(block)} photos are left out: they are linked with one another, but {why}.{what}"
        )
    if not reasons:
        return found
    return replace(without_photos(found, reasons), notes=(*found.notes, *notes))


def _mostly_shown(found: Alignment, block: Sequence[int], first: Sequence[int]) -> bool:
    """Whether the larger block `first` shows most of what the photos of a block show."""
    shown = [share_shown(found.poses[i], found.camera(i), found, first) for i in block]
    return float(np.mean(shown)) > SHOWN_ALREADY


def _grounded(
    found: Alignment, inputs: AlignmentInputs, block: Sequence[int], first: Sequence[int]
) -> bool:
    """Whether photos that lie together tell that they were taken on the ground, and those of the
    larger block `first` from high above.
    """
    photos = inputs.photos
    heights = [photos[i].above_takeoff_m for i in block]
    flown = [h for i in first if (h := photos[i].above_takeoff_m) is not None]
    if None in heights or any(raised(photos[i]) for i in block) or not flown:
        return False
    places = np.array([found.poses[i].map_C[:2] for i in block])
    apart = float(np.linalg.norm(places - places.mean(0), axis=1).max())
    return apart < PLACE_M and float(np.median(flown)) >= FLOWN_M


def with_loose_photos(alignment: Alignment, inputs: AlignmentInputs) -> Alignment:
    """Adds photos without links, placed by their own metadata relative to the adjusted ones, with
    notes; photos that lack metadata, or are black or white, are rejected. Where only the heading is
    missing, the direction of flight tells it, if it tells that of the adjusted ones.
    """
    photos, priors = inputs.photos, inputs.priors
    poses, cameras = dict(alignment.poses), dict(alignment.cameras)
    camera_of, rejected = dict(alignment.camera_of), dict(alignment.rejected)
    blocks, notes, loose = list(alignment.blocks), list(alignment.notes), dict[str, list[str]]()
    offset = median_offset(alignment, priors)
    flown = _flown(alignment, inputs, offset)
    for i, photo in enumerate(photos):
        if i in poses:
            continue
        C = priors[i].map_C + offset
        if i in alignment.rejected and tilted(priors[i]):
            continue  # a tilt turns errors of metadata into large displacements
        by_course = not np.isfinite(priors[i].yaw_deg)
        yaw = flown[i] if by_course else priors[i].yaw_deg
        if alignment.frame.crs is None or _lacking(C, yaw):
            lacking = _lacking(C, yaw) or "no heading"
            reason = "it could not be linked to the other photos, and it has"
            rejected[i] = rejected.get(i, f"{reason} {lacking} to place it by")
            continue
        if one_tone(photo, partial(inputs.grey, i)):
            rejected[i] = ONE_TONE
            notes.append(f"{photo.name} is left out: {rejected[i]}.")
            continue
        weak = rejected.pop(i, "it could not be linked to any other photo")
        R = cam_R_map_from_angles(yaw, priors[i].pitch_deg, priors[i].roll_deg)
        pose = Pose(cam_R_map=R, map_C=C)
        if shutter_closed(photo, i, pose, alignment, inputs.grey):
            rejected[i] = CLOSED
            notes.append(f"{photo.name} is left out: {CLOSED}.")
            continue
        if shown_already(pose, photo.lens, alignment):
            rejected[i] = (
                f"{weak}, and what it would show by its metadata is shown by photos that are"
            )
            continue
        poses[i] = pose
        cameras.setdefault(photo.camera_key, photo.lens)
        camera_of[i] = photo.camera_key
        blocks.append((i,))
        by = "position and the direction of flight" if by_course else "metadata"
        loose.setdefault(f"placed by its {by}: {weak}.", []).append(photo.name)
    for how, names in loose.items():
        several = f"{len(names)} photos ({sentence_of(names)}) are each"
        some = several if len(names) > 1 else f"{names[0]} is"
        notes.append(f"{some} {how}")
    return replace(
        alignment,
        poses=poses,
        cameras=cameras,
        camera_of=camera_of,
        rejected=rejected,
        blocks=tuple(blocks),
        notes=tuple(notes),
    )


def _flown(
    alignment: Alignment, inputs: AlignmentInputs, offset: NDArray[np.float64]
) -> list[float]:
    """Headings in degrees by the direction of flight of photos that are not placed and report none;
    NaN of others, and where it does not tell.
    """
    at = np.array([prior.map_C[:2] for prior in inputs.priors]) + offset[:2]
    yaw = np.full(len(at), np.nan)
    lacking = [
        i
        for i, prior in enumerate(inputs.priors)
        if i not in alignment.poses and np.isnan(prior.yaw_deg) and np.isfinite(at[i]).all()
    ]
    if lacking:
        for i in alignment.held:
            at[i] = alignment.poses[i].map_C[:2]
            yaw[i] = angles_from_cam_R_map(alignment.poses[i].cam_R_map)[0]
        asked = [*alignment.held, *lacking]
        told = headings_by_course([inputs.photos[i] for i in asked], at[asked], yaw[asked])
        yaw[asked] = told
    return yaw.tolist()


def shown_already(pose: Pose, camera: Camera, alignment: Alignment) -> bool:
    """Whether connected photos show what a photo without links would show. It does not look like
    them, then: a lens cap, a hand, a landing, a panorama; or it adds nothing to them.
    """
    return share_shown(pose, camera, alignment, alignment.held) > SHOWN_ALREADY


def share_shown(pose: Pose, camera: Camera, alignment: Alignment, by: Sequence[int]) -> float:
    """The share of what a photo shows of the ground that photos `by` (indices) show, too; 1 for
    photos taken below the ground, 0 where nothing is known.
    """
    if not len(alignment.ties.xyz):
        return 0.0
    ground = alignment.ground_m
    if pose.map_C[2] <= ground:
        return 1.0
    places = ground_places(pose, camera, ground)
    if not len(places):
        return 0.0
    held = np.array(by)
    away = [float(np.hypot(*(alignment.poses[i].map_C - pose.map_C)[:2])) for i in held.tolist()]
    there = np.zeros(len(places), np.bool_)
    for i in held[np.argsort(away)[:NEIGHBOURS]].tolist():
        there |= shown(alignment.camera(i), alignment.poses[i].to_camera(places))[1]
    return float(there.mean())


def _lacking(C: NDArray[np.float64], yaw_deg: float) -> str:
    """The data missing for placing a photo; empty if nothing is missing."""
    if not np.isfinite(C[:2]).all():
        return "no position"
    if not np.isfinite(C[2]):
        return "no height"
    return "" if np.isfinite(yaw_deg) else "no heading"
