"""The workflow of `depth`: heights on the map grid, by one of three methods of the thesis
[Yahyanejad 2013, 5.2.3].

    pair             two photos: disparities of every pixel along the baseline
    disparities      disparities of the features of all linked pairs after their homographies,
                     signed along and normalised by their baselines, merged on the map; of two
                     photos it is the thesis's way for a pair
    reconstruction   the heights of the whole adjustment, projected on the plane (5.8)

The photos are placed as by `mosaic`, so depth.tif fits the map.
"""

import json
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt import registry
from skyquilt.depth.dense_pair import dense_heights
from skyquilt.depth.files import (
    FILES,
    PAIRS,
    false_colour,
    field_name,
    field_picture,
    former_fields,
    write_depth,
    write_png,
)
from skyquilt.depth.page import depth_page
from skyquilt.depth.pairs import NoField, OnePlane, PairField, pair_field
from skyquilt.engine.clock import Clock, Steps
from skyquilt.engine.folder import STATE, claimed
from skyquilt.engine.store import Store
from skyquilt.engine.workers import Threads
from skyquilt.errors import PhotoFailedError, RefusedError, UsageError
from skyquilt.model.event import Event, Note, Result
from skyquilt.model.surface import Surface
from skyquilt.outside import remove_file
from skyquilt.raster.atomic import write_text
from skyquilt.settings import MosaicSettings, within
from skyquilt.typed import as_path, instance
from skyquilt.version import __version__
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.flow import Scene, frames_added, scene_of
from skyquilt.workflows.methods import Methods, methods_for
from skyquilt.workflows.survey_input import SurveyInput, read_input

