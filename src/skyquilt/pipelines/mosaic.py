"""The main story: a folder of photos becomes a georeferenced orthomosaic.

    read -> features -> links -> align -> surface -> balance -> mosaic -> measure -> report

Read `iter_mosaic`: it is the product. Each stage's result is looked up in the run's store before it
is made, so a second run recomputes nothing and a killed one goes on where it stopped.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from numpy.typing import NDArray

from skyquilt import __version__
from skyquilt.alignment.conflicts import conflicts
from skyquilt.alignment.priors import choose_frame, priors
from skyquilt.config import BY_METADATA, IN_SEQUENCE, Methods, MosaicSettings, methods
from skyquilt.errors import SkyquiltError, UnreadablePhotoError, UsageError
from skyquilt.model import camera, features, poses, raster, surface
from skyquilt.model.event import Event, Note, Result
from skyquilt.model.photo import ControlPoint, KnownDistance, Photo, RejectedPhoto, Survey
from skyquilt.photos.distances import read_distances
from skyquilt.photos.gcp import read_gcp_list
from skyquilt.photos.pixels import read_color
from skyquilt.photos.sequence import sequence_of
from skyquilt.photos.survey import read_survey
from skyquilt.pipelines import (
    drawing,
    intake,
    judging,
    linking,
    placing,
    quality,
    radiometry,
    reporting,
)
from skyquilt.run.clock import Clock, Steps
from skyquilt.run.folder import STATE, RunFolder, open_run
from skyquilt.run.pixel_cache import PixelCache
from skyquilt.run.store import Store, digest

T = TypeVar("T")
U = TypeVar("U")
STAGES = ("read", "features", "links", "align", "surface", "balance", "mosaic", "measure", "report")
"""Stages in order."""
ARTEFACTS = {
    "features": "features",
    "read": "pictures",
    "links": "links",
    "align": "alignment",
    "surface": "surface",
    "mosaic": "blocks",
}
"""Stage -> folder in the store."""
REGISTRY = {
    c.__name__: c
    for c in (
        intake.Looked,
        features.Features,
        features.Link,
        features.RejectedLink,
        features.Matches,
        camera.Camera,
        poses.Alignment,
        poses.MapFrame,
        poses.Pose,
        poses.TiePoints,
        poses.ControlResidual,
        poses.Join,
        surface.Surface,
        RejectedPhoto,
        drawing.BlockExtras,
        raster.Grid,
    )
}
"""Records that the store may hold."""


def iter_mosaic(
    folder: Path | str | Sequence[Path],
    output: Path | str,
    settings: MosaicSettings | None = None,
    *,
    overwrite: bool = False,
    rerun_from: str | None = None,
) -> Iterator[Event]:
    """Makes a mosaic, telling its progress; the last event is the `Result`.

    Raises:
        SkyquiltError: anything a user can mend: no photos, an output that is taken, a malformed
            side file ...
    """
    settings, began = settings or MosaicSettings(), Clock.now()
    folder, output = Path(folder) if isinstance(folder, str) else folder, Path(output)
    parts, jobs = methods(settings), settings.jobs or os.cpu_count() or 1
    _apart(folder, output)
    survey, control = _read(folder, settings)
    distances = _known_distances(survey, control, settings)
    in_order = _in_sequence(survey.photos, settings)
    run_id = run_key(survey, control, settings, parts)
    run = open_run(output, run_id, overwrite=overwrite, again=rerun_from is not None)
    store = Store(folder=run.store, registry=REGISTRY)
    _forget(run, store, rerun_from)
    if run.done and (former := _figures(run.path / "metrics.json")):
        yield Note(text=f"{run.path} holds this very mosaic already; nothing to do")
        yield Result(output=run.path, metrics=former)
        return
    run.mark("running")
    clock = Clock(store=store, began=began)
    clock.lap("read", began)
    yield from (Note(text=n) for n in survey.notes)
    cache = PixelCache(
        read=lambda i: read_color(survey.photos[i]), budget_bytes=pixel_budget(settings)
    )
    taken = yield from clock.stage(
        "features", intake.take_in(survey.photos, cache, parts, store, jobs)
    )
    taken, cache = _one_kind(taken, survey, cache, settings)
    pixels = _still_there(taken.photos, cache)
    pictures = intake.Pictures(taken.photos, pixels, store)
    frame = choose_frame(taken.photos, settings.crs, control)
    prior = priors(taken.photos, frame)
    links = yield from clock.stage("links", _links(taken, prior, parts, settings, store, jobs))
    known = placing.Known(
        intake=taken,
        frame=frame,
        priors=prior,
        links=links,
        control=control,
        pictures=pictures,
        order=[
            i
            for _, i in sorted(
                (in_order[p.name], i) for i, p in enumerate(taken.photos) if p.name in in_order
            )
        ],
    )
    alignment = yield from clock.stage("align", placing.place(known, parts, settings, store))
    yield from (Note(text=n, warning=True) for n in alignment.notes)
    ground = yield from clock.stage(
        "surface", drawing.survey_ground(alignment, pictures, parts, settings, store)
    )
    exposure = yield from clock.stage(
        "balance", _at_once(lambda: drawing.balance(taken, ground, alignment, parts, settings))
    )
    compose = drawing.composer(taken, ground, alignment, exposure, parts, pixels)
    key = digest(
        run.key,
        drawing.poses_digest(alignment),
        ground.surface.z,
        dict(exposure.gains),
        dict(exposure.fields),
        dict(exposure.offsets),
    )
    unit = drawing.unit_of(taken)
    drawn = yield from clock.stage(
        "mosaic", drawing.draw(run.path, compose, alignment, settings, store, key, unit, jobs)
    )
    judging_it = quality.judge(
        taken, alignment, prior, ground, pictures, distances, settings.alpha, known.order
    )
    seams, judged = yield from clock.stage(
        "measure", _both(reporting.seams(compose, drawn, ground), judging_it), keeps=False
    )
    rejected = [*survey.rejected, *taken.rejected, *_unplaced(taken, alignment)]
    figures = (
        judging.figures(
            photos=taken.photos,
            total=len(survey.photos) + len(survey.rejected),
            rejected=rejected,
            priors=prior,
            links=links,
            alignment=alignment,
            ground=ground,
            drawn=drawn,
            seams=seams.figures,
            conflicts=conflicts(taken.photos, prior, alignment),
            notes=[*survey.notes, *alignment.notes],
        )
        | {"quality": judged}
        | radiometry.value_figures(taken.photos, exposure, settings)
    )
    finish = reporting.finish(
        run.path, taken, prior, alignment, ground, drawn, seams, figures, settings, clock, folder
    )
    metrics = yield from clock.stage("report", finish)
    run.mark("done")
    yield Result(output=run.path, metrics=metrics)


def mosaic(
    folder: Path | str | Sequence[Path],
    output: Path | str,
    settings: MosaicSettings | None = None,
    *,
    overwrite: bool = False,
) -> Result:
    """Makes a mosaic of the photos in a folder and returns when it is finished.

    Raises:
        SkyquiltError: anything a user can mend.
    """
    for happened in iter_mosaic(folder, output, settings, overwrite=overwrite):
        if isinstance(happened, Result):
            return happened
    raise RuntimeError("the story ended without a result")


def _read(
    folder: Path | Sequence[Path], settings: MosaicSettings
) -> tuple[Survey, tuple[ControlPoint, ...]]:
    """Metadata and side files; a gcp_list.txt beside the photos is used unasked."""
    survey = read_survey(
        folder, geo=settings.geo, cameras=settings.cameras, thermal_unit=settings.thermal_unit
    )
    survey, control = with_control(survey, folder, settings)
    _checked(survey, control, settings)
    return survey, control


def with_control(
    survey: Survey, folder: Path | Sequence[Path], settings: MosaicSettings
) -> tuple[Survey, tuple[ControlPoint, ...]]:
    """The survey with notes on its control points, and those."""
    gcp = settings.gcp
    if gcp is None and isinstance(folder, Path) and (folder / "gcp_list.txt").is_file():
        gcp = folder / "gcp_list.txt"
    if gcp is None:
        return survey, ()
    control, notes = read_gcp_list(gcp, [p.name for p in survey.photos])
    return replace(survey, notes=(*survey.notes, *notes)), control


def _in_sequence(photos: Sequence[Photo], settings: MosaicSettings) -> dict[str, int]:
    """Place in the sequence by the photo's name."""
    names = [p.name for p in photos]
    return {names[i]: k for k, i in enumerate(sequence_of(names, settings.sequence))}


