"""Thermal photos placed by the poses and the surface of visual photos taken by the same drone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.motion import velocities_of
from skyquilt.alignment.nothing_shown import CLOSED
from skyquilt.coregistration.band_rig import FindBandRig
from skyquilt.coregistration.pictures import guess_of, of_photo
from skyquilt.coregistration.rig import FindRig, Rig, RigPair
from skyquilt.coregistration.workflow import outcome_of
from skyquilt.errors import PhotoFailedError
from skyquilt.geometry.transforms import transfer
from skyquilt.imaging.blank import Blank
from skyquilt.imaging.grey import shrink
from skyquilt.imaging.nodes import View
from skyquilt.imaging.views import make_views, on_ground
from skyquilt.model.event import Note
from skyquilt.model.photo import Photo, RejectedPhoto, Survey, evenly
from skyquilt.model.poses import Alignment, no_ties
from skyquilt.model.raster import Window
from skyquilt.model.registration import RefusedRegistration, Registration
from skyquilt.ortho.blend import Blend
from skyquilt.ortho.companions import geotransform
from skyquilt.ortho.compose import Composer
from skyquilt.ortho.drift import Drift, ground_samples
from skyquilt.ortho.exposure import NEUTRAL, Exposure
from skyquilt.ortho.ground import Ground
from skyquilt.ortho.radiometry import DriftMethod, balances_drift, drift_of, value_tags
from skyquilt.photos.left_out import told_left_out, without_partner
from skyquilt.photos.together import late_by
from skyquilt.raster import CogWriter, RasterSpec
from skyquilt.settings import PictureSettings
from skyquilt.thermal.closed_shutter import closed_frames
from skyquilt.thermal.each_ahead import beside_of, each_ahead
from skyquilt.thermal.partners import kind_of, of_one_camera, partners
from skyquilt.thermal.rig_marks import drawn, marks_in
from skyquilt.workflows.flow import Scene
from skyquilt.workflows.photo_features import THUMBNAIL, pixels_again
from skyquilt.workflows.second_camera import far, pose_beside, seen_together

MOST_PAIRS = 12
"""Most pairs that are registered, spread over the flight; each takes one or two seconds."""
KNOWN_FOCAL = 0.01
"""The thermal focal length is not estimated if its relative standard deviation is below this."""
_AGREE = 0.75
"""Share of registered pairs below which it is told that others do not agree with them."""
_BY_PATTERN = (
    "thermal photos are paired with the visual ones that say they were taken {s:.1f} s before them,"
    " by the pattern of their times; {n} of {of} are drawn from where their own pictures show that"
    " the drone was by then"
)
_TOLD_S = 0.05
"""Delay of the thermal camera that is told, s."""
_DOUBLED = (
    "the visual photo taken together with it is beside one of another thermal camera; map each"
    " thermal camera by itself"
)
"""Why photos of a second thermal camera are not drawn."""
_GRID = 6
"""Points per side of the grid from which the rotation of a registered pair is computed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rigged:
    """Thermal photos placed by the rig."""

    rig: Rig
    """The relative rotation of the cameras."""
    photos: tuple[Photo, ...]
    """Thermal photos taken at the same time as a placed visual one."""
    alignment: Alignment
    """Poses of those that can be drawn in the visual map's frame."""
    rejected: tuple[RejectedPhoto, ...] = ()
    """Those that cannot be decoded, or were not taken together with a placed visual one."""
    marks: Mapping[int, Blank] = field(default_factory=dict)
    """Where frames show marks, by their index."""
    notes: tuple[str, ...] = ()
    """What is told of these."""

    def without(self, error: PhotoFailedError) -> "Rigged":
        """The others, without the photo on which drawing failed."""
        poses = {k: p for k, p in self.alignment.poses.items() if self._name(k) != error.photo}
        alignment = replace(
            self.alignment,
            poses=poses,
            camera_of=dict.fromkeys(poses, "thermal"),
            blocks=(tuple(poses),),
        )
        bad = RejectedPhoto(name=error.photo, reason=error.reason)
        return replace(self, alignment=alignment, rejected=(*self.rejected, bad))

    def _name(self, index: int) -> str:
        return self.photos[index].name


