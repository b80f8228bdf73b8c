"""The workflow of two spectral bands: a visual map, and the thermal map on its grid.

    visual mosaic -> thermal mosaic -> registration of the two -> thermal.tif on the visual grid
    visual mosaic -> photos taken together -> their cameras' rotation -> thermal.tif on the visual
    poses

If one drone took both (by times or names), the relative rotation of the cameras is estimated once,
and the thermal photos are drawn with the poses of the visual ones. Otherwise each flight is
adjusted and mapped separately. The remaining offset of a few metres from their positions is removed
by registration of the finished maps [Yahyanejad 2013, 5.2.3]: of the images, or of the ground
heights, which are the same in every spectral band, by day and night, in summer and winter (5.8). If
no registration is accepted, the thermal map is placed by its own positions, and this is reported.
"""

from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.band_rig import FindBandRig
from skyquilt.coregistration.files import overlays, resample_onto
from skyquilt.coregistration.pictures import Source
from skyquilt.coregistration.rig import FindRig
from skyquilt.coregistration.workflow import residual
from skyquilt.engine.clock import Clock
from skyquilt.engine.folder import THERMAL_FILE, as_written, stamps
from skyquilt.engine.store import digest
from skyquilt.errors import PhotoFailedError, RefusedError, UsageError
from skyquilt.model.event import Event, Note, Result, StageFinished, StageStarted
from skyquilt.model.photo import RejectedPhoto, Survey
from skyquilt.model.registration import RefusedRegistration, Registration
from skyquilt.ortho.radiometry import recorded_tags, value_figures
from skyquilt.photos.guesses import as_thermal
from skyquilt.photos.pixels import lost
from skyquilt.photos.survey import survey_notes
from skyquilt.settings import DEFAULTS, MosaicSettings, PictureSettings
from skyquilt.thermal.by_heights import finer
from skyquilt.thermal.by_pairs import by_homographies, by_pairs
from skyquilt.thermal.by_rig import draw_rigged, drift_of_rigged, rig_figures, rig_notes, rigged
from skyquilt.thermal.page import write_overlays, write_section
from skyquilt.thermal.partners import partners
from skyquilt.thermal.routes import ROUTES, Joined, as_registration, join, opened, refuse_apart
from skyquilt.typed import as_path, instance
from skyquilt.version import __version__
from skyquilt.workflows.finishing import nothing_to_do
from skyquilt.workflows.flow import Scene
from skyquilt.workflows.methods import methods_for
from skyquilt.workflows.mosaic import FinishedMap, make_map, run_key
from skyquilt.workflows.run_report import write_figures
from skyquilt.workflows.survey_input import SurveyInput, read_input

FOLDER = "thermal"
"""Folder of the thermal run, below the visual one's."""
_BY_POSITIONS = (
    "the thermal map is placed by the positions of both flights alone: without RTK it lies several"
    " metres beside the visual map, so it does not tell which roof or plant is warm; check that"
    " both flights show the same place, or fly both with RTK"
)


def iter_thermal(
    photos: Path | str,
    thermal: Path | str,
    output: Path | str,
    settings: MosaicSettings | None = None,
    *,
    route: str = "auto",
    overwrite: bool = False,
    rerun_from: str | None = None,
) -> Iterator[Event]:
    """Makes the visual map and the thermal map on its grid; the last event is the `Result` of both.

    Raises:
        RefusedError: the requested method is refused; both maps have been written by then.
        SkyquiltError: any other error that the user can correct.
    """
    asked, output = instance("settings", settings, MosaicSettings), as_path("output", output)
    settings, heated = _settings_of_both(asked)
    if route not in ROUTES:
        raise UsageError(f"--thermal-route {route!r} is not one of {', '.join(ROUTES)}")
    if not Path(thermal).is_dir():
        raise UsageError(
            f"--thermal {thermal} is not a folder; give the folder of the thermal photos"
        )
    heats = read_input(thermal, heated.input)
    if heats.survey.clips:
        heats, said = _without_clips(heats, Path(thermal))
        yield Note(text=said, warning=True)
    given = read_input(photos, settings.input)
    given, fewer = _of_spectrum(given, "visible", "the visual map")
    heats, more = _of_spectrum(heats, "thermal", "the thermal map")
    yield from (Note(text=text) for text in (*fewer, *more))
    if {p.digest for p in heats.survey.photos} <= {p.digest for p in given.survey.photos}:
        known = any(p.band == "thermal" for p in heats.survey.photos)
        raise UsageError(
            f"the photos of --thermal {thermal} are those of the visual map, and "
            + (
                "all are thermal; for a map of them alone, leave --thermal out"
                if known
                else "none is known to be thermal; give the folder of the thermal photos"
            )
        )
    if asked.input.thermal_unit is None and not any(p.stored for p in heats.survey.photos):
        heated = heated.changed(thermal_unit=None)  # it would be called idle
    refuse_apart(given.survey.photos, heats.survey.photos)
    if not any(p.band == "thermal" for p in heats.survey.photos):
        taken = tuple(map(as_thermal, heats.survey.photos))
        heats = replace(heats, survey=replace(heats.survey, photos=taken))
        yield Note(
            text=f"no file in {thermal} says that it is thermal; all are taken for pictures of a"
            " thermal camera, whose colours or greys show where it is warmer, not how warm",
            warning=True,
        )
    key = _key((given, settings), (heats, heated), route)
    visual = yield from make_map(
        given, output, settings, overwrite=overwrite, rerun_from=rerun_from
    )
    former = visual.result.metrics.get("thermal") or {}
    if former.get("key") == key and as_written(output, former.get("files")):
        yield from nothing_to_do(output, "this thermal map", heats.survey.rejected, former)
        yield visual.result
        return
    refused: tuple[tuple[str, str], ...] = ()
    if route in ("auto", "rig"):
        began = Clock.now()
        yield StageStarted(stage="rig", total=0)
        result = yield from _by_rig(visual, heats.survey, asked.picture, key)
        yield _finished("rig", began)
        if isinstance(result, Result):
            yield result
            return
        if route == "rig":
            raise RefusedError(
                f"the thermal photos cannot be placed by the visual poses: {result.reason}; use"
                " --thermal-route auto"
            )
        refused = (("rig", result.reason),)
    yield Note(text="the thermal photos are mapped separately, then registered to the visual map")
    crs = visual.result.metrics["crs"] or settings.picture.crs
    heat = yield from make_map(
        heats, output / FOLDER, heated.changed(crs=crs), overwrite=overwrite, rerun_from=rerun_from
    )
    lost = len(heat.given.survey.photos) < len(heats.survey.photos)  # with them it is another map
    yield from _joined(visual, heat, route, refused, "" if lost else key)