FEATURE_PX = 640
"""Longest side in px of the images searched for features. Their disparities form the map, so many
features are needed.
"""
ROUTES = ("auto", "pair", "disparities", "reconstruction")
"""`auto` is `pair` for two photos and `reconstruction` for more."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Depth:
    """Result of a method."""

    surface: Surface
    """Heights."""
    measured: Surface | None = None
    """1 where heights were measured, 0 elsewhere; None = wherever two photos see the ground."""
    fields: tuple[PairField, ...] = ()
    """Pairs used; empty for the reconstruction."""
    without: tuple[NoField, ...] = ()
    """Linked pairs that determine no heights."""


def iter_depth(
    photos: Path | str | Sequence[Path],
    output: Path | str,
    settings: MosaicSettings | None = None,
    *,
    route: str = "auto",
    relief_m: float | None = None,
    overwrite: bool = False,
) -> Iterator[Event]:
    """Makes depth.tif, its images and figures; the last event is the `Result`.

    `relief_m`: largest height variation on the ground in m, which determines the points of the
    dominant plane (Y 4.9).

    Raises:
        RefusedError: no two photos determine a height.
        SkyquiltError: any other error that the user can correct.
    """
    settings, began = instance("settings", settings, MosaicSettings), Clock.now()
    output = as_path("output", output)
    if route not in ROUTES:
        raise UsageError(f"--route {route!r} is not one of {', '.join(ROUTES)}")
    within("--relief", relief_m, 0, 10_000, "m")
    given = read_input(photos, settings.input)
    if not given.survey.clips:
        _enough(given)
    former = former_fields(output)
    with claimed(output, FILES, overwrite=overwrite, folders=(PAIRS,)):
        for path in former:
            remove_file(path)
        clock = Clock(
            store=Store(folder=output / STATE / "store", registry=REGISTRY),
            began=began,
            workers=Threads(settings.running.threads),
        )
        yield from (Note(text=n) for n in given.survey.notes)
        given = yield from frames_added(given, settings, clock)
        _enough(given)
        total = len(given.survey.photos)
        if route == "auto":
            route = "pair" if total == 2 else "reconstruction"
        scene, depth, given = yield from _without_bad(route, given, settings, relief_m, clock)
        record = yield from clock.stage("draw", _drawn(output, route, scene, depth))
        record |= {"cpu_seconds": round(clock.cpu_total(), 2), "photos_total": total}
        write_text(output / "depth.json", json.dumps(record, indent=1, allow_nan=False) + "\n")
    yield Result(output=output, metrics=record)


def _enough(given: SurveyInput) -> None:
    if len(given.survey.photos) < 2:
        raise UsageError("depth needs at least two photos; give a neighbouring photo too")


def depth(
    photos: Path | str | Sequence[Path],
    output: Path | str,
    settings: MosaicSettings | None = None,
    *,
    route: str = "auto",
    relief_m: float | None = None,
    overwrite: bool = False,
) -> Result:
    """Makes a depth map and returns when it is finished.

    Raises:
        SkyquiltError: any error that the user can correct.
    """
    for happened in iter_depth(
        photos, output, settings, route=route, relief_m=relief_m, overwrite=overwrite
    ):
        if isinstance(happened, Result):
            return happened
    raise RuntimeError("the workflow ended without a result")


def _without_bad(
    route: str, given: SurveyInput, settings: MosaicSettings, relief_m: float | None, clock: Clock
) -> Generator[Event, None, tuple[Scene, Depth, SurveyInput]]:
    """The heights, and the survey that they are of: a photo that cannot be used any more is left
    out, and the steps are repeated without it.
    """
    total = len(given.survey.photos)
    while True:
        try:
            return *(yield from _by_route(route, given, settings, relief_m, clock)), given
        except PhotoFailedError as error:
            failed = given.failing(error, given.gone(), total)
        for photo in failed:
            yield Note(text=f"{photo.name} is left out: {photo.reason}", warning=True)
        given = given.without(failed)
        _enough(given)


def _by_route(
    route: str, given: SurveyInput, settings: MosaicSettings, relief_m: float | None, clock: Clock
) -> Generator[Event, None, tuple[Scene, Depth]]:
    methods = methods_for(settings)
    detector = registry.load("detector", settings.matching.detector or "sift")
    searched = detector(count=settings.matching.features, longest=FEATURE_PX)
    methods = replace(methods, detector=searched)
    if route == "reconstruction":
        scene = yield from scene_of(given, methods, settings, clock)
        if not len(scene.aligned.alignment.ties.xyz):
            raise RefusedError(
                "no tie points: the photos could not be matched, so there are no heights"
            )
        return scene, Depth(surface=scene.ground.surface)
    methods = replace(methods, sweep=None)
    if route == "disparities":
        scene = yield from scene_of(given, methods, settings, clock)
        steps = _disparities(scene, methods, relief_m)
        return scene, (yield from clock.stage("disparities", steps, keeps=False))
    why, photos = "", given.survey.photos
    for k in range(len(photos) - 1):
        pair = replace(given, survey=replace(given.survey, photos=photos[k : k + 2]))
        scene = yield from scene_of(pair, methods, settings, clock)
        steps = _disparities(scene, methods, relief_m, refuse=False)
        found = yield from clock.stage("disparities", steps, keeps=False)
        if found.fields:
            steps = _dense(scene, found)
            return scene, (yield from clock.stage("dense", steps, keeps=False))
        why = why or (found.without[0].reason if found.without else "they do not match")
    raise RefusedError(f"no two photos in sequence determine a height; of the first two: {why}")


def _dense(scene: Scene, features: Depth) -> Steps[Depth]:
    """Heights of a pair from every pixel; those of its features where that gives none."""
    yield 0, 1
    ground = scene.ground
    a, b = (next(v for v in ground.views if v.photo == i) for i in _pair(features))
    level = float(np.median(ground.surface.z))
    found = dense_heights((a, b), scene.aligned.grey, level, ground.grid)
    yield 1, 1
    return features if found is None else replace(features, surface=found[0], measured=found[1])


def _pair(found: Depth) -> tuple[int, int]:
    return found.fields[0].a, found.fields[0].b


def _disparities(
    scene: Scene, methods: Methods, relief_m: float | None, *, refuse: bool = True
) -> Steps[Depth]:
    """Heights from the disparities of all linked pairs.

    Raises:
        RefusedError: no pair determines a height, and `refuse` is set.
    """
    views = {v.photo: v for v in scene.ground.views}
    features, z = scene.aligned.found.features, float(np.median(scene.ground.surface.z))
    fields: list[PairField] = []
    without: list[NoField] = []
    for done, link in enumerate(scene.aligned.links.links):
        yield done, len(scene.aligned.links.links)
        if link.a not in views or link.b not in views:
            continue
        pair = features[link.a], features[link.b]
        found = pair_field(link, pair, (views[link.a], views[link.b]), z, relief_m)
        (fields if found else without).append(found)  # type: ignore[arg-type]
    if not fields:
        if refuse:
            raise RefusedError(
                "no pair of photos determines a height: none is linked with a sufficient baseline"
            )
        return Depth(surface=scene.ground.surface, without=tuple(without))
    xyz = OnePlane()([f.xyz for f in fields])
    surface = methods.surface(xyz, scene.ground.grid.bounds)
    return Depth(
        surface=replace(surface, source="disparities"), fields=tuple(fields), without=tuple(without)
    )


def _drawn(output: Path, route: str, scene: Scene, depth: Depth) -> Steps[dict[str, Any]]:
    """Writes all files except depth.json; returns its record."""
    yield 0, 1
    alignment, ground, photos = scene.aligned.alignment, scene.ground, scene.aligned.photos
    counted = alignment.frame.vertical_datum if route == "reconstruction" else "the dominant plane"
    unit = "m" if alignment.frame.metric else "arbitrary"
    tags = {"UNIT": unit, "ROUTE": route, "VERTICAL_DATUM": counted}
    z, known = write_depth(
        output / "depth.tif",
        depth.surface,
        ground.views,
        ground.grid,
        alignment,
        tags,
        measured=depth.measured,
    )
    if not known.any():
        raise RefusedError("no area is covered by two placed photos, so there are no heights")
    picture = false_colour(z, known)
    write_png(output / "depth.png", picture)
    shown: list[tuple[str, NDArray[np.uint8]]] = []
    for field in depth.fields:
        name = field_name(photos[field.a], photos[field.b])
        shown.append((name, field_picture(field, photos[field.b])))
        write_png(output / PAIRS / name, shown[-1][1])
    record = _record(route, scene, depth, z[known], unit, counted)
    write_text(output / "report.html", depth_page(record, picture, shown))
    yield 1, 1
    return record


def _record(
    route: str, scene: Scene, depth: Depth, z: NDArray[np.float32], unit: str, counted: str
) -> dict[str, Any]:
    photos, grid, alignment = scene.aligned.photos, scene.ground.grid, scene.aligned.alignment
    pairs = [
        {
            "a": photos[f.a].name,
            "b": photos[f.b].name,
            "points": len(f.px),
            "level": f.level,
            "field": field_name(photos[f.a], photos[f.b]),
            "baseline_m": round(f.baseline_m, 3),
            "height_m": round(f.height_m, 3),
            "largest_disparity_px": round(float(np.linalg.norm(f.d_px, axis=1).max()), 2),
        }
        for f in depth.fields
    ]
    return {
        "version": __version__,
        "route": route,
        "unit": unit,
        "counted_from": counted,
        "crs": alignment.frame.crs,
        "gsd_m": grid.gsd,
        "size_px": [grid.width, grid.height],
        "photos_used": len(scene.ground.views),
        "method": alignment.method,
        "cell_m": round(depth.surface.cell, 4),
        "percentiles": {str(p): round(float(np.percentile(z, p)), 3) for p in (1, 50, 99)},
        "pairs": pairs,
        "pairs_without": [
            {"a": photos[f.a].name, "b": photos[f.b].name, "reason": f.reason}
            for f in depth.without
        ],
    }
