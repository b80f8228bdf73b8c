"""The workflow of a multispectral flight: the map of one band, or of photos in colours, then all
bands and indices of vegetation on its grid.

    mosaic -> files of each capture -> the camera of each band -> bands.tif, ndvi.tif ...

The map's photos are aligned as those of any survey. The other cameras of the rig need no alignment
of their own: they were where the map's camera was, turned by an angle that never changes.
"""

from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from skyquilt.coregistration.band_rig import FindBandRig
from skyquilt.engine.clock import Clock, result_of
from skyquilt.engine.folder import ADDED, STATE, THERMAL_FILE, as_written, stamps
from skyquilt.engine.pixel_cache import pixel_budget
from skyquilt.engine.store import Store, digest
from skyquilt.engine.workers import Threads
from skyquilt.errors import PhotoFailedError, UsageError
from skyquilt.model.event import Event, Note, Result
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.multispectral.composite import INFRARED_FILE, write_infrared
from skyquilt.multispectral.draw import BANDS_FILE, BandsDrawing, PlacedBand
from skyquilt.multispectral.indices import indices_of
from skyquilt.multispectral.page import band_figures, write_section
from skyquilt.multispectral.panels import by_panels
from skyquilt.multispectral.placing import Placing, place_bands
from skyquilt.multispectral.reflectance import Kind
from skyquilt.outside import remove_file
from skyquilt.photos.headers import content_digest
from skyquilt.photos.left_out import told_left_out
from skyquilt.photos.read import ReadFiles
from skyquilt.settings import MosaicSettings
from skyquilt.typed import as_path, instance
from skyquilt.version import __version__
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.flow import Scene, exposure_of, labels_of, scene_of
from skyquilt.workflows.mosaic import FinishedMap, make_map
from skyquilt.workflows.run_report import write_figures
from skyquilt.workflows.survey_input import Source, SurveyInput, read_input

_LOST = "none of its files can be read any more"
"""Why a band is not drawn whose files were lost meanwhile."""


def iter_bands(
    folder: Source | str,
    output: Path | str,
    settings: MosaicSettings | None = None,
    *,
    overwrite: bool = False,
    rerun_from: str | None = None,
    stays: bool = False,
    needed: bool = True,
) -> Iterator[Event]:
    """Makes the map, then `bands.tif` and indices of vegetation; the last event is the `Result`.
    `stays`: see `iter_mosaic`. Unless they are `needed`, a flight without other bands is mapped
    without them.

    Raises:
        UsageError: no file says that it shows one band of several, which is needed.
        SkyquiltError: any other error that the user can correct.
    """
    settings, began = instance("settings", settings, MosaicSettings), Clock.now()
    output = as_path("output", output)
    files = ReadFiles(Store(folder=output / STATE / "store", registry=REGISTRY))
    given = read_input(folder, settings.input, files)
    others = given.survey.other_bands
    if needed and not others:
        raise UsageError(
            "--all-bands needs files that each show one band of a multispectral camera and say so"
            " (BandName in their XMP); these do not. Files that hold several bands each, as MAPIR's"
            " do, are mapped without it: mosaic.tif has their bands"
        )
    made = yield from make_map(
        _without_reasons(given, others),
        output,
        settings,
        files=files,
        began=began,
        overwrite=overwrite,
        rerun_from=rerun_from,
        stays=stays,
    )
    if others:
        yield from _bands(made, others)
    else:
        yield made.result


def _without_reasons(given: SurveyInput, others: Sequence[Photo]) -> SurveyInput:
    """The survey in which files of other bands do not count as left out: they are drawn, too."""
    drawn = {p.name for p in others}
    kept = tuple(r for r in given.survey.rejected if r.name not in drawn)
    return replace(given, survey=replace(given.survey, rejected=kept))


