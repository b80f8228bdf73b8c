"""Block adjustment in the background: a whole block, or a large part of it, is adjusted in a
separate process.

The main process continues in the meantime. Photos that it places during the job move with their
neighbours when the result is applied.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.local_adjustment import AdjustedWindow, LocalAdjustment, Window
from skyquilt.alignment.oblique_start import tilt_warnings
from skyquilt.engine.background import Background
from skyquilt.engine.clock import result_of
from skyquilt.engine.store import Store
from skyquilt.errors import AlignmentError, SkyquiltError
from skyquilt.live.kept_frame import in_frame_of
from skyquilt.live.ledger import Ledger
from skyquilt.live.links import link_from
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, MapFrame, Pose, Prior
from skyquilt.model.surface import Surface
from skyquilt.ortho.exposure import NEUTRAL, Exposure
from skyquilt.ortho.ground import Ground, find_ground
from skyquilt.ortho.radiometry import Levelling
from skyquilt.ortho.tie_surface import without_outliers
from skyquilt.photos.pixels import read_color
from skyquilt.settings import PictureSettings
from skyquilt.workflows.methods import Methods
from skyquilt.workflows.photo_features import (
    GreyPictures,
    PhotoFeatures,
    features_key,
    picture_recipe,
)

QUICK = Bundle(per_photo=150, match_observations=None, thorough=False)
"""Adjusts blocks that are soon adjusted again."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AdjustmentJob:
    """Input of one block adjustment."""

    ids: tuple[int, ...]
    """Numbers of the photos, ascending."""
    held: frozenset[int]
    """Those of `ids` whose poses are held fixed; empty = the whole block is adjusted, including the
    camera calibration.
    """
    photos: tuple[Photo, ...]
    """Their files."""
    priors: tuple[Prior, ...]
    """Their metadata."""
    frame: MapFrame
    """The map's frame."""
    poses: dict[int, Pose]
    """Current poses."""
    cameras: dict[str, Camera]
    """Camera calibrations, by name."""
    camera_of: dict[int, str]
    """Name of each photo's calibration."""
    ground: float
    """Height of the ground in m."""
    folder: Path
    """The survey's folder; links and features are read from it."""
    store: Path
    """The store's folder."""
    methods: Methods
    """The methods with which features were found."""
    thorough: bool
    """Whether it is adjusted as in the batch workflow, with what users must know of it; otherwise
    in a third of the time, as photos arrive, and it is soon adjusted again.
    """
    sweep: bool
    """Whether ground heights are also computed from the images, and shadows of clouds are looked
    for, as in the batch workflow.
    """
    most_view_deg: float = 90.0
    """Angle from the nadir up to which photos are drawn."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockAdjustment:
    """Result of one block adjustment."""

    ids: tuple[int, ...]
    """The photos of the job."""
    poses: dict[int, Pose]
    """New poses."""
    cameras: dict[str, Camera]
    """New calibrations; empty if only part of a block was adjusted."""
    camera_of: dict[int, str]
    """Name of the calibration of each moved photo."""
    xyz: NDArray[np.float64]
    """(P, 3) ground points in m."""
    rejected: dict[int, str] = field(default_factory=dict)
    """Photos that could not be held, with reasons."""
    notes: tuple[str, ...] = ()
    """What users of a map of these photos must know; empty if it was not adjusted thoroughly."""
    exposure: Exposure = NEUTRAL
    """Brightness of photos that show shadows of clouds, and of those around them, by number;
    neutral where there are none, or none were looked for.
    """
    before: dict[int, Pose] = field(default_factory=dict)
    """Poses when the job began."""
    problem: str = ""
    """Why there is no result; empty where there is one."""


def adjust_block(job: AdjustmentJob) -> BlockAdjustment:
    """Runs the adjustment."""
    try:
        ledger = Ledger(job.folder, write=False)
        try:
            links = _links(job, ledger)
        finally:
            ledger.close()
        registry = {c.__name__: c for c in (PhotoFeatures, Features, Surface)}
        store = Store(folder=job.store, registry=registry, within=job.folder)
        features = [_look(p, store, job.methods).features for p in job.photos]
        done = _part(job, links, features) if job.held else _whole(job, links, features, store)
        return replace(done, before=job.poses)
    except (AlignmentError, SkyquiltError, np.linalg.LinAlgError, ValueError) as error:
        return _nothing(job.ids, str(error))


def _nothing(ids: tuple[int, ...], problem: str) -> BlockAdjustment:
    return BlockAdjustment(
        ids=ids, poses={}, cameras={}, camera_of={}, xyz=np.zeros((0, 3)), problem=problem
    )


def _look(photo: Photo, store: Store, methods: Methods) -> PhotoFeatures:
    looked = store.get("features", features_key(photo, methods.detector))
    if looked is None:
        raise AlignmentError(f"the features of {photo.name} are missing from the store")
    found: PhotoFeatures = looked
    return found


def _links(job: AdjustmentJob, ledger: Ledger) -> list[Link]:
    where = {i: k for k, i in enumerate(job.ids)}
    links = []
    for i in job.ids:
        for a, b, body in ledger.rows(
            "select a, b, body from link where a = ? and body is not null order by b", i
        ):
            if b in where:
                links.append(replace(link_from(body), a=where[a], b=where[b]))
    return links


def _whole(
    job: AdjustmentJob, links: Sequence[Link], features: Sequence[Features], store: Store
) -> BlockAdjustment:
    pictures = GreyPictures(job.photos, lambda i: read_color(job.photos[i]), store)
    bundle = Bundle() if job.thorough else QUICK
    done = bundle(job.photos, job.frame, job.priors, features, links, (), pictures)
    if job.frame.crs is None:
        before = {k: job.poses[i] for k, i in enumerate(job.ids) if i in job.poses}
        held = in_frame_of(done, before, job.ground)
        if held is None:
            raise AlignmentError("it does not fit the map, which has no place")
        done = held
    xyz, exposure = without_outliers(done.ties.xyz), NEUTRAL
    if job.sweep:
        ground = _ground(done, pictures, job, store)
        xyz, exposure = _swept(ground), _clouded(ground, job, store)
    return BlockAdjustment(
        ids=job.ids,
        poses={job.ids[k]: p for k, p in done.poses.items()},
        cameras=dict(done.cameras),
        camera_of={job.ids[k]: done.camera_of[k] for k in done.poses},
        xyz=xyz,
        exposure=exposure,
        rejected={job.ids[k]: why for k, why in done.rejected.items()},
        notes=(*done.notes, *tilt_warnings(job.priors, done, job.most_view_deg))
        if job.thorough
        else (),
    )


def _ground(done: Alignment, pictures: GreyPictures, job: AdjustmentJob, store: Store) -> Ground:
    """The ground of the batch workflow."""
    methods = job.methods
    return result_of(
        find_ground(
            done,
            pictures,
            methods.surface,
            methods.sweep,
            PictureSettings(),
            store,
            pictures=picture_recipe(),
        )
    )


def _swept(ground: Ground) -> NDArray[np.float64]:
    """(P, 3) ground points in m: the surface at the nodes of its grid below the photos."""
    surface = ground.surface
    rows, columns = np.mgrid[: surface.z.shape[0], : surface.z.shape[1]]
    xyz = np.column_stack(
        [
            surface.x0 + columns.ravel() * surface.cell,
            surface.y0 + rows.ravel() * surface.cell,
            surface.z.ravel(),
        ]
    )
    seen = np.zeros(surface.z.shape, np.uint8)
    for view in ground.views:
        corners = (view.footprint - (surface.x0, surface.y0)) / surface.cell
        cv2.fillPoly(seen, [np.rint(corners).astype(np.int32)], 1)
    return np.asarray(xyz[seen.ravel() > 0], np.float64)


def _clouded(ground: Ground, job: AdjustmentJob, store: Store) -> Exposure:
    """The photos' exposure as in the batch workflow, by number, where shadows of clouds are found;
    neutral otherwise, and for photos that are not in colours.
    """
    photos = [job.photos[v.photo] for v in ground.views]
    if any(p.unit or p.dtype != "uint8" or p.channels != 3 for p in photos):
        return NEUTRAL
    small = {
        v.photo: _look(job.photos[v.photo], store, job.methods).thumbnail for v in ground.views
    }
    levelled = Levelling(
        unit="",
        dtype="uint8",
        thumbnails=small,
        balance=job.methods.balance.under(NEUTRAL.white),
        drift=job.methods.drift,
        settings=PictureSettings(),
        mixed=any(p.saved_grey for p in photos),
    )
    found = levelled(ground)
    if not found.shades:
        return NEUTRAL
    gains, fields, shades = (
        {job.ids[k]: v for k, v in of.items()} for of in (found.gains, found.fields, found.shades)
    )
    return Exposure(gains=gains, fields=fields, shades=shades)


def _part(
    job: AdjustmentJob, links: Sequence[Link], features: Sequence[Features]
) -> BlockAdjustment:
    where = {i: k for k, i in enumerate(job.ids)}
    free = next(i for i in job.ids if i not in job.held)
    window = Window(
        photos=job.photos,
        priors=job.priors,
        features=features,
        links=links,
        poses={where[i]: p for i, p in job.poses.items()},
        cameras=job.cameras,
        camera_of={where[i]: c for i, c in job.camera_of.items()},
        new=where[free],
        held=frozenset(where[i] for i in job.held),
        ground=job.ground,
        sigma_xy=0.0,
    )
    done = LocalAdjustment(per_photo=60)(window)
    if not isinstance(done, AdjustedWindow):
        raise AlignmentError(done.reason)
    moved = {job.ids[k]: p for k, p in done.poses.items()}
    return BlockAdjustment(
        ids=job.ids,
        poses=moved,
        cameras={},
        camera_of={i: job.camera_of[i] for i in moved},
        xyz=without_outliers(done.xyz),
    )


class BackgroundAdjustment:
    """Runs at most one adjustment job at a time in the background."""

    def __init__(self) -> None:
        self._work: Background[BlockAdjustment] | None = None

    @property
    def busy(self) -> bool:
        """Whether a job is running, or its result has not been fetched yet."""
        return self._work is not None

    def start(self, job: AdjustmentJob) -> None:
        """Starts a job."""
        self._work = Background(adjust_block, job)

    def outcome(self) -> BlockAdjustment | None:
        """The result of the job; None while it runs. After this returns a result, another job may
        start.
        """
        if self._work is None or self._work.busy:
            return None
        done = self._work.outcome()
        self.stop()
        return done or _nothing((), "its process ended early")

    def stop(self) -> None:
        """Ends the job, if there is one."""
        if self._work is not None:
            self._work.stop()
            self._work = None
