"""The ground of a map: heights, the view of each photo, and the map's grid."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.clock import CountedParts, Steps, apart
from skyquilt.engine.kept import Keep
from skyquilt.engine.store import Store, digest
from skyquilt.engine.workers import HERE, Workers
from skyquilt.errors import SideFileError, UsageError
from skyquilt.imaging.blank import Blank, find_blanks
from skyquilt.imaging.nodes import View
from skyquilt.imaging.view_limits import USUAL, ViewLimits, limits_for
from skyquilt.imaging.views import grid_of, make_views, native_gsd
from skyquilt.model.poses import Alignment
from skyquilt.model.raster import Bounds, Grid
from skyquilt.model.surface import Surface
from skyquilt.ortho.earlier import EarlierMap, Growth, growth
from skyquilt.ortho.tie_surface import level
from skyquilt.settings import PictureSettings

GreyPicture = Callable[[int, int], NDArray[np.uint8]]
"""Gives the grey image of a photo (index), with at most the given px on its longest side."""

NONE: Mapping[int, Blank] = {}
"""No photo has marks."""
ALIGNED = 64
"""The map reaches further west and north than tie points told by multiples of so many pixels, so
that cells of seams stay where they are.
"""
FINEST = 20
"""Largest number of map pixels per photo pixel, along a side."""
MOST_PIXELS = 4e11
"""Largest map in pixels."""
WIDEST_M = 200_000.0
"""Largest width of a map in m: more than any drone flies."""


class SurfaceFromTies(Protocol):
    """Heights from tie points."""

    def __call__(self, xyz: NDArray[Any], bounds: tuple[float, float, float, float]) -> Surface:
        """The surface over bounds (west, south, east, north in m) from points (n, 3) in m."""
        ...


class SurfaceFromPictures(Protocol):
    """Heights refined by image matching."""

    def __call__(
        self, surface: Surface, views: Sequence[View], grid: Grid, grey: GreyPicture, keep: Keep, /
    ) -> Surface:
        """The surface with refined heights where images determine them; `keep`: for methods that
        resume at a part of their result, and its workers for parts that do not depend
        on one another.
        """
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """Heights, views and grid of a map."""

    surface: Surface
    """Heights."""
    views: tuple[View, ...]
    """The view of each placed photo."""
    grid: Grid
    """The map's pixels."""
    native_gsd: float
    """Median ground size of a photo pixel in m."""
    limits: ViewLimits = USUAL
    """What the photos may show."""
    growth: Growth | None = None
    """The earlier map that it continues; None = all is made anew."""
    key: str = ""
    """Key of the surface in the store."""
    notes: tuple[str, ...] = ()
    """Messages for the user."""