def rigged(scene: Scene, thermal: Sequence[Photo]) -> Rigged | RefusedRegistration:
    """Places thermal photos by visual poses, or gives the reason why this is not possible."""
    visual, placed = scene.aligned.photos, scene.aligned.alignment
    found = partners(visual, thermal)
    beside, doubled = found.beside, found.doubled
    together = [(i, j) for j, i in sorted(beside.items()) if i in placed.poses]
    alone = [
        RejectedPhoto(name=p.name, reason=_DOUBLED) if p.name in doubled else p
        for p in without_partner(thermal, beside, placed.poses, "visual photo")
    ]
    bad = {j: r for _, j in together if (r := _undecodable(thermal[j])) is not None}
    pairs, other = of_one_camera(thermal, [(i, j) for i, j in together if j not in bad])
    if len(pairs) < FindRig.minimum:
        return RefusedRegistration(
            reason=f"{len(pairs)} thermal photos were taken together with a visual one, by time or"
            " name"
        )
    if any(placed.poses[i].cam_H_map is not None for i, _ in pairs):
        return RefusedRegistration(
            reason="the visual photos have no adjusted poses; use --method bundle"
        )
    first = thermal[pairs[0][1]]
    frames = [thermal[j] for _, j in pairs]
    kinds = set(map(kind_of, frames))
    if len(kinds) > 1:
        return RefusedRegistration(
            reason=f"the thermal photos are from {len(kinds)} cameras or formats"
        )
    asked = [pairs[k] for k in evenly(len(pairs), MOST_PAIRS)]
    velocity = velocities_of(visual, placed)
    gaps = late_by([visual[i] for i, _ in pairs], frames).tolist()
    late = {j: gap for (_, j), gap in zip(pairs, gaps, strict=True)}
    seen = [
        replace(p, late_s=late[j])
        for i, j in asked
        if (p := _registered(scene, i, thermal[j], velocity[i])) is not None
    ]
    rig = FindRig(free=_freedom(first), told_s=found.delay_s)(seen, first.lens)
    if not (isinstance(rig, Rig) and rig.timed):
        late = dict.fromkeys(late, 0.0)
    said = ""
    ahead = {j: late[j] * (placed.poses[i].cam_R_map @ velocity[i]) for i, j in pairs}
    if found.by_pattern and isinstance(rig, Rig):
        ahead |= each_ahead(scene, asked, thermal, velocity, ahead, rig, rough=True)
    if isinstance(rig, Rig) or len(seen) < FindRig.minimum:  # else pairs contradict each other
        rig = _with_lens(scene, thermal, pairs, velocity, ahead, rig)
    if isinstance(rig, RefusedRegistration):
        return rig
    if found.by_pattern:
        own = each_ahead(scene, pairs, thermal, velocity, ahead, rig)
        if len(own) < _AGREE * len(pairs):
            return RefusedRegistration(
                reason=f"{len(own)} of {len(pairs)} thermal photos, released apart from the visual"
                " ones, show what the thermal camera saw where the drone was by then"
            )
        ahead |= own
        said = _BY_PATTERN.format(s=found.apart_s, n=len(own), of=len(pairs))
    poses = {
        k: pose_beside(placed.poses[i], rig, velocity[i], ahead[j])
        for k, (i, j) in enumerate(pairs)
    }
    alignment = Alignment(
        method="rig",
        why="both cameras were on the same drone",
        frame=placed.frame,
        poses=poses,
        cameras={"thermal": rig.camera_b},
        camera_of=dict.fromkeys(poses, "thermal"),
        blocks=(tuple(poses),),
        ties=no_ties(),
    )
    photos = tuple(thermal[j] for _, j in pairs)
    left = (*bad.values(), *other, *alone)
    result = Rigged(rig=rig, photos=photos, alignment=alignment, rejected=left)
    return _open(replace(result, notes=(said,) if said else ()), scene.ground)


def _open(found: Rigged, ground: Ground) -> Rigged:
    """The frames taken while the thermal camera's shutter was open, and where they show marks."""
    views = _views(found, ground)
    try:
        frames = _thumbnails(found, views)
    except PhotoFailedError:  # told when it is drawn
        return found
    marks, said = marks_in(found.photos, views, frames, ground)
    found = replace(found, marks=marks, notes=(*found.notes, *said))
    samples = ground_samples(views, frames, ground.surface, ground.grid.bounds, Drift.points)
    shut = closed_frames(samples)
    if len(views) - len(shut) < FindRig.minimum:
        return found
    for k in sorted(shut):
        found = found.without(PhotoFailedError(found.photos[views[k].photo].name, CLOSED))
    return found


