"""The main workflow: a folder of photos becomes a georeferenced orthomosaic.

    read -> features -> links -> align -> surface -> balance -> mosaic -> measure -> report

with `frames` after `read` where there are clips.

Start reading at `make_map`. Its steps are those of `skyquilt.workflows.flow`.
"""

import json
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from skyquilt.alignment.conflicts import conflicts
from skyquilt.alignment.contradicted_positions import contradictions
from skyquilt.alignment.heights import height_figures
from skyquilt.alignment.oblique_start import tilt_warnings
from skyquilt.alignment.priors import stretch_warnings
from skyquilt.engine.clock import Clock, CountedParts, apart, result_of
from skyquilt.engine.error_log import log_error
from skyquilt.engine.folder import STATE, RunFolder, open_run
from skyquilt.engine.free_memory import give_back_growth, return_large_blocks
from skyquilt.engine.store import Store, digest
from skyquilt.engine.workers import Telling, Threads, workers_for
from skyquilt.errors import PhotoFailedError
from skyquilt.model.event import Event, Note, Result
from skyquilt.model.photo import RejectedPhoto
from skyquilt.ortho.ground import Ground
from skyquilt.ortho.orthomosaic import SPOOL
from skyquilt.ortho.radiometry import value_figures
from skyquilt.outside import read_bounded, remove_folder
from skyquilt.photos.headers import content_digest
from skyquilt.photos.read import ReadFiles
from skyquilt.quality.clip_figures import clip_figures
from skyquilt.quality.placement import placement_quality
from skyquilt.quality.run_metrics import figures
from skyquilt.quality.seam_measurement import MeasuredSeams, measure_seams
from skyquilt.quality.tone import tone_residual
from skyquilt.settings import MosaicSettings
from skyquilt.typed import as_path, instance
from skyquilt.version import __version__
from skyquilt.workflows.artefacts import ARTEFACTS, REGISTRY
from skyquilt.workflows.clip_frames import frame_methods, write_frames
from skyquilt.workflows.finished import NAME, STAGE, Earlier, earlier_map
from skyquilt.workflows.finishing import added_figures, added_note, finished, nothing_to_do
from skyquilt.workflows.flow import (
    ADJUSTING,
    AlignedPhotos,
    DrawnMap,
    Scene,
    align_photos,
    draw_map,
    find_ground,
    frames_added,
    scene_of,
)
from skyquilt.workflows.keys import photo_key
from skyquilt.workflows.methods import Methods, methods_for
from skyquilt.workflows.run_report import finish_run
from skyquilt.workflows.survey_input import Source, SurveyInput, check_input, read_input