def find_ground(
    alignment: Alignment,
    grey: GreyPicture,
    ties: SurfaceFromTies,
    sweep: SurfaceFromPictures | None,
    picture: PictureSettings,
    store: Store,
    workers: Workers = HERE,
    *,
    pictures: tuple[Any, ...] = (),
    earlier: EarlierMap | None = None,
    see_through: Collection[int] = (),
    marks: Mapping[int, Blank] = NONE,
) -> Steps[Ground]:
    """Heights from tie points (level ground if there are none), refined by the sweep if one is
    given, and the grid of the map. `pictures` describes how the grey images are made; it is part of
    the key under which a swept surface is stored. Away from photos that changed, the heights of an
    `earlier` map stay. `see_through`: photos (indices) with an alpha channel;
    `marks`: where photos show marks.

    Raises:
        UsageError: the map would have no pixels, or far too many.
    """
    yield 0, 1
    xyz = alignment.ties.xyz
    flat = level(alignment.ground_m)
    blanks, notes = blanks_of(alignment, see_through, grey)
    limits = view_limits(alignment, flat, picture.max_view_angle)
    limits = replace(limits, blanks=blanks, marks=marks)
    rough = make_views(alignment, flat, limits)
    if not rough:
        raise UsageError(
            "no photo shows ground that is seen at less than"
            f" {picture.max_view_angle:g} degrees from the vertical (--max-view-angle): as placed,"
            f" half of the photos look {_usual_tilt_deg(alignment):.0f} degrees or more away from"
            " straight down; check their gimbal angles with `skyquilt inspect`"
        )
    native = native_gsd(_most_shown(rough), flat)
    gsd = picture.gsd_cm / 100 if picture.gsd_cm else round_gsd(native)
    gsd = gsd if earlier is None else earlier.grid.gsd
    bounds = _local_bounds(picture, alignment)
    _check_place(bounds, rough, picture, alignment, gsd)
    wide = grid_of(rough, gsd, bounds)
    _check_size(wide, native)
    area = _widened(wide.bounds, 0.05 * max(wide.width, wide.height) * gsd)
    key = digest(xyz, area, ties)
    surface = store.get_or("surface", key, lambda: ties(xyz, area) if len(xyz) > 3 else flat)
    views = tuple(make_views(alignment, surface, limits))
    grid = grid_of(views, gsd, bounds)
    grows = None
    if earlier is not None:
        before = make_views(earlier.alignment, earlier.surface, limits)
        grows = growth(earlier, alignment, views, before)
        grid = grid if grows is None else grows.grown(grid)
    if len(xyz) > 3 and (sweep is not None or grows is not None):
        held, known = set(alignment.held), surface
        key = digest(
            key,
            poses_digest(alignment),
            grid,
            sweep,
            sorted(held),
            pictures,
            picture.max_view_angle,
            limits_for,
            *((find_blanks, sorted(see_through)) if blanks else ()),
            *(() if grows is None else grows.key),
        )
        tied = [v for v in views if v.photo in held]

        def refined(keep: Keep) -> Surface:
            if grows is None:
                return known if sweep is None else sweep(known, tied, grid, grey, keep)

            def made(area: Bounds, part: Grid) -> Surface:
                near = grows.near(tied, area)
                if sweep is None:
                    return known
                return sweep(known, near, part, grey, keep.within(f"{area}"))

            return grows.surface(grid, made)

        def told(tell: Callable[[str], None]) -> Surface:
            keep = replace(store.parts("surface", key, workers), told=tell)
            return store.get_or("surface", key, lambda: refined(keep))

        surface = yield from apart(told, CountedParts())
        views = tuple(make_views(alignment, surface, limits))
        # ground at a rim that is lower than its tie points told reaches further
        reach = grid_of(views, gsd, bounds)
        grid = grid.reaching(reach, ALIGNED) if grows is None else grows.grown(reach)
    yield 1, 1
    return Ground(
        surface=surface,
        views=views,
        grid=grid,
        native_gsd=native,
        limits=limits,
        growth=grows,
        key=key,
        notes=notes,
    )


def _most_shown(views: Sequence[View]) -> Sequence[View]:
    """The views that yield to others on less than half of their picture: the map's pixels are as
    large as theirs. All, where each yields.
    """
    marks = [v.limits.mark for v in views]
    shown = [v for v, m in zip(views, marks, strict=True) if m is None or (m.room < 0).mean() < 0.5]
    return shown or views


def blanks_of(
    alignment: Alignment, see_through: Collection[int], grey: GreyPicture
) -> tuple[dict[int, Blank], tuple[str, ...]]:
    """Where placed photos show nothing, by index, and notes on them; the rest as in
    `find_blanks`.
    """
    cameras = {}
    for i in sorted(alignment.poses):
        camera = alignment.camera(i)
        cameras[i] = alignment.camera_of[i], (camera.width, camera.height)
    return find_blanks(cameras, see_through, grey)


def view_limits(alignment: Alignment, flat: Surface, angle_deg: float) -> ViewLimits:
    """What the photos of an alignment may show; photos without tie points support heights below
    themselves.
    """
    C = np.array([p.map_C for p in alignment.poses.values()]).reshape(-1, 3)
    above = C[:, 2] - flat.at(C[:, 0], C[:, 1])
    focal = np.array([alignment.camera(i).focal for i in alignment.poses])
    loose = [alignment.poses[i].map_C[:2] for i in set(alignment.poses) - set(alignment.held)]
    gsd = float(np.median(above / focal)) if len(C) else np.inf
    return limits_for(alignment.ties.xyz, np.array(loose), above, angle_deg, gsd)


