"""Where the files of each band were when they were taken: beside the map's photo of the same
capture, by the camera of the band.

Two drones have two rigs, so a camera is found for each two cameras whose files were taken together.
"""

from collections.abc import Container, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.motion import velocities_of
from skyquilt.coregistration.band_rig import BandRig, FindBandRig
from skyquilt.engine.clock import Steps
from skyquilt.engine.workers import Workers
from skyquilt.model.camera import Camera
from skyquilt.model.event import Note
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.model.registration import RefusedRegistration
from skyquilt.multispectral.captures import (
    THERMAL,
    BandFiles,
    bands_of_files,
    captured_together,
    tags_of,
)
from skyquilt.multispectral.depth import depth_of, with_bits
from skyquilt.multispectral.draw import PlacedBand
from skyquilt.multispectral.focus import relative_detail, typical, unsharp_notes
from skyquilt.multispectral.panels import by_panels
from skyquilt.multispectral.recorded import Recorded, look_at
from skyquilt.multispectral.reflectance import KINDS, Kind, common_kind
from skyquilt.photos.left_out import without_partner
from skyquilt.workflows.flow import AlignedPhotos, Scene
from skyquilt.workflows.second_camera import far, seen_together

Velocity = NDArray[np.float64]
"""(3,) in m/s in the map frame."""
MOST_PAIRS = 6
"""Captures from which the camera of a band is found, distributed over the flight; each takes a
quarter of a second.
"""
_FAR_PX = 1.0
"""Distance of a band from the map, in px of its own, that is told."""
_SATURATED = 0.02
"""Share of saturated pixels that is told."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Placing:
    """The bands of a flight that can be drawn, and what cannot be."""

    bands: list[PlacedBand]
    """By wavelength."""
    kind: Kind
    """What the values of all of them are, temperatures aside."""
    refused: dict[str, str]
    """The reason by the name of each band that is not drawn."""
    lost: list[RejectedPhoto]
    """Files that are not drawn of other bands that are; pictures of a panel do not count."""
    final: bool
    """Whether another run of the same files would leave out the same."""
    notes: list[str]
    """What the user is warned of."""
    panel: Note | None
    """How pictures of a panel are used, or why not."""


def place_bands(scene: Scene, others: Sequence[Photo], workers: Workers) -> Steps[Placing]:
    """The bands that can be drawn: those of the map's photos, if these show any, and of other
    files.
    """
    aligned, poses = scene.aligned, scene.aligned.alignment.poses
    own = bands_of_files([p for i, p in enumerate(aligned.photos) if i in poses and p.shows_a_band])
    found = bands_of_files(others)
    recorded = yield from _recorded([*own, *found], workers)
    bits, told_of_bits = depth_of([*own, *found], recorded)
    if bits:
        own, found = (tuple(with_bits(b, bits) for b in of) for of in (own, found))
        recorded = yield from _recorded([*own, *found], workers)
    # one that is gone tells nothing of its counts: all values would be as weak
    gone = {p.name: r.reason for b in own for p in b.photos if (r := recorded[p.name]).gone}
    placed = [PlacedBand(files=b, of_photo=_own_files(aligned, b)).without(gone) for b in own]
    known_tags = {p.name: t for b in own for p, t in zip(b.photos, b.tags, strict=True)}
    velocities = velocities_of(aligned.photos, aligned.alignment)
    captures = [(known_tags.get(p.name) or tags_of(p)).capture for p in aligned.photos]
    refused: dict[str, str] = {}
    lost = [RejectedPhoto(name=name, reason=why) for name, why in gone.items()]
    for done, band in enumerate(found):
        yield done, len(found), f"camera of {band.name}"
        useless = {p.name: why for p in band.photos if (why := recorded[p.name].reason)}
        lost += [RejectedPhoto(name=name, reason=why) for name, why in useless.items()]
        band = band.only([j for j, p in enumerate(band.photos) if p.name not in useless])
        together = captured_together(aligned.photos, captures, band)
        of_photo = {i: j for i, j in together.items() if i in poses}
        rigs = _rigs(scene, band, of_photo, velocities)
        known = {i: rig for i, rig in rigs.items() if isinstance(rig, BandRig)}
        reasons = {i: rig.reason for i, rig in rigs.items() if not isinstance(rig, BandRig)}
        if known:
            lost += [
                RejectedPhoto(name=band.photos[of_photo[i]].name, reason=why)
                for i, why in reasons.items()
            ]
            lost += _alone(band, {j: i for i, j in together.items()}, poses)
            of_photo = {i: of_photo[i] for i in known}
            placed.append(
                PlacedBand(files=band, of_photo=of_photo, rigs=known, velocities=velocities)
            )
        else:
            why = f"none of its files can be used: {next(iter(useless.values()), '')}"
            refused[band.name] = next(iter(reasons.values()), why)
    yield len(found), len(found), ""
    detail = relative_detail(placed, recorded)
    placed = [
        replace(b, saturated=_saturated(b, recorded), detail=typical(detail.get(b.files.name, {})))
        for b in placed
    ]
    placed.sort(key=lambda b: b.files.order)
    away = [p for i, p in enumerate(aligned.photos) if i not in poses and p.shows_a_band]
    others_away = [with_bits(b, bits) for b in bands_of_files(away)]
    placed, panel = by_panels(placed, [*own, *others_away, *found])
    bands, kind, weaker = _comparable(placed)
    notes = [f"The band {name} is left out: {reason}." for name, reason in refused.items()]
    notes += [told_of_bits] if told_of_bits else []
    notes += [note for b in placed for note in _notes(b)]
    notes += unsharp_notes(placed, detail) + weaker
    return Placing(
        bands=bands,
        kind=kind,
        refused=refused,
        lost=lost,
        final=not any(r.gone for r in recorded.values()),
        notes=notes,
        panel=panel,
    )


def _alone(band: BandFiles, beside: dict[int, int], placed: Container[int]) -> list[RejectedPhoto]:
    """The files of a band that were taken with no placed photo of the map, but for pictures of a
    panel.
    """
    alone = without_partner(band.photos, beside, placed, "photo of the map")
    panels = {p.name for p, t in zip(band.photos, band.tags, strict=True) if t.panel}
    return [r for r in alone if r.name not in panels]


def _recorded(bands: Sequence[BandFiles], workers: Workers) -> Steps[dict[str, Recorded]]:
    """What each file recorded, by its name."""
    items = [item for b in bands for item in zip(b.photos, b.converts, strict=True)]
    found = {}
    for (photo, _), looked in zip(items, workers.each(look_at, items), strict=True):
        found[photo.name] = looked
        yield len(found), len(items), photo.name
    return found


def _own_files(aligned: AlignedPhotos, band: BandFiles) -> dict[int, int]:
    """Index of each of the map's photos -> that of the same file in a band of them."""
    number = {p.name: j for j, p in enumerate(band.photos)}
    return {i: number[p.name] for i, p in enumerate(aligned.photos) if p.name in number}