def _key(
    visual: tuple[SurveyInput, MosaicSettings],
    thermal: tuple[SurveyInput, MosaicSettings],
    route: str,
) -> str:
    """What a thermal map depends on: both surveys, how their maps are brought together, the
    program.
    """
    maps = [run_key(given, wanted, methods_for(wanted)) for given, wanted in (visual, thermal)]
    return digest(
        *maps, route, (FindRig(), FindBandRig(), join, partners, rigged, draw_rigged), __version__
    )


def _without_clips(heats: SurveyInput, folder: Path) -> tuple[SurveyInput, str]:
    """The thermal photos without the videos beside them, whose colours are no temperatures."""
    names = ", ".join(c.name for c in heats.survey.clips[:3])
    if not heats.survey.photos:
        raise UsageError(
            f"--thermal {folder} holds only videos ({names}), whose colours are no temperatures;"
            " give the folder of the thermal photos"
        )
    survey = replace(heats.survey, clips=())
    return replace(heats, survey=survey), f"videos in {folder} were left out: {names}"


def _of_spectrum(given: SurveyInput, band: str, map_: str) -> tuple[SurveyInput, tuple[str, ...]]:
    """The photos of one spectrum of a folder that holds both, as drones with two cameras write it,
    and a sentence on the others; all where none is of it.
    """
    others = [p for p in given.survey.photos if p.band != band]
    if not others or len(others) == len(given.survey.photos):
        return given, ()
    reason = f"it is a {others[0].band} photo, and {map_} shows the {band} ones"
    kept = given.without([RejectedPhoto(name=p.name, reason=reason) for p in others])
    of_all, of_these = survey_notes(given.survey.photos), survey_notes(kept.survey.photos)
    notes = (*(n for n in given.survey.notes if n not in of_all), *of_these)
    kept = replace(kept, survey=replace(kept.survey, notes=notes))
    named = f"{len(others)} {others[0].band} photos in the folder, such as {others[0].name},"
    return kept, (f"{named} are left out of {map_}",)


def _settings_of_both(asked: MosaicSettings) -> tuple[MosaicSettings, MosaicSettings]:
    """Settings of the visual and of the thermal map: side files and areas apply to the visual map
    only.
    """
    named = asked.input.sequence in ("time", "name")
    own = (
        *("gcp", "geo", "cameras", "distances", "bounds", "boundary", "gsd_cm", "compress"),
        *("quality", "frame_overlap", "clock_offset", "write_frames"),
    )
    heated = asked.changed(
        **{name: DEFAULTS[name] for name in own},
        thermal_unit=asked.input.thermal_unit or "auto",
        sequence=asked.input.sequence if named else "time",
    )
    return asked.changed(thermal_unit=None, balance_thermal=None), heated