def _bands(made: FinishedMap, others: Sequence[Photo]) -> Generator[Event, None, None]:
    """bands.tif and indices of a finished map."""
    output, settings = made.result.output, made.settings
    store = Store(folder=output / STATE / "store", registry=REGISTRY)
    clock = Clock(store=store, began=Clock.now(), workers=Threads(settings.running.threads))
    scene = result_of(scene_of(made.given, made.methods, settings, clock))
    key, former = _key(made, scene, others), made.result.metrics.get("bands")
    if (
        isinstance(former, dict)
        and former.get("key") == key
        and as_written(output, former.get("files"))
    ):
        yield Note(text=f"{output} already contains these bands; nothing to do")
        yield made.result
        return
    placing = place_bands(scene, others, clock.workers)
    placed = yield from clock.stage("rig", placing, keeps=False)
    yield from (Note(text=t, warning=True) for t in (*placed.notes, *told_left_out(placed.lost)))
    yield from [placed.panel] if placed.panel else []
    bands, lost, made_files = yield from _drawn(made, scene, placed, clock, key)
    shown = {b.files.name for b in bands}
    empty = {b.files.name: _LOST for b in placed.bands if b.files.name not in shown}
    yield from (Note(text=f"The band {n} is left out: {_LOST}.", warning=True) for n in empty)
    for name in {*ADDED} - {*made_files, THERMAL_FILE}:  # of an earlier run with other bands
        remove_file(output / name)
    files = stamps(output, made_files)
    told = band_figures(bands, placed, lost)
    final = placed.final and len(lost) == len(placed.lost)
    told |= {"refused": told["refused"] | empty, "key": key if final else "", "files": files}
    figures = {"bands": told}
    metrics = {**made.result.metrics, **figures}
    write_section(output, figures["bands"])
    write_figures(output, metrics)
    yield Result(output=output, metrics=metrics)


def _drawn(
    made: FinishedMap, scene: Scene, placed: Placing, clock: Clock, key: str
) -> Generator[Event, None, tuple[list[PlacedBand], list[RejectedPhoto], list[str]]]:
    """Draws the rasters: the bands they show, what was left out, and the names of the files; none
    where no band has a place.
    """
    output, lost = made.result.output, placed.lost
    bands = [b for b in placed.bands if b.of_photo]
    while bands:
        drawing = _drawing(made, scene, bands, placed.kind, clock, key)
        try:
            yield from clock.stage("bands", drawing.blocks(clock.workers), keeps=False)
        except PhotoFailedError as error:
            left = (b.without({error.photo}) for b in bands)
            bands = [b for b in left if b.of_photo]
            lost = [*lost, RejectedPhoto(name=error.photo, reason=error.reason)]
            yield Note(text=f"{error.photo} is left out: {error.reason}", warning=True)
            continue
        files = [BANDS_FILE, *(f"{index.name}.tif" for index in drawing.indices)]
        return bands, lost, files + ([INFRARED_FILE] if write_infrared(output) else [])
    yield Note(text=f"No band lies on the map, so there is no {BANDS_FILE}.", warning=True)
    return [], lost, []


def _key(made: FinishedMap, scene: Scene, others: Sequence[Photo]) -> str:
    """What bands.tif depends on beside the code: the map, the files of other bands, and how the
    camera of each is found.
    """
    aligned, ground, boundary = scene.aligned, scene.ground, made.settings.picture.boundary
    return digest(
        aligned.key,
        ground.key,
        ground.grid,
        content_digest(boundary) if boundary is not None and boundary.is_file() else "",
        made.methods.blend,
        sorted((p.name, p.pixels_key) for p in (*aligned.photos, *others)),
        (FindBandRig(), place_bands, by_panels, BandsDrawing),
        __version__,
    )


def _drawing(
    made: FinishedMap, scene: Scene, bands: Sequence[PlacedBand], kind: Kind, clock: Clock, key: str
) -> BandsDrawing:
    """How the rasters are drawn."""
    aligned, ground, settings = scene.aligned, scene.ground, made.settings
    # both are in the store of the finished map
    exposure = exposure_of(
        aligned, ground, made.methods, settings.picture, clock.store, lambda _: None
    )
    labels, _ = labels_of(aligned, ground, exposure, made.methods, clock, lambda _: None)
    indices = indices_of([b.files.name for b in bands])
    return BandsDrawing(
        output=made.result.output,
        bands=bands,
        indices=indices,
        ground=ground,
        placed=aligned.alignment,
        labels=labels,
        blend=made.methods.blend,
        boundary=settings.picture.boundary,
        pixels_bytes=pixel_budget(settings.running.memory_gb),
        key=digest(key, [(b.files.name, sorted(b.of_photo.items())) for b in bands]),
        tags={"VALUES": kind},
    )