def _rigs(
    scene: Scene, band: BandFiles, of_photo: dict[int, int], velocities: dict[int, Velocity]
) -> dict[int, BandRig | RefusedRegistration]:
    """The camera of a band beside that of each of the map's photos (index)."""
    aligned = scene.aligned
    alike: dict[tuple[str, str], dict[int, int]] = {}
    for i, j in sorted(of_photo.items()):
        cameras = aligned.photos[i].camera_key, band.photos[j].camera_key
        alike.setdefault(cameras, {})[i] = j
    if not alike:  # says that none were taken together
        return {-1: _rig(scene, band, {}, velocities)}
    rigs = ((part, _rig(scene, band, part, velocities)) for part in alike.values())
    return {i: rig for part, rig in rigs for i in part}


def _rig(
    scene: Scene, band: BandFiles, of_photo: dict[int, int], velocities: dict[int, Velocity]
) -> BandRig | RefusedRegistration:
    """One camera of a band beside one of the map's photos."""
    aligned, pairs = scene.aligned, sorted(of_photo.items())
    alignment = aligned.alignment
    if any(alignment.poses[i].cam_H_map is not None for i, _ in pairs):
        return RefusedRegistration(
            reason="the map's photos have no adjusted poses; use --method bundle"
        )
    pairs = far(scene, pairs)
    seen = seen_together(scene, pairs, band.photos, velocities, MOST_PAIRS)
    if not pairs:
        return FindBandRig()(seen, Camera.ideal(width=1, height=1, focal=1.0), 0.0)
    (i, j), *_ = pairs
    first = band.photos[j]
    camera = _like(first, aligned.photos[i], alignment.camera(i))
    return FindBandRig()(seen, camera, first.focal.sigma_px / first.focal.px)


def _like(first: Photo, other: Photo, found: Camera) -> Camera:
    """What is known of the camera of a band's file beside a photo of the map whose camera was found
    so. Of cameras of one size whose focal lengths are guessed, or told in one way, one is off by
    about as much as the other.
    """
    alike = (first.width, first.height) == (other.width, other.height)
    if not alike or first.focal.source != other.focal.source or first.calibration is not None:
        return first.lens
    return replace(first.lens, focal=first.lens.focal * found.focal / other.focal.px)


def _comparable(placed: Sequence[PlacedBand]) -> tuple[list[PlacedBand], Kind, list[str]]:
    """The bands with values of the kind that all of them have, this kind, and a note where a few
    files keep all others from a better one; temperatures stay.
    """
    light = [b for b in placed if b.files.name != THERMAL]
    told = {
        b.files.photos[j].name: b.files.converts[j].kind for b in light for j in b.of_photo.values()
    }
    kind = common_kind([b.files.converts[j] for b in light for j in b.of_photo.values()])
    bands = [
        b if b.files.name == THERMAL else replace(b, files=b.files.as_kind(kind)) for b in placed
    ]
    return bands, kind, _weaker(told, kind)


def _weaker(told: dict[str, Kind], kind: Kind) -> list[str]:
    """A note on the files (by name) whose values are of the kind of all, where most have a better
    one.
    """
    those = [name for name, own in told.items() if own == kind]
    if not those or 2 * len(those) >= len(told):
        return []
    usual = sorted(told.values(), key=KINDS.index)[len(told) // 2]
    lacking = "irradiance" if kind == "radiance" else "calibration"
    return [
        f"{len(those)} of {len(told)} files tell no usable {lacking} ({those[0]} for one), so that"
        f" the values of all bands are of the kind '{kind}'; without these files they would be"
        f" '{usual}'."
    ]


def _saturated(band: PlacedBand, recorded: dict[str, Recorded]) -> float:
    """Share of saturated pixels in the files of a band that are drawn."""
    shares = [recorded[band.files.photos[j].name].saturated for j in band.of_photo.values()]
    return float(np.mean(shares)) if shares else 0.0


def _notes(band: PlacedBand) -> list[str]:
    """What is told of a band that is drawn."""
    found, name = [], band.files.name
    if band.saturated > _SATURATED:
        found.append(
            f"{band.saturated:.0%} of the pixels of the band {name} are saturated: they have no"
            " value, and no index, unless another capture has one."
        )
    off = max((r.off_px for r in band.rigs.values()), default=0.0)
    if off > _FAR_PX:
        found.append(
            f"The band {name} lies {off:.1f} px off the map's in the median: it is wrong at edges"
            f"{'' if name == THERMAL else ', and so are its indices'}."
        )
    return found
