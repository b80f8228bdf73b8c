"""Where the photos are: the method asked for, or the one that fits; nobody is left behind silently."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from skyquilt.alignment.control import control_in_frame
from skyquilt.alignment.pose import reported_camera
from skyquilt.config import Methods, MosaicSettings
from skyquilt.errors import AlignmentError
from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.model.photo import ControlPoint
from skyquilt.model.poses import Alignment, MapFrame, Pose, Prior
from skyquilt.pipelines.intake import Intake, Pictures
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
        where = "and positions place it" if positions else "but no positions: the map is not georeferenced"
        return "bundle", f"{links} links hold the photos together, {where}"
    if positions:
        return "pose", "no two photos could be linked, so each lies where its metadata say"
    raise AlignmentError(
        f"no two of {photos} photos overlap recognisably and none has a position;"
        " give positions with --geo, or photos that overlap by half or more"
    )


def place(
    intake: Intake, frame: MapFrame, priors: Sequence[Prior], links: Links, control: Sequence[ControlPoint],
    methods: Methods, settings: MosaicSettings, store: Store, pictures: Pictures,
) -> Steps[Alignment]:  # fmt: skip
    """Poses and calibration of the survey."""
    positions = sum(bool(np.isfinite(p.map_C[:2]).all()) for p in priors)
    method, why = choose_method(settings.method, len(intake.photos), len(links.links), positions)
    yield 0, 1
    alignment = store.get_or(
        "alignment", _key(intake, frame, priors, links, control, methods, method),
        lambda: _align(intake, frame, priors, links, control, methods, method, pictures),
    )  # fmt: skip
    alignment = replace(alignment, why=why)
    if method == "bundle":
        alignment = with_loose_photos(alignment, intake, priors)
    yield 1, 1
    return alignment


def _key(
    intake: Intake, frame: MapFrame, priors: Sequence[Prior], links: Links, control: Sequence[ControlPoint],
    methods: Methods, method: str,
) -> str:  # fmt: skip
    photos = [(p.digest, p.name, p.camera_key, p.focal, p.calibration, p.editor) for p in intake.photos]
    held = [(k.a, k.b, k.index_a, k.index_b) for k in links.links]
    return digest(photos, frame, list(priors), held, list(control), methods.sift, _of(methods, method))


def _of(methods: Methods, method: str) -> object:
    return {"bundle": methods.bundle, "pose": methods.by_pose, "position": methods.by_position}[method]


def _align(
    intake: Intake, frame: MapFrame, priors: Sequence[Prior], links: Links, control: Sequence[ControlPoint],
    methods: Methods, method: str, pictures: Pictures,
) -> Alignment:  # fmt: skip
    if method == "pose":
        return methods.by_pose(intake.photos, frame, priors)
    if method == "position":
        return methods.by_position(intake.photos, frame, priors)
    points = control_in_frame(control, intake.photos, frame)
    return methods.bundle(intake.photos, frame, priors, intake.features, links.links, points, pictures)


def with_loose_photos(alignment: Alignment, intake: Intake, priors: Sequence[Prior]) -> Alignment:
    """Photos that nothing links, placed by their own metadata relative to the adjusted
    ones, and named as such.
    """
    poses, cameras, camera_of = dict(alignment.poses), dict(alignment.cameras), dict(alignment.camera_of)
    rejected, blocks, notes = dict(alignment.rejected), list(alignment.blocks), list(alignment.notes)
    apart = np.array([alignment.poses[i].map_C - priors[i].map_C for i in alignment.poses]).reshape(-1, 3)
    offset = np.array([np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else 0.0 for c in apart.T])
    for i, photo in enumerate(intake.photos):
        if i in poses:
            continue
        C = priors[i].map_C + offset
        if not np.isfinite(C).all() or alignment.frame.crs is None or not np.isfinite(priors[i].yaw_deg):
            lacking = (
                "no position"
                if not np.isfinite(C[:2]).all()
                else "no height"
                if not np.isfinite(C[2])
                else "no heading"
            )
            rejected[i] = rejected.get(
                i, f"it could not be linked to the other photos, and it has {lacking} to place it by"
            )
            continue
        rejected.pop(i, None)
        R = cam_R_map_from_angles(priors[i].yaw_deg, priors[i].pitch_deg, priors[i].roll_deg)
        poses[i] = Pose(cam_R_map=R, map_C=C)
        key = photo.camera_key
        cameras.setdefault(key, reported_camera(photo))
        camera_of[i] = key
        blocks.append((i,))
        notes.append(f"{photo.name} could not be linked to any other photo; it lies where its metadata say.")
    return replace(
        alignment, poses=poses, cameras=cameras, camera_of=camera_of, rejected=rejected, blocks=tuple(blocks),
        notes=tuple(notes),
    )  # fmt: skip