def _with_lens(
    scene: Scene,
    thermal: Sequence[Photo],
    pairs: Sequence[tuple[int, int]],
    velocity: Mapping[int, NDArray[np.float64]],
    ahead: Mapping[int, NDArray[np.float64]],
    rig: Rig | RefusedRegistration,
) -> Rig | RefusedRegistration:
    """The rig with the lens of the thermal camera, from patches of pairs (index of the visual
    photo, of the thermal one); `ahead`: of the latter (`Together.ahead`); `rig`: what whole
    pictures tell, which is kept where patches tell nothing. A strong lens keeps these from being
    registered by a homography.
    """
    first = thermal[pairs[0][1]]
    seen = seen_together(
        scene, far(scene, pairs), thermal, velocity, MOST_PAIRS, ahead=ahead, coloured=True
    )
    near = beside_of(rig) if isinstance(rig, Rig) else None
    found = FindBandRig()(seen, first.lens, first.focal.sigma_px / first.focal.px, near)
    if isinstance(found, RefusedRegistration):
        return rig
    if isinstance(rig, RefusedRegistration):
        agreeing, among, spread_deg = found.agreeing, found.pairs, 0.0
    else:
        agreeing, among, spread_deg = rig.agreeing, rig.pairs, rig.spread_deg
    return Rig(
        b_R_a=found.b_R_a,
        a_t_b=found.a_t_b,
        camera_b=found.camera,
        delay_s=found.delay_s,
        timed=isinstance(rig, Rig) and rig.timed,
        agreeing=agreeing,
        pairs=among,
        spread_deg=spread_deg,
    )


def _undecodable(photo: Photo) -> RejectedPhoto | None:
    """Why a frame cannot be drawn; None if it can be. Frames are small: they are decoded again when
    they are drawn.
    """
    try:
        pixels_again(photo)
    except PhotoFailedError as error:
        return RejectedPhoto(name=photo.name, reason=error.reason)
    return None


def _freedom(photo: Photo) -> float:
    """Relative uncertainty of the focal length: three standard deviations."""
    if photo.calibration is not None or photo.focal.sigma_px < KNOWN_FOCAL * photo.focal.px:
        return 0.0
    return float(min(3 * photo.focal.sigma_px / photo.focal.px, 1.0))


def _registered(
    scene: Scene, index: int, thermal: Photo, velocity: NDArray[np.float64]
) -> RigPair | None:
    """Correspondences over the overlap of two photos taken at the same time; None if they cannot be
    registered, or one of them cannot be read any more.
    """
    try:
        a = of_photo(scene.aligned.photos[index], scene.aligned.pixels(index))
        b = of_photo(thermal, pixels_again(thermal))
    except PhotoFailedError:  # told when it is drawn; the visual map shows its own already
        return None
    outcome = outcome_of(a, b, "auto", guess_of(a, b))
    if not isinstance(outcome, Registration):
        return None
    x, y = np.meshgrid(
        *(np.linspace(0.05, 0.95, _GRID, dtype=np.float64) * size for size in (b.width, b.height))
    )
    px_b = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    px_a = transfer(np.asarray(np.linalg.inv(outcome.b_H_a), np.float64), px_b)
    inside = ((px_a > 0) & (px_a < [a.width - 1, a.height - 1])).all(1)
    if inside.sum() < _GRID:
        return None
    camera, pose = scene.aligned.alignment.camera(index), scene.aligned.alignment.poses[index]
    view = View(photo=index, camera=camera, pose=pose, footprint=np.zeros((0, 2)))
    away = np.linalg.norm(on_ground(view, px_a[inside], scene.ground.surface) - pose.map_C, axis=1)
    return RigPair(
        px_a=px_a[inside],
        px_b=px_b[inside],
        camera_a=camera,
        pace=(pose.cam_R_map @ velocity) / away[:, None],
    )


def drift_of_rigged(
    found: Rigged, scene: Scene, drift: DriftMethod, settings: PictureSettings
) -> Exposure:
    """The offsets that bring the thermal frames to a common level, if requested."""
    unit, ground = found.photos[0].unit, scene.ground
    if not balances_drift(settings, unit):
        return NEUTRAL
    views = _views(found, ground)
    frames = _thumbnails(found, views)
    return drift_of(views, frames, ground.surface, ground.grid.bounds, unit, drift, settings)