STAGES = (
    "read",
    "frames",
    "features",
    "links",
    "align",
    "surface",
    "balance",
    "seams",
    "mosaic",
    "measure",
    "report",
)
"""Stages in order."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FinishedMap:
    """A finished map and its inputs."""

    result: Result
    """Its folder and metrics."""
    given: SurveyInput
    """The survey."""
    methods: Methods
    """The methods."""
    settings: MosaicSettings
    """The settings of the run."""

    def scene(self) -> Scene:
        """The aligned photos and the ground of this map; read from its store by the same steps."""
        store = Store(folder=self.result.output / STATE / "store", registry=REGISTRY)
        threads = Threads(self.settings.running.threads)
        clock = Clock(store=store, began=Clock.now(), workers=threads)
        return result_of(scene_of(self.given, self.methods, self.settings, clock))


def iter_mosaic(
    folder: Source | str,
    output: Path | str,
    settings: MosaicSettings | None = None,
    *,
    methods: Methods | None = None,
    overwrite: bool = False,
    rerun_from: str | None = None,
    add: bool = False,
    stays: bool = False,
) -> Iterator[Event]:
    """Makes a mosaic and yields its progress; the last event is the `Result`.

    `methods` replace those selected by the settings, see `methods_for`. With `add`, photos that
    joined the folder are added to the map that is in `output`: what they do not change stays. With
    `stays`, the files of a map that is overwritten stay until those of the new one replace them.

    Raises:
        SkyquiltError: any error that the user can correct: no photos, an output folder in use, a
            malformed side file ...
    """
    settings, began = instance("settings", settings, MosaicSettings), Clock.now()
    output = as_path("output", output)
    files = ReadFiles(Store(folder=output / STATE / "store", registry=REGISTRY))
    given = read_input(folder, settings.input, files)
    made = yield from make_map(
        given,
        output,
        settings,
        methods,
        files,
        began=began,
        overwrite=overwrite,
        rerun_from=rerun_from,
        add=add,
        stays=stays,
    )
    yield made.result


def mosaic(
    folder: Source | str,
    output: Path | str,
    settings: MosaicSettings | None = None,
    *,
    methods: Methods | None = None,
    overwrite: bool = False,
) -> Result:
    """Makes a mosaic of the photos in a folder and returns when it is finished.

    Raises:
        SkyquiltError: any error that the user can correct.
    """
    for event in iter_mosaic(folder, output, settings, methods=methods, overwrite=overwrite):
        if isinstance(event, Result):
            return event
    raise RuntimeError("the workflow ended without a result")


def make_map(
    given: SurveyInput,
    output: Path,
    settings: MosaicSettings,
    methods: Methods | None = None,
    files: ReadFiles | None = None,
    *,
    began: tuple[float, float] | None = None,
    overwrite: bool = False,
    rerun_from: str | None = None,
    add: bool = False,
    stays: bool = False,
) -> Generator[Event, None, FinishedMap]:
    """Makes the map of a survey that was read; `began`: time at which reading began (`Clock.now`).
    `files` keeps what was read for a run that goes on. `add`: the map that `output` holds is
    continued where it can be. `stays`: see `iter_mosaic`.

    Raises:
        SkyquiltError: any error that the user can correct.
    """
    return_large_blocks()
    began, methods = began or Clock.now(), methods or methods_for(settings)
    given = check_input(given, output, settings)
    key, recipe = run_key(given, settings, methods), recipe_of(given, settings, methods)
    earlier = _earlier(given, output, recipe) if add else None
    again = rerun_from is not None
    run = open_run(output, key, overwrite=overwrite, again=again, grows=add or stays)
    store = Store(folder=run.store, registry=REGISTRY)
    store.tidy()
    _forget(run, store, rerun_from)
    if run.done and (former := _figures(run.path / "metrics.json")):
        yield from nothing_to_do(run.path, "this mosaic", given.survey.rejected, former)
        result = Result(output=run.path, metrics=former)
        return FinishedMap(result=result, given=given, methods=methods, settings=settings)
    if changed := run.changed:
        yield Note(
            text=f"{', '.join(changed)} in {run.path} are not as the run wrote them, and are made"
            " again",
            warning=True,
        )
    run.mark("running")
    if files is not None:
        files.keep(store)
    survey = given.survey
    sees = [*(p.path for p in survey.photos), *(c.path for c in survey.clips)][:1]
    if settings.running.scheduler is None:
        sees = []
    with workers_for(settings.running, run.path / STATE, sees) as workers:
        clock = Clock(store=store, began=began, workers=workers)
        clock.lap("read", began)
        yield from (Note(text=n) for n in given.survey.notes)
        given = yield from frames_added(given, settings, clock)
        if earlier is not None:
            earlier.check(given.survey.photos, run.path)
        _log(run.path, given.survey.rejected)
        make = _Making(run.path, key, recipe, settings, methods, clock, earlier)
        metrics, given, key = yield from _without_bad(given, make)
    replace(run, key=key).finish()
    result = Result(output=run.path, metrics=metrics)
    return FinishedMap(result=result, given=given, methods=methods, settings=settings)


def _earlier(given: SurveyInput, output: Path, recipe: str) -> Earlier | None:
    """The map in `output` that photos are added to; None where there is none.

    Raises:
        OutputError: it was made otherwise, or of photos that are gone.
    """
    store = Store(folder=output / STATE / "store", registry=REGISTRY)
    found = earlier_map(store, recipe, output)
    if found is not None and not given.survey.clips:  # frames of clips are not known yet
        found.check(given.survey.photos, output)
    return found


@dataclass(frozen=True)
class _Making:
    """How a map is made."""

    output: Path
    key: str
    recipe: str
    settings: MosaicSettings
    methods: Methods
    clock: Clock
    earlier: Earlier | None


def _without_bad(
    given: SurveyInput, make: _Making
) -> Generator[Event, None, tuple[dict[str, Any], SurveyInput, str]]:
    """Metrics of the map, the survey that it shows, and the key of its run.

    A photo on which a step fails, or whose file is no longer the one that was read, is left out,
    and the steps are repeated without it; results that do not depend on it are in the store. The
    key is that of a run without the photos whose files are lost: with these files again, the map
    does not count as finished.

    Raises:
        SkyquiltError: more than half of the photos cannot be used any more.
    """
    total, still, key = len(given.survey.photos), given, make.key
    while True:
        try:
            metrics = yield from _made(given, make)
            return metrics, given, key
        except PhotoFailedError as error:
            log_error(make.output, str(error), error)
            gone = given.gone()
            failed = given.failing(error, gone, total)
        for photo in failed:
            yield Note(text=f"{photo.name} is left out: {photo.reason}", warning=True)
        given = given.without(failed)
        if gone:
            still = still.without(gone)
            key = run_key(still, make.settings, make.methods)


def _made(given: SurveyInput, make: _Making) -> Generator[Event, None, dict[str, Any]]:
    """Makes the map and its files; returns the metrics."""
    output, settings, methods, clock = make.output, make.settings, make.methods, make.clock
    aligned = yield from align_photos(given, methods, settings, clock, make.earlier)
    _log(output, aligned.found.rejected)
    ground = yield from find_ground(aligned, methods, settings, clock, output)
    added = added_figures(aligned, ground)
    if make.earlier is not None:
        yield added_note(added)
    drawn = yield from draw_map(aligned, ground, methods, settings, clock, output, make.key)
    if settings.input.write_frames:
        writing = write_frames(output, aligned.photos, aligned.pixels)
        yield from clock.stage("write frames", writing, keeps=False)
    measuring = apart(
        lambda tell: _measured(aligned, ground, drawn, settings, clock, tell), CountedParts()
    )
    seams, quality, tone = yield from clock.stage("measure", measuring, keeps=False)
    metrics = _metrics(aligned, ground, drawn, seams, tone, settings) | {"quality": quality}
    metrics |= added
    aligned.found.looks.make_room()
    give_back_growth()
    finishing = finish_run(
        output, aligned, ground, drawn.drawn, drawn.compose, seams, metrics, settings, clock
    )
    metrics = yield from clock.stage("report", finishing)
    clock.store.put(STAGE, NAME, finished(aligned, ground, drawn, make.recipe, output))
    return metrics


def _log(output: Path, rejected: Sequence[RejectedPhoto]) -> None:
    """Writes the tracebacks of photos on which the program failed to the log of errors."""
    for photo in rejected:
        if photo.trace:
            log_error(output, f"{photo.name}: {photo.reason}", photo.trace)


def run_key(given: SurveyInput, settings: MosaicSettings, methods: Methods) -> str:
    """Key of a run: its photos, and everything else that affects results."""
    photos = [photo_key(p) for p in given.survey.photos]
    films = [
        (c.name, c.digest, c.track and c.track.digest, c.start and c.start.isoformat(), c.focal)
        for c in given.survey.clips
    ]
    return digest(photos, films, list(given.control), recipe_of(given, settings, methods))


def recipe_of(given: SurveyInput, settings: MosaicSettings, methods: Methods) -> str:
    """What a map is made with beside photos and control points: settings that affect results, side
    files, the methods, and the constants of all code used.
    """
    shaping = {
        k: v
        for k, v in settings.as_table().items()
        if k not in ("jobs", "memory_gb", "max_mp", "scheduler")
    }
    files = (settings.picture.boundary, settings.input.distances, Path(settings.input.sequence))
    side = [content_digest(p) for p in files if p is not None and p.is_file()]
    if given.survey.clips:  # these are read when the frames are known
        gcp = given.control_file(settings.input.gcp)
        named = (gcp, settings.input.cameras)
        side += [content_digest(p) for p in named if p is not None and p.is_file()]
        side.append(digest(frame_methods(settings.input)))
    return digest(shaping, side, methods, make_map, __version__)


def _measured(
    aligned: AlignedPhotos,
    ground: Ground,
    map_: DrawnMap,
    settings: MosaicSettings,
    clock: Clock,
    tell: Callable[[str], None],
) -> tuple[MeasuredSeams, dict[str, Any], dict[str, Any] | None]:
    """Measures seams, the agreement of photos, and how evenly they show the same ground."""
    telling = Telling(clock.workers, tell, "seams")
    seams = measure_seams(map_.compose, map_.drawn, ground, telling)
    aligned.pixels.make_room()
    quality = placement_quality(
        aligned.photos,
        aligned.alignment,
        aligned.priors,
        ground,
        aligned.grey,
        aligned.given.distances,
        settings.hybrid.alpha,
        aligned.order,
        replace(telling, what="agreement of photos"),
    )
    aligned.grey.make_room()
    thumbnails = aligned.found.thumbnails([v.photo for v in ground.views])
    tone = tone_residual(
        ground.views, thumbnails, ground.surface, ground.grid.bounds, map_.exposure
    )
    return seams, quality, tone


def _metrics(
    aligned: AlignedPhotos,
    ground: Ground,
    map_: DrawnMap,
    seams: MeasuredSeams,
    tone: dict[str, Any] | None,
    settings: MosaicSettings,
) -> dict[str, Any]:
    survey, alignment = aligned.given.survey, aligned.alignment
    return (
        figures(
            photos=aligned.photos,
            total=len(survey.photos) + len(survey.rejected),
            rejected=aligned.rejected,
            priors=aligned.priors,
            links=aligned.links.links,
            refused=aligned.links.rejected,
            alignment=alignment,
            ground=ground,
            drawn=map_.drawn,
            seams=seams.figures,
            looks={**seams.looks, "tone_residual": tone},
            conflicts=conflicts(aligned.photos, aligned.priors, alignment),
            warnings=[
                *aligned.found.warnings,
                *aligned.links.notes,
                *contradictions(aligned.priors, alignment),
                *tilt_warnings(aligned.priors, alignment, settings.picture.max_view_angle),
                *stretch_warnings(alignment.frame),
            ],
            notes=[*survey.notes, *alignment.notes, *ground.notes, *map_.exposure.notes],
        )
        | {
            "heights": height_figures(
                aligned.photos, aligned.given.control, alignment.frame.vertical_datum
            )
        }
        | clip_figures(aligned.given.clips)
        | value_figures(aligned.photos, map_.exposure, settings.picture)
    )


def _forget(run: RunFolder, store: Store, rerun_from: str | None) -> None:
    if rerun_from is not None:
        later = STAGES[STAGES.index(rerun_from) :]
        store.forget([ADJUSTING, *(ARTEFACTS[s] for s in later if s in ARTEFACTS)])
        if "mosaic" in later:
            remove_folder(run.path / STATE / SPOOL)
        run.mark("running")


def _figures(path: Path) -> dict[str, Any]:
    """The metrics of a finished run; empty if the file is damaged."""
    try:
        return dict(json.loads(read_bounded(path)))
    except (OSError, ValueError, TypeError, RecursionError):
        return {}
