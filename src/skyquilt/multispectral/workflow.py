"""The workflow of a multispectral flight: the map of one band, or of photos in colours, then all
bands and indices of vegetation on its grid.

    mosaic -> files of each capture -> the camera of each band -> bands.tif, ndvi.tif ...

The map's photos are aligned as those of any survey. The other cameras of the rig need no alignment
of their own: they were where the map's camera was, turned by an angle that never changes.
"""

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt.engine.clock import Clock, Steps, result_of
from skyquilt.engine.folder import STATE, stamp
from skyquilt.engine.pixel_cache import pixel_budget
from skyquilt.engine.store import Store, digest
from skyquilt.engine.workers import Threads
from skyquilt.errors import PhotoFailedError, UsageError
from skyquilt.imaging.grey import shrink, to_grey8
from skyquilt.model.camera import Camera
from skyquilt.model.event import Event, Note, Result
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.model.registration import RefusedRegistration
from skyquilt.multispectral.captures import (
    THERMAL,
    BandFiles,
    bands_of_files,
    captured_together,
    tags_of,
)
from skyquilt.multispectral.draw import BANDS_FILE, BandsDrawing, PlacedBand
from skyquilt.multispectral.indices import indices_of
from skyquilt.multispectral.page import band_figures, write_bands
from skyquilt.multispectral.reflectance import common_kind
from skyquilt.multispectral.rig import BandRig, FindBandRig, Together
from skyquilt.photos.headers import content_digest
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import ReadFiles
from skyquilt.settings import MosaicSettings
from skyquilt.typed import as_path, instance
from skyquilt.version import __version__
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.flow import AlignedPhotos, Scene, exposure_of, labels_of, scene_of
from skyquilt.workflows.mosaic import FinishedMap, make_map
from skyquilt.workflows.survey_input import Source, SurveyInput, read_input

MOST_PAIRS = 6
"""Captures from which the camera of a band is found, distributed over the flight; each takes two
thirds of a second.
"""
LONGEST = 1600
"""Longest side in px of the pictures that are compared."""


def iter_bands(
    folder: Source | str,
    output: Path | str,
    settings: MosaicSettings | None = None,
    *,
    overwrite: bool = False,
    rerun_from: str | None = None,
) -> Iterator[Event]:
    """Makes the map, then `bands.tif` and indices of vegetation; the last event is the `Result`.

    Raises:
        UsageError: no file says that it shows one band of several.
        SkyquiltError: any other error that the user can correct.
    """
    settings, began = instance("settings", settings, MosaicSettings), Clock.now()
    output = as_path("output", output)
    files = ReadFiles(Store(folder=output / STATE / "store", registry=REGISTRY))
    given = read_input(folder, settings.input, files)
    others = given.survey.other_bands
    if not others:
        raise UsageError(
            "--all-bands needs files that each show one band of a multispectral camera and say so"
            " (BandName in their XMP); these do not"
        )
    made = yield from make_map(
        _without_reasons(given, others),
        output,
        settings,
        files=files,
        began=began,
        overwrite=overwrite,
        rerun_from=rerun_from,
    )
    yield from _bands(made, others)


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
    if isinstance(former, dict) and former.get("key") == key and _whole(output, former):
        yield Note(text=f"{output} already contains these bands; nothing to do")
        yield made.result
        return
    bands, refused, notes = yield from clock.stage("rig", _placed(scene, others), keeps=False)
    yield from (Note(text=n, warning=True) for n in notes)
    lost: list[RejectedPhoto] = []
    while True:
        drawing = _drawing(made, scene, bands, clock, key)
        try:
            yield from clock.stage("bands", drawing.blocks(clock.workers), keeps=False)
            break
        except PhotoFailedError as error:
            bands = [b.without(error.photo) for b in bands]
            lost.append(RejectedPhoto(name=error.photo, reason=error.reason))
            yield Note(text=f"{error.photo} is left out: {error.reason}", warning=True)
    values, indices = drawing.tags["VALUES"], [i.name for i in drawing.indices]
    files = _stamps(output, (BANDS_FILE, *(f"{name}.tif" for name in indices)))
    told = band_figures(bands, refused, lost, values, indices)
    figures = {"bands": told | {"key": "" if lost else key, "files": files}}
    write_bands(output, made.result.metrics, figures)
    yield Result(output=output, metrics={**made.result.metrics, **figures})


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
        (FindBandRig(), _placed, BandsDrawing),
        __version__,
    )


def _whole(output: Path, former: Mapping[str, Any]) -> bool:
    """Whether the rasters of an earlier run are as it wrote them."""
    files = former.get("files")
    return isinstance(files, dict) and bool(files) and files == _stamps(output, files)


def _stamps(output: Path, names: Iterable[str]) -> dict[str, str]:
    """What tells each of these files from another one."""
    return {name: stamp(output / name) for name in names}


