"""The main workflow: a folder of photos becomes a georeferenced orthomosaic.

    read -> features -> links -> align -> surface -> balance -> mosaic -> measure -> report

with `frames` after `read` where there are clips.

Start reading at `make_map`. Its steps are those of `skyquilt.workflows.flow`.
"""

import json
import shutil
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skyquilt.alignment.conflicts import conflicts
from skyquilt.alignment.heights import height_figures
from skyquilt.engine.clock import Clock, Steps, result_of
from skyquilt.engine.folder import STATE, RunFolder, open_run
from skyquilt.engine.store import Store, digest
from skyquilt.model.event import Event, Note, Result
from skyquilt.ortho.ground import Ground
from skyquilt.ortho.orthomosaic import SPOOL
from skyquilt.ortho.radiometry import value_figures
from skyquilt.quality.clip_figures import clip_figures
from skyquilt.quality.placement import placement_quality
from skyquilt.quality.run_metrics import figures
from skyquilt.quality.seam_measurement import MeasuredSeams, measure_seams
from skyquilt.settings import MosaicSettings
from skyquilt.version import __version__
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.clip_frames import frame_methods, write_frames
from skyquilt.workflows.flow import (
    AlignedPhotos,
    DrawnMap,
    Scene,
    align_photos,
    draw_map,
    find_ground,
    scene_of,
)
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
    "mosaic",
    "measure",
    "report",
)
"""Stages in order."""
ARTEFACTS = {
    "frames": "looks",
    "features": "features",
    "read": "pictures",
    "links": "links",
    "align": "alignment",
    "surface": "surface",
    "mosaic": "blocks",
}
"""Stage -> folder in the store."""


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
        clock = Clock(store=store, began=Clock.now())
        return result_of(scene_of(self.given, self.methods, self.settings, clock))


def iter_mosaic(
    folder: Source | str,
    output: Path | str,
    settings: MosaicSettings | None = None,
    *,
    methods: Methods | None = None,
    overwrite: bool = False,
    rerun_from: str | None = None,
) -> Iterator[Event]:
    """Makes a mosaic and yields its progress; the last event is the `Result`.

    `methods` replace those selected by the settings, see `methods_for`.

    Raises:
        SkyquiltError: any error that the user can correct: no photos, an output folder in use, a
            malformed side file ...
    """
    settings, began = settings or MosaicSettings(), Clock.now()
    given = read_input(folder, settings.input)
    made = yield from make_map(
        given,
        Path(output),
        settings,
        methods,
        began=began,
        overwrite=overwrite,
        rerun_from=rerun_from,
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
    *,
    began: tuple[float, float] | None = None,
    overwrite: bool = False,
    rerun_from: str | None = None,
) -> Generator[Event, None, FinishedMap]:
    """Makes the map of a survey that was read; `began`: time at which reading began (`Clock.now`).

    Raises:
        SkyquiltError: any error that the user can correct.
    """
    began, methods = began or Clock.now(), methods or methods_for(settings)
    check_input(given, output, settings)
    key = run_key(given, settings, methods)
    run = open_run(output, key, overwrite=overwrite, again=rerun_from is not None)
    store = Store(folder=run.store, registry=REGISTRY)
    _forget(run, store, rerun_from)
    if run.done and (former := _figures(run.path / "metrics.json")):
        yield Note(text=f"{run.path} already contains this mosaic; nothing to do")
        result = Result(output=run.path, metrics=former)
        return FinishedMap(result=result, given=given, methods=methods, settings=settings)
    run.mark("running")
    clock = Clock(store=store, began=began)
    clock.lap("read", began)
    yield from (Note(text=n) for n in given.survey.notes)
    aligned = yield from align_photos(given, methods, settings, clock)
    ground = yield from find_ground(aligned, methods, settings, clock)
    drawn = yield from draw_map(aligned, ground, methods, settings, clock, run.path, key)
    measuring = _measured(aligned, ground, drawn, settings)
    if settings.input.write_frames:
        yield from clock.stage(
            "write frames", write_frames(run.path, aligned.photos, aligned.pixels), keeps=False
        )
    seams, quality = yield from clock.stage("measure", measuring, keeps=False)
    metrics = _metrics(aligned, ground, drawn, seams, settings) | {"quality": quality}
    finishing = finish_run(run.path, aligned, ground, drawn.drawn, seams, metrics, settings, clock)
    metrics = yield from clock.stage("report", finishing)
    run.mark("done")
    result = Result(output=run.path, metrics=metrics)
    return FinishedMap(result=result, given=aligned.given, methods=methods, settings=settings)


def run_key(given: SurveyInput, settings: MosaicSettings, methods: Methods) -> str:
    """Key of a run: content and metadata of its photos, side files, settings that affect results,
    the methods, and the constants of all code used.
    """
    shaping = {k: v for k, v in settings.as_table().items() if k not in ("jobs", "memory_gb")}
    files = (settings.picture.boundary, settings.input.distances, Path(settings.input.sequence))
    side = [p.read_bytes().hex() for p in files if p is not None and p.is_file()]
    photos = [
        (p.name, p.digest, p.position, p.attitude, p.focal, p.calibration)
        for p in given.survey.photos
    ]
    films = [
        (c.name, c.digest, c.track and c.track.digest, c.start and c.start.isoformat(), c.focal)
        for c in given.survey.clips
    ]
    if films:  # control points are read when the frames are known
        gcp = settings.input.gcp or Path(str(given.source)) / "gcp_list.txt"
        side += [gcp.read_bytes().hex()] if gcp.is_file() else []
        films.append(frame_methods(settings.input))  # type: ignore[arg-type]
    return digest(photos, films, list(given.control), shaping, side, methods, make_map, __version__)


def _measured(
    aligned: AlignedPhotos, ground: Ground, map_: DrawnMap, settings: MosaicSettings
) -> Steps[tuple[MeasuredSeams, dict[str, Any]]]:
    """Measures the seams and the agreement of the placed photos."""
    seams = yield from measure_seams(map_.compose, map_.drawn, ground)
    quality = yield from placement_quality(
        aligned.photos,
        aligned.alignment,
        aligned.priors,
        ground,
        aligned.grey,
        aligned.given.distances,
        settings.hybrid.alpha,
        aligned.order,
    )
    return seams, quality


def _metrics(
    aligned: AlignedPhotos,
    ground: Ground,
    map_: DrawnMap,
    seams: MeasuredSeams,
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
            conflicts=conflicts(aligned.photos, aligned.priors, alignment),
            notes=[*survey.notes, *alignment.notes],
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
        store.forget([ARTEFACTS[s] for s in later if s in ARTEFACTS])
        if "mosaic" in later:
            shutil.rmtree(run.path / STATE / SPOOL, ignore_errors=True)
        run.mark("running")


def _figures(path: Path) -> dict[str, Any]:
    """The metrics of a finished run; empty if the file is damaged."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}