def _known_distances(
    survey: Survey, control: Sequence[ControlPoint], settings: MosaicSettings
) -> tuple[KnownDistance, ...]:
    """Distances to judge the map by; none asked for, none there."""
    if settings.distances is None:
        return ()
    return read_distances(settings.distances, [p.name for p in survey.photos], control)


def _apart(folder: Path | Sequence[Path], output: Path) -> None:
    """Refuses the folder of photos as output: a second run would take its own map for a photo."""
    if isinstance(folder, Path) and folder.is_dir() and folder.resolve() == output.resolve():
        raise UsageError(
            f"{output} holds the photos; choose another folder for the results, such as"
            f" {output / 'map'}"
        )


def _checked(survey: Survey, control: Sequence[ControlPoint], settings: MosaicSettings) -> None:
    """Whether the options fit the survey, before anything is computed or replaced.

    Raises:
        UsageError, SideFileError: they do not.
    """
    frame = choose_frame(survey.photos, settings.crs, control)
    if settings.boundary is not None:
        if frame.crs is None:
            raise UsageError(
                "--boundary needs a georeferenced survey, and these photos have no positions;"
                " add --geo or --gcp"
            )
        from skyquilt.raster.boundary import read_boundary

        read_boundary(settings.boundary, frame.crs)


def run_key(
    survey: Survey, control: Sequence[ControlPoint], settings: MosaicSettings, parts: Methods
) -> str:
    """What a run depends on: content and metadata of its photos, side files, the
    settings that shape results, and the constants of all that works on it.
    """
    shaping = {k: v for k, v in settings.as_table().items() if k not in ("jobs", "memory_gb")}
    files = (settings.boundary, settings.distances, Path(settings.sequence))
    side = [p.read_bytes().hex() for p in files if p is not None and p.is_file()]
    photos = [
        (p.name, p.digest, p.position, p.attitude, p.focal, p.calibration) for p in survey.photos
    ]
    return digest(photos, list(control), shaping, side, parts, iter_mosaic, __version__)


