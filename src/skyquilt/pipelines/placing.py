"""Where the photos are: the method asked for, or the one that fits; nobody is left behind
silently.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from skyquilt.alignment.control import control_in_frame
from skyquilt.alignment.pose import ByMetadata, reported_camera
from skyquilt.alignment.repair import Repaired, repair
from skyquilt.config import BY_METADATA, IN_SEQUENCE, Methods, MosaicSettings
from skyquilt.errors import AlignmentError
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.model.photo import ControlPoint
from skyquilt.model.poses import Alignment, MapFrame, Pose, Prior
from skyquilt.pipelines.intake import Intake, Pictures, features_recipe
from skyquilt.pipelines.linking import Links
from skyquilt.run.clock import Steps
from skyquilt.run.store import Store, digest


def choose_method(asked: str, photos: int, links: int, positions: int) -> tuple[str, str]:
    """The method and why, one sentence."""
    if asked != "auto":
        return asked, "asked for"
    if photos == 1:
        return "pose", "one photo has nothing to be adjusted against"
    if links:
        where = (
            "and positions place it"
            if positions
            else "but no positions: the map is not georeferenced"
        )
        return "bundle", f"{links} links hold the photos together, {where}"
    if positions:
        return "pose", "no two photos could be linked, so each lies where its metadata say"
    raise AlignmentError(
        f"no two of {photos} photos overlap recognisably and none has a position;"
        " give positions with --geo, or photos that overlap by half or more"
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Known:
    """What the methods of alignment may draw on."""

    intake: Intake
    """Photos and features."""
    frame: MapFrame
    """The map's frame."""
    priors: Sequence[Prior]
    """What the metadata say."""
    links: Links
    """Verified links; none for methods that need none."""
    control: Sequence[ControlPoint]
    """Control points."""
    order: Sequence[int]
    """Photos in the order they are joined in."""
    pictures: Pictures
    """Grey pictures."""


def place(
    known: Known, methods: Methods, settings: MosaicSettings, store: Store
) -> Steps[Alignment]:
    """Poses and calibration of the survey."""
    positions = sum(bool(np.isfinite(p.map_C[:2]).all()) for p in known.priors)
    photos = known.intake.photos
    method, why = choose_method(settings.method, len(photos), len(known.links.links), positions)
    yield 0, 1
    align, part = _way(method, methods)
    repaired = repaired_metadata(known) if method in BY_METADATA and settings.repair else None
    key = _key(known, methods, (method, part, repaired))
    alignment = replace(
        store.get_or("alignment", key, lambda: align(known, methods, repaired)), why=why
    )
    if method == "bundle":
        alignment = with_loose_photos(alignment, known.intake, known.priors)
    if method in IN_SEQUENCE:
        alignment = _named(alignment, known)
    yield 1, 1
    return alignment


def _key(known: Known, methods: Methods, way: object) -> str:
    photos = [
        (p.digest, p.name, p.camera_key, p.focal, p.calibration, p.editor)
        for p in known.intake.photos
    ]
    held = [(k.a, k.b, k.index_a, k.index_b) for k in known.links.links]
    return digest(
        photos,
        known.frame,
        list(known.priors),
        held,
        list(known.control),
        features_recipe(methods),
        list(known.order),
        way,
    )


Align = Callable[[Known, Methods, Repaired | None], Alignment]


def _way(method: str, methods: Methods) -> tuple[Align, object]:
    """How a method aligns, and its parameters."""
    return {
        "bundle": (_bundle, methods.bundle),
        "pose": (_pose, methods.by_pose),
        "position": (_position, methods.by_position),
        "image": (_image, methods.by_image),
        "hybrid": (_hybrid, (methods.by_pose, methods.hybrid)),
        "flightline": (_flightline, methods.by_flightline),
    }[method]


def repaired_metadata(known: Known) -> Repaired | None:
    """What the metadata say where the pixels of links do not contradict; None without links."""
    if not known.links.links:
        return None
    convergence = known.frame.convergence_deg
    return repair(
        known.intake.photos, known.priors, known.intake.features, known.links.links, convergence
    )


def _bundle(known: Known, methods: Methods, repaired: Repaired | None) -> Alignment:
    photos = known.intake.photos
    points = control_in_frame(known.control, photos, known.frame)
    return methods.bundle(
        photos,
        known.frame,
        known.priors,
        known.intake.features,
        known.links.links,
        points,
        known.pictures,
    )


def _pose(known: Known, methods: Methods, repaired: Repaired | None) -> Alignment:
    return _by_metadata(methods.by_pose, known, repaired)