def _thumbnails(found: Rigged, views: Sequence[View]) -> dict[int, NDArray[Any]]:
    return {v.photo: shrink(pixels_again(found.photos[v.photo]), THUMBNAIL)[0] for v in views}


def _views(
    found: Rigged, ground: Ground, marks: Mapping[int, Blank] = MappingProxyType({})
) -> list[View]:
    """What the thermal frames see within the limits of the visual photos, but for `marks`."""
    limits = replace(ground.limits, blanks=marks, marks={})
    return make_views(found.alignment, ground.surface, limits)


def draw_rigged(
    path: Path, found: Rigged, scene: Scene, blend: Blend, exposure: Exposure = NEUTRAL
) -> None:
    """thermal.tif on the visual map's grid and surface, values are only resampled, apart from the
    drift correction.
    """
    first, grid = found.photos[0], scene.ground.grid
    kind, real = np.dtype(first.dtype), np.dtype(first.dtype).kind == "f"
    plain = Composer(
        grid=grid,
        views=_views(found, scene.ground),
        surface=scene.ground.surface,
        blend=blend,
        pixels=lambda i: pixels_again(found.photos[i]),
        bands=first.channels,
        dtype=kind,
        exposure=exposure,
    )
    marked = plain if found.marks else None
    unmarked = replace(plain, views=_views(found, scene.ground, found.marks)) if marked else plain
    spec = RasterSpec(
        width=grid.width,
        height=grid.height,
        bands=first.channels,
        dtype=kind.name,
        transform=geotransform(grid, found.alignment),
        crs=found.alignment.frame.crs,
        compress="deflate",
        nodata=float("nan") if real else None,
        mask=not real,
        band_units=(first.unit,) * first.channels if first.unit else (),
        tags={"SOFTWARE": "Skyquilt"} | value_tags(first.unit, exposure),
    )
    with CogWriter(path, spec) as writer:
        for block in writer.blocks():
            window = Window(
                row=block.row0, column=block.col0, height=block.height, width=block.width
            )
            writer.write_block(block, *drawn(window, unmarked, marked))


def rig_notes(found: Rigged) -> list[Note]:
    """What is told of how both cameras go together, and of photos that are not drawn."""
    rig, used = found.rig, len(found.alignment.poses)
    few = len(found.rejected) > used
    notes = [Note(text=text, warning=few) for text in told_left_out(found.rejected)]
    notes += [Note(text=text) for text in found.notes]
    if few:
        text = (
            f"only {used} of {used + len(found.rejected)} thermal photos are drawn, by the poses"
            " of the visual ones; --thermal-route maps uses the others, too"
        )
        notes.append(Note(text=text, warning=True))
    if abs(rig.delay_s) > _TOLD_S:
        when = f"{abs(rig.delay_s):.2f} s {'later' if rig.delay_s > 0 else 'earlier'}"
        text = (
            f"thermal photos were taken {when} than the visual ones beside them, by what both show;"
            " they are drawn from where the drone was then"
        )
        notes.append(Note(text=text))
    if rig.agreeing < _AGREE * rig.pairs:
        text = (
            f"{rig.pairs - rig.agreeing} of {rig.pairs} pairs of photos taken together show the"
            " thermal camera turned otherwise than the others do: such photos lie beside their"
            " place in thermal.tif; --thermal-route maps registers the whole map instead"
        )
        notes.append(Note(text=text, warning=True))
    return notes


def rig_figures(found: Rigged, thermal: Survey) -> dict[str, Any]:
    """The entry `thermal` of metrics.json."""
    rig, first = found.rig, found.photos[0]
    return {
        "route": "rig",
        "routes_refused": {},
        "unit": first.unit,
        "thermal_H_visual": np.eye(3).tolist(),
        "model": "rotation",
        "inliers": rig.agreeing,
        "evidence": {
            "pairs": rig.pairs,
            "pairs_agreeing": rig.agreeing,
            "spread_deg": round(rig.spread_deg, 4),
            "focal_px": round(rig.camera_b.focal, 2),
            "k1": round(rig.camera_b.k1, 4),
            "delay_s": round(rig.delay_s, 3),
        },
        "thermal_R_visual": rig.b_R_a.tolist(),
        "photos_used": len(found.alignment.poses),
        "photos_total": len(thermal.photos) + len(thermal.rejected),
        "photos_rejected": {p.name: p.reason for p in (*thermal.rejected, *found.rejected)},
    }