def pixel_budget(settings: MosaicSettings) -> int:
    """Bytes for decoded photos: what the memory allowed leaves after code, features and tiles."""
    return int(max(0.15, (settings.memory_gb or 1.2) - 0.6) * 1e9)


def _forget(run: RunFolder, store: Store, rerun_from: str | None) -> None:
    if rerun_from is not None:
        later = STAGES[STAGES.index(rerun_from) :]
        store.forget([ARTEFACTS[s] for s in later if s in ARTEFACTS])
        if "mosaic" in later:
            shutil.rmtree(run.path / STATE / drawing.SPOOL, ignore_errors=True)
        run.mark("running")


def _figures(path: Path) -> dict[str, Any]:
    """The figures of a finished run; none where somebody damaged the file."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}


def _one_kind(
    taken: intake.Intake, survey: Survey, cache: PixelCache, settings: MosaicSettings
) -> tuple[intake.Intake, PixelCache]:
    """The photos that fit one map, and the cache under their new indices."""
    fitting = drawing.single_kind(taken)
    if len(fitting.photos) == len(survey.photos):
        return fitting, cache
    where = {p.name: i for i, p in enumerate(survey.photos)}
    return fitting, replace_read(cache, [where[p.name] for p in fitting.photos])


def replace_read(cache: PixelCache, old: Sequence[int]) -> PixelCache:
    """A cache over a cache: photo k of the new is photo old[k] of the old."""
    return PixelCache(read=lambda i: cache(old[i]), budget_bytes=0)


def _still_there(photos: Sequence[Photo], cache: PixelCache) -> Callable[[int], NDArray[Any]]:
    """Pixels of photos that could be read once; an error names the one that cannot be any more."""

    def pixels(photo: int) -> NDArray[Any]:
        try:
            return cache(photo)
        except UnreadablePhotoError as error:
            raise SkyquiltError(
                f"{photos[photo].path} could be read at first, and now {error}; see to its disk and"
                " run"
                " the same command again to resume"
            ) from error

    return pixels


def _links(
    taken: intake.Intake,
    prior: Sequence[poses.Prior],
    parts: Methods,
    settings: MosaicSettings,
    store: Store,
    jobs: int,
) -> Steps[linking.Links]:
    """Links, unless the method asked for does without: to repair metadata takes links, to trust
    them none.
    """
    alone = settings.method in IN_SEQUENCE or settings.method in BY_METADATA
    repairs = settings.method in BY_METADATA and settings.repair
    if (alone and not repairs) or len(taken.photos) < 2:
        return linking.Links(links=(), rejected=())
    return (yield from linking.link_up(taken, prior, parts, store, jobs))


def _at_once(work: Callable[[], T]) -> Steps[T]:
    """A stage of one step."""
    yield 0, 1
    result = work()
    yield 1, 1
    return result


def _both(first: Steps[T], second: Steps[U]) -> Steps[tuple[T, U]]:
    """Two works as one stage."""
    return (yield from first), (yield from second)


def _unplaced(taken: intake.Intake, alignment: poses.Alignment) -> list[RejectedPhoto]:
    return [
        RejectedPhoto(name=p.name, reason=alignment.rejected.get(i, "it could not be placed"))
        for i, p in enumerate(taken.photos)
        if i not in alignment.poses
    ]