def _position(known: Known, methods: Methods, repaired: Repaired | None) -> Alignment:
    return _by_metadata(methods.by_position, known, repaired)


def _by_metadata(method: ByMetadata, known: Known, repaired: Repaired | None) -> Alignment:
    if repaired is None:
        return method(known.intake.photos, known.frame, known.priors)
    placed = method(known.intake.photos, known.frame, repaired.priors, repaired.heights_m)
    return replace(placed, notes=(*placed.notes, *repaired.notes))


def _image(known: Known, methods: Methods, repaired: Repaired | None) -> Alignment:
    from skyquilt.alignment.overview import ByOverview
    from skyquilt.twoview.levelled import Level

    photos, features, method = known.intake.photos, known.intake.features, methods.by_image
    assert method is not None, "configured where it is asked for"
    if isinstance(method.level, Level) and method.level.height_m is None:
        method = replace(method, level=replace(method.level, height_m=_least_height(known)))
    if isinstance(method, ByOverview):
        return method(photos, known.frame, known.priors, features, known.order, known.pictures)
    return method(photos, known.frame, known.priors, features, known.order)


def _least_height(known: Known) -> float | None:
    """Least height above take-off in m, which stands for that above ground in (4.9); None where
    none is reported.
    """
    heights = np.array([p.map_C[2] for p in known.priors])
    known_heights = heights[np.isfinite(heights) & (heights > 1)]
    takeoff = known.frame.vertical_datum == "takeoff"
    return float(known_heights.min()) if takeoff and len(known_heights) else None


def _hybrid(known: Known, methods: Methods, repaired: Repaired | None) -> Alignment:
    placed = _by_metadata(methods.by_pose, known, repaired)
    priors = known.priors if repaired is None else repaired.priors
    assert methods.hybrid is not None, "configured where it is asked for"
    return methods.hybrid(placed, known.intake.photos, priors, known.order, known.pictures)


def _flightline(known: Known, methods: Methods, repaired: Repaired | None) -> Alignment:
    assert methods.by_flightline is not None, "configured where it is asked for"
    return methods.by_flightline(
        known.intake.photos, known.frame, known.priors, known.intake.features, known.order
    )


def _named(alignment: Alignment, known: Known) -> Alignment:
    """With a reason for photos that the sequence does not name."""
    missing = set(range(len(known.intake.photos))) - set(known.order)
    reasons = dict.fromkeys(missing, "the sequence does not name it")
    return replace(alignment, rejected={**alignment.rejected, **reasons})


def with_loose_photos(alignment: Alignment, intake: Intake, priors: Sequence[Prior]) -> Alignment:
    """Photos that nothing links, placed by their own metadata relative to the adjusted
    ones, and named as such.
    """
    poses, cameras, camera_of = (
        dict(alignment.poses),
        dict(alignment.cameras),
        dict(alignment.camera_of),
    )
    rejected, blocks, notes = (
        dict(alignment.rejected),
        list(alignment.blocks),
        list(alignment.notes),
    )
    apart = np.array([alignment.poses[i].map_C - priors[i].map_C for i in alignment.poses]).reshape(
        -1, 3
    )
    offset = np.array(
        [np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else 0.0 for c in apart.T]
    )
    for i, photo in enumerate(intake.photos):
        if i in poses:
            continue
        C = priors[i].map_C + offset
        if (
            not np.isfinite(C).all()
            or alignment.frame.crs is None
            or not np.isfinite(priors[i].yaw_deg)
        ):
            lacking = (
                "no position"
                if not np.isfinite(C[:2]).all()
                else "no height"
                if not np.isfinite(C[2])
                else "no heading"
            )
            rejected[i] = rejected.get(
                i,
                f"it could not be linked to the other photos, and it has {lacking} to place it by",
            )
            continue
        rejected.pop(i, None)
        R = cam_R_map_from_angles(priors[i].yaw_deg, priors[i].pitch_deg, priors[i].roll_deg)
        poses[i] = Pose(cam_R_map=R, map_C=C)
        key = photo.camera_key
        cameras.setdefault(key, reported_camera(photo))
        camera_of[i] = key
        blocks.append((i,))
        notes.append(
            f"{photo.name} could not be linked to any other photo; it lies where its metadata say."
        )
    return replace(
        alignment,
        poses=poses,
        cameras=cameras,
        camera_of=camera_of,
        rejected=rejected,
        blocks=tuple(blocks),
        notes=tuple(notes),
    )