def _joined(
    visual: FinishedMap,
    heat: FinishedMap,
    route: str,
    refused: tuple[tuple[str, str], ...],
    key: str,
) -> Iterator[Event]:
    """thermal.tif by registration of the two maps, its report and figures."""
    output, began = visual.result.output, Clock.now()
    yield StageStarted(stage="join", total=0)
    a, b = (opened(made.result.output / "mosaic.tif") for made in (visual, heat))

    @cache
    def scenes() -> tuple[Scene, Scene]:
        return visual.scene(), heat.scene()

    joined = join(
        a,
        b,
        (output / "surface.tif", heat.result.output / "surface.tif"),
        route,
        pairs=lambda: by_pairs(*scenes()),
        homographies=lambda: by_homographies(*scenes()),
        finer=lambda outcome: finer(*scenes(), outcome),
    )
    joined = replace(joined, refused=(*refused, *joined.refused))
    tags = recorded_tags(heat.result.metrics)
    resample_onto(output / THERMAL_FILE, a, b, joined.thermal_H_visual, tags)
    figures = {"thermal": _figures(joined, heat.result, b)}
    pictures, told = overlays(a, b, as_registration(joined)), visual.result.metrics
    _leave(output, pictures, told, figures, key, [f"{FOLDER}/mosaic.tif"])
    yield _finished("join", began)
    yield from (
        Note(text=f"registration by {name} was refused: {why}", warning=True)
        for name, why in joined.refused
    )
    if joined.route == "positions":
        yield Note(text=_BY_POSITIONS, warning=True)
    yield Result(output=output, metrics={**visual.result.metrics, **figures})


def _finished(stage: str, began: tuple[float, float]) -> StageFinished:
    now = Clock.now()
    return StageFinished(
        stage=stage,
        seconds=round(now[0] - began[0], 3),
        cpu_seconds=round(now[1] - began[1], 3),
        reused=False,
    )


def _by_rig(
    visual: FinishedMap, thermal: Survey, picture: PictureSettings, key: str
) -> Generator[Event, None, Result | RefusedRegistration]:
    """thermal.tif from the visual poses if one drone took both, or the reason why this is not
    possible. Frames that are lost meanwhile are left out.
    """
    if not partners(visual.given.survey.photos, thermal.photos).beside:
        return RefusedRegistration(
            reason="no thermal photo was taken at the same time as a visual one, by time or name"
        )
    scene = visual.scene()
    found = rigged(scene, thermal.photos)
    if isinstance(found, RefusedRegistration):
        return found
    left = {r.name for r in found.rejected}
    if any(lost(p) for p in thermal.photos if p.name in left):
        key = ""  # with all files it is another map
    yield from (Note(text=text) for text in thermal.notes)
    yield from rig_notes(found)
    output, metrics = visual.result.output, visual.result.metrics
    while True:
        try:
            exposure = drift_of_rigged(found, scene, visual.methods.drift, picture)
            draw_rigged(output / THERMAL_FILE, found, scene, visual.methods.blend, exposure)
            break
        except PhotoFailedError as error:
            found, key = found.without(error), ""
            yield Note(text=f"{error.photo} is left out: {error.reason}", warning=True)
        if len(found.alignment.poses) < FindRig.minimum:
            return RefusedRegistration(
                reason=f"{len(found.alignment.poses)} thermal photos are left that were taken"
                " together with a visual one"
            )
    none = np.zeros((0, 2))
    same = Registration(model="identity", b_H_a=np.eye(3), px_a=none, px_b=none)
    figures = {"thermal": rig_figures(found, thermal)}
    figures["thermal"] |= value_figures(found.photos, exposure, picture)
    pictures = overlays(opened(output / "mosaic.tif"), opened(output / THERMAL_FILE), same)
    _leave(output, pictures, metrics, figures, key)
    return Result(output=output, metrics={**metrics, **figures})


def _leave(
    output: Path,
    pictures: list[NDArray[np.uint8]],
    visual: Mapping[str, Any],
    figures: dict[str, Any],
    key: str,
    more: Sequence[str] = (),
) -> None:
    """Writes the overlays, the report's section, and finally the figures; with these the key of the
    thermal map, and what its files (`more`: beside those written here) are known by.
    """
    names = write_overlays(output, pictures)
    write_section(output, opened(output / THERMAL_FILE), pictures, figures["thermal"])
    figures["thermal"] |= {"key": key, "files": stamps(output, [THERMAL_FILE, *names, *more])}
    write_figures(output, {**visual, **figures})


def _figures(joined: Joined, heat: Result, b: Source) -> dict[str, Any]:
    m, outcome = heat.metrics, joined.outcome
    # a registration by heights uses all cells, not corresponding points
    exact = outcome is not None and "cells" in outcome.evidence
    error = residual(outcome) if outcome and len(outcome.px_a) and not exact else None
    return {
        "route": joined.route,
        "routes_refused": dict(joined.refused),
        "unit": b.unit,
        "thermal_H_visual": joined.thermal_H_visual.tolist(),
        "model": outcome.model if outcome else "positions",
        "inliers": len(outcome.px_a) if outcome else 0,
        "evidence": dict(outcome.evidence) if outcome else {},
        "residual_px": error,
        "residual_m": None if error is None else round(error * float(m["gsd_m"]), 4),
        "thermal_values": m.get("thermal_values"),
        "photos_used": m["photos_used"],
        "photos_total": m["photos_total"],
        "photos_rejected": m["photos_rejected"],
        "gsd_m": m["gsd_m"],
        "blocks": m["blocks"],
        "method": m["method"],
    }