def _placed(
    scene: Scene, others: Sequence[Photo]
) -> Steps[tuple[list[PlacedBand], dict[str, str], list[str]]]:
    """The bands that can be drawn, the reasons why others cannot, and notes."""
    aligned = scene.aligned
    shown = [p for i, p in enumerate(aligned.photos) if i in aligned.alignment.poses]
    captures = _captures(aligned)
    own = bands_of_files([p for p in shown if p.shows_a_band])
    found = bands_of_files(others)
    placed = [PlacedBand(files=band, of_photo=_own_files(aligned, band), rig=None) for band in own]
    refused: dict[str, str] = {}
    for done, band in enumerate(found):
        yield done, len(found), f"camera of {band.name}"
        of_photo = captured_together(aligned.photos, captures, band)
        of_photo = {i: j for i, j in of_photo.items() if i in aligned.alignment.poses}
        rig = _rig(aligned, band, of_photo)
        if isinstance(rig, RefusedRegistration):
            refused[band.name] = rig.reason
        else:
            placed.append(PlacedBand(files=band, of_photo=of_photo, rig=rig))
    yield len(found), len(found)
    notes = [f"The band {name} is left out: {reason}." for name, reason in refused.items()]
    names = [b.name for b in bands_of_files([p for b in placed for p in b.files.photos])]
    placed.sort(key=lambda b: names.index(b.files.name))
    return _comparable(placed), refused, notes


def _captures(aligned: AlignedPhotos) -> list[str]:
    """What the map's photos tell of the capture that they belong to."""
    return [tags_of(p).capture for p in aligned.photos]


def _own_files(aligned: AlignedPhotos, band: BandFiles) -> dict[int, int]:
    """Index of each of the map's photos -> that of the same file in a band of them."""
    number = {p.name: j for j, p in enumerate(band.photos)}
    return {i: number[p.name] for i, p in enumerate(aligned.photos) if p.name in number}


def _comparable(placed: Sequence[PlacedBand]) -> list[PlacedBand]:
    """The bands with values of the kind that all of them have; temperatures stay."""
    light = [b for b in placed if b.files.name != THERMAL]
    kind = common_kind([c for b in light for c in b.files.converts])
    return [
        b if b.files.name == THERMAL else replace(b, files=b.files.as_kind(kind)) for b in placed
    ]


def _rig(
    aligned: AlignedPhotos, band: BandFiles, of_photo: dict[int, int]
) -> BandRig | RefusedRegistration:
    """The camera of a band beside that of the map's photos."""
    alignment, pairs = aligned.alignment, sorted(of_photo.items())
    cameras = {aligned.photos[i].camera_key for i, _ in pairs}
    of_band = {band.photos[j].camera_key for _, j in pairs}
    if len(cameras) > 1 or len(of_band) > 1:
        most = max(len(cameras), len(of_band))
        return RefusedRegistration(reason=f"its files are of {most} cameras; map each by itself")
    if any(alignment.poses[i].cam_H_map is not None for i, _ in pairs):
        return RefusedRegistration(
            reason="the map's photos have no adjusted poses; use --method bundle"
        )
    asked = [pairs[k] for k in np.unique(np.linspace(0, len(pairs) - 1, MOST_PAIRS).astype(int))]
    seen = [t for i, j in asked if (t := _together(aligned, i, band.photos[j])) is not None]
    first = band.photos[pairs[0][1]] if pairs else None
    camera = Camera.ideal(width=1, height=1, focal=1.0) if first is None else first.lens
    sigma = 0.0 if first is None else first.focal.sigma_px / first.focal.px
    return FindBandRig()(seen, camera, sigma)


def _together(aligned: AlignedPhotos, index: int, other: Photo) -> Together | None:
    """Pictures of one capture; None where the band's file cannot be read."""
    try:
        grey = to_grey8(read_color(other))
    except Exception:  # whatever it is, it concerns this photo alone; told when it is drawn
        return None
    camera = aligned.alignment.camera(index)
    return Together(a=aligned.grey(index, LONGEST), camera_a=camera, b=shrink(grey, LONGEST)[0])


def _drawing(
    made: FinishedMap, scene: Scene, bands: Sequence[PlacedBand], clock: Clock, key: str
) -> BandsDrawing:
    """How the rasters are drawn."""
    aligned, ground, settings = scene.aligned, scene.ground, made.settings
    # both are in the store of the finished map
    exposure = exposure_of(
        aligned, ground, made.methods, settings.picture, clock.store, lambda _: None
    )
    labels, _ = labels_of(aligned, ground, exposure, made.methods, clock, lambda _: None)
    kind = common_kind([c for b in bands if b.files.name != THERMAL for c in b.files.converts])
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