def _widened(
    bounds: tuple[float, float, float, float], margin: float
) -> tuple[float, float, float, float]:
    west, south, east, north = bounds
    return west - margin, south - margin, east + margin, north + margin


def _check_place(
    bounds: tuple[float, float, float, float] | None,
    views: Sequence[View],
    picture: PictureSettings,
    alignment: Alignment,
    gsd: float,
) -> None:
    """Refuses an area that no photo covers, or that holds no pixel."""
    if bounds is None:
        return
    if picture.bounds is None and min(bounds[2] - bounds[0], bounds[3] - bounds[1]) < gsd:
        raise SideFileError(
            f"the area of --boundary {picture.boundary} is narrower than one pixel of the map,"
            f" {gsd * 100:.2g} cm"
        )
    if any(v.overlaps(bounds) for v in views):
        return
    outline = np.concatenate([v.footprint for v in views]) + alignment.frame.origin
    (west, south), (east, north) = outline.min(0), outline.max(0)
    frame = alignment.frame.crs or "their own frame"
    where = f"which cover {west:.0f},{south:.0f},{east:.0f},{north:.0f} in {frame}"
    if picture.bounds is not None:
        asked = ",".join(f"{b:g}" for b in picture.bounds)
        raise UsageError(f"--bounds {asked} lies outside the photos, {where}")
    raise SideFileError(
        f"the area of --boundary {picture.boundary} lies outside the photos, {where}"
    )


def _check_size(grid: Grid, native: float) -> None:
    """Refuses maps that are far finer than the photos or larger than any survey."""
    size = f"{grid.width} x {grid.height} px"
    wide = max(grid.width, grid.height) * grid.gsd
    if grid.gsd < native / FINEST and wide < WIDEST_M:
        raise UsageError(
            f"--gsd {grid.gsd * 100:g} asks for {size}, more than {FINEST} times finer than the"
            " photos,"
            f" which show {native * 100:.2g} cm per pixel; leave --gsd out or choose one near that"
        )
    if wide > WIDEST_M or grid.width * grid.height > MOST_PIXELS:
        raise UsageError(
            f"the map would be {wide / 1000:.0f} km wide, {size} at {grid.gsd * 100:g} cm: the"
            " positions of"
            " some photos (or --bounds) must be wrong; correct them with --geo, or choose a larger"
            " --gsd"
        )


def poses_digest(alignment: Alignment) -> str:
    """Digest of the parts of an alignment on which the map depends."""
    order = sorted(alignment.poses)
    placed = [(alignment.poses[i], alignment.camera(i).vector) for i in order]
    return digest(order, placed, alignment.frame)


def _usual_tilt_deg(alignment: Alignment) -> float:
    """Median angle of the photos' axes from straight down, in degrees."""
    down = [-pose.cam_R_map[2, 2] for pose in alignment.poses.values()]
    return float(np.degrees(np.arccos(np.clip(np.median(down), -1, 1))))


def round_gsd(gsd: float) -> float:
    """A ground resolution in m rounded to two digits."""
    digits = 1 - int(np.floor(np.log10(gsd)))
    return float(round(gsd, digits))


def _local_bounds(
    picture: PictureSettings, alignment: Alignment
) -> tuple[float, float, float, float] | None:
    """The requested bounds, or those of the boundary, in the map frame."""
    frame = alignment.frame
    bounds = picture.bounds
    if picture.boundary is not None and bounds is None:
        if frame.crs is None:
            raise UsageError(
                "--boundary needs a georeferenced survey, and these photos have no positions"
            )
        from skyquilt.raster.boundary import read_boundary

        bounds = read_boundary(picture.boundary, frame.crs).bounds
    if bounds is None:
        return None
    x, y = frame.origin
    return bounds[0] - x, bounds[1] - y, bounds[2] - x, bounds[3] - y
