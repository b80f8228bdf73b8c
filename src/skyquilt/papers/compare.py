"""Every method of alignment on one survey, side by side (Y Table 6.1, Fig. 6.4; A Tables 1, 2)."""

import csv
import io
import json
import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt.effects import MOSAIC, OF_METHODS, option_of, taken
from skyquilt.engine.clock import Clock
from skyquilt.engine.folder import STATE, remove_run
from skyquilt.engine.store import Store, digest
from skyquilt.errors import AlignmentError, UsageError
from skyquilt.model.event import Event, Note, Result, StageFinished, StageProgress, StageStarted
from skyquilt.model.photo import ControlPoint
from skyquilt.model.poses import Alignment
from skyquilt.papers.baselines import REPEATS, baselines, judged, told, unjudged
from skyquilt.papers.compare_state import taken_up
from skyquilt.papers.comparison_page import comparison_page
from skyquilt.photos.distances import read_distances
from skyquilt.photos.gcp import read_gcp_list
from skyquilt.raster.atomic import write_text
from skyquilt.raster.drivers import GEOTIFF
from skyquilt.settings import DEFAULTS, MosaicSettings
from skyquilt.typed import typed
from skyquilt.version import __version__
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.flow import frames_added
from skyquilt.workflows.methods import methods_for
from skyquilt.workflows.mosaic import make_map, run_key
from skyquilt.workflows.survey_input import SurveyInput, read_input

VARIANTS: dict[str, dict[str, Any]] = {
    "position": {"method": "position"},
    "pose": {"method": "pose"},
    "image": {"method": "image"},
    "image-overview": {"method": "image", "image_search": "overview"},
    "hybrid": {"method": "hybrid", "optimiser": "surfaces"},
    "hybrid-anneal": {"method": "hybrid", "optimiser": "anneal"},
    "flightline": {"method": "flightline"},
    "bundle": {"method": "bundle"},
}
"""Name of a column -> the settings that it changes."""
TRUSTED = ("pose", "hybrid")
"""Methods that are also run with uncorrected metadata if a correction changed something."""
MOST_POINTS = 6
"""Largest number of points between which distances are compared."""


@dataclass(frozen=True, kw_only=True)
class CompareSettings:
    """Settings of a comparison."""

    mosaic: MosaicSettings
    """Settings common to all methods."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Columns, of `VARIANTS`."""
    first: int | None = None
    """Only this many photos, the first in order of capture; None = all."""
    known: Path | None = None
    """Points with known coordinates (gcp_list.txt), used only to check the results, never for
    alignment.
    """

    given: tuple[tuple[str, Any], ...] = ()
    """Settings of single methods (names and values); each column gets those that apply to it."""

    def asked(self, base: MosaicSettings, name: str) -> MosaicSettings:
        """The settings of a column: those common to all, without what it does not take."""
        others = {s: DEFAULTS[s] for s in OF_METHODS if not taken(VARIANTS[name]["method"], s)}
        changed = {**others, **dict(self._own(name)), **VARIANTS[name]}
        values = {**dict(base), **changed}
        for rule in MOSAIC:
            if rule.idle(values):
                changed |= {s: DEFAULTS[s] for s in rule.settings}
        return base.changed(**changed)

    def _own(self, name: str) -> list[tuple[str, Any]]:
        return [(k, v) for k, v in self.given if self._takes(name, k)]

    def _takes(self, name: str, setting: str) -> bool:
        values = {**DEFAULTS, **dict(self.mosaic), **dict(self.given), **VARIANTS[name]}
        idle = any(setting in rule.settings and rule.idle(values) for rule in MOSAIC)
        return taken(values["method"], setting) and not idle

    def __post_init__(self) -> None:
        typed(self)
        strange = [v for v in self.variants if v not in VARIANTS]
        if strange or not self.variants:
            raise UsageError(
                f"--methods {','.join(strange) or 'nothing'}: choose of {', '.join(VARIANTS)}"
            )
        if self.first is not None and self.first < 2:
            raise UsageError(f"--first {self.first}: a comparison needs two photos or more")
        taken = {k for v in self.variants for k, _ in self._own(v)}
        for setting, _ in self.given:
            if setting not in taken:
                raise UsageError(
                    f"--{option_of(setting)} has no effect on {', '.join(self.variants)}"
                )
        for name in self.variants:
            self.asked(self.mosaic, name)  # refuses invalid values at once


def iter_compare(
    folder: Path, output: Path, settings: CompareSettings, *, overwrite: bool = False
) -> Iterator[Event]:
    """Runs every method in a separate folder below `output`, then writes compare.json and
    report.html. A comparison that was stopped continues: finished runs are not repeated.

    Raises:
        SkyquiltError: the photos, the output or an option is wrong; a method that cannot place the
            photos is not an error; it gets a row with the reason.
    """
    given = read_input(folder, settings.mosaic.input)
    given = given if given.survey.clips else _compared(given, settings.first)
    key = digest(
        run_key(given, settings.mosaic, methods_for(settings.mosaic)),
        _content(settings.known),
        settings.first if given.survey.clips else None,
    )
    state, goes_on = taken_up(output, key, overwrite=overwrite)
    if given.survey.clips:  # looked through once for all methods
        clock = Clock(
            store=Store(folder=output / STATE / "store", registry=REGISTRY), began=Clock.now()
        )
        given = yield from frames_added(given, settings.mosaic, clock)
        given = _compared(given, settings.first)
    rows = _Rows(given, output, overwrite=overwrite or goes_on)  # the runs below belong to it
    base, says = _judged_by(given, output, settings)
    state.write(output)
    for name in settings.variants:
        asked = settings.asked(base, name)
        yield from rows.run(name, asked)
        if name in TRUSTED and asked.input.repair and rows.contradicted(name):
            trusting = asked.changed(repair=False, detector=None, matcher=None, estimator=None)
            yield from rows.run(f"{name}-trusted", trusting)
    order = [n for v in settings.variants for n in (v, f"{v}-trusted") if n in rows.by_name]
    _remove_others(output, order)
    names = [p.name for p in given.survey.photos]
    record = _record({n: rows.by_name[n] for n in order}, names, says, folder)
    if base.input.distances is None:
        record = _by_baselines(record, given, output, base.picture.crs)
    write_text(output / "compare.json", json.dumps(record, indent=1, allow_nan=False))
    write_text(output / "report.html", comparison_page(record, _previews(output, order)))
    state.done = True
    state.write(output)
    yield Result(output=output, metrics=record)


def _remove_others(output: Path, columns: Sequence[str]) -> None:
    """Removes what an earlier comparison left in the folder: columns that this one does not have,
    perhaps of other photos.
    """
    for name in (n for v in VARIANTS for n in (v, f"{v}-trusted")):
        if name not in columns:
            remove_run(output / name)


class _Rows:
    """One run per column."""

    def __init__(self, given: SurveyInput, output: Path, *, overwrite: bool) -> None:
        self.given, self.output, self.overwrite = given, output, overwrite
        self.by_name: dict[str, dict[str, Any]] = {}

    def run(self, name: str, settings: MosaicSettings) -> Generator[Event, None, None]:
        """Runs a method; its stages carry its name."""
        notes: list[str] = []
        given = self.given
        if settings.input.distances is not None:
            names = [p.name for p in given.survey.photos]
            known = read_distances(settings.input.distances, names, given.control)
            given = replace(given, distances=known)
        steps = make_map(given, self.output / name, settings, overwrite=self.overwrite)
        try:
            while True:
                event = next(steps)
                if isinstance(event, Note):
                    notes.append(event.text)
                elif isinstance(event, StageStarted | StageProgress | StageFinished):
                    yield replace(event, stage=f"{name}: {event.stage}")
        except StopIteration as stop:
            metrics = dict(stop.value.result.metrics)
            self.by_name[name] = {"metrics": metrics, "notes": notes}
        except AlignmentError as error:
            yield Note(text=f"{name}: {error}", warning=True)
            self.by_name[name] = {"refused": str(error), "notes": notes}

    def contradicted(self, name: str) -> bool:
        """Whether a run found metadata that contradict the image content."""
        return bool(self.by_name[name].get("metrics", {}).get("metadata_conflicts"))


def _compared(given: SurveyInput, count: int | None) -> SurveyInput:
    """The survey with only the first `count` photos in order of capture.

    Raises:
        UsageError: there is one photo, by which no two methods differ.
    """
    if len(given.survey.photos) < 2:
        lost = "; ".join(f"{r.name}: {r.reason}" for r in given.survey.rejected[:3])
        raise UsageError(
            "a comparison needs two photos or more, and one can be read here"
            + (f" (left out: {lost})" if lost else "")
        )
    if count is None:
        return given
    photos = given.survey.photos[:count]
    source = [p.path for p in photos]
    return replace(given, source=source, survey=replace(given.survey, photos=photos))


def _content(path: Path | None) -> bytes:
    return path.read_bytes() if path is not None and path.is_file() else b""


def _judged_by(
    given: SurveyInput, output: Path, settings: CompareSettings
) -> tuple[MosaicSettings, str]:
    """Settings with the known distances for the check, and their source."""
    base = settings.mosaic
    if base.input.distances is not None:
        return base, f"known distances of {base.input.distances.name}"
    if settings.known is None:
        return base, "nothing: no distances are known, and fewer than two photos tell their place"
    control, _ = read_gcp_list(settings.known, [p.name for p in given.survey.photos])
    seen = [c for c in control if c.observations][:MOST_POINTS]
    if len(seen) < 2:
        return base, f"nothing: fewer than two points of {settings.known.name} are visible"
    path = _write_distances(output / "distances.csv", _between(seen))
    says = f"distances between {len(seen)} points of {settings.known.name}"
    return base.changed(distances=path), says


Row = tuple[str, str, float, Any, Any]


def _between(points: Sequence[ControlPoint]) -> list[Row]:
    """Horizontal distances between all points, with all their observations paired."""
    rows: list[Row] = []
    for k, a in enumerate(points):
        for b in points[k + 1 :]:
            metres = math.hypot(a.x - b.x, a.y - b.y)
            rows += [
                (a.name, b.name, metres, oa, ob) for oa in a.observations for ob in b.observations
            ]
    return rows


def _write_distances(path: Path, rows: Sequence[Row]) -> Path:
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(
        ["point_a", "point_b", "metres", "px_a", "py_a", "image_a", "px_b", "py_b", "image_b"]
    )
    for a, b, metres, oa, ob in rows:
        table.writerow(
            [
                a,
                b,
                f"{metres:.4f}",
                f"{oa.x:.3f}",
                f"{oa.y:.3f}",
                oa.photo,
                f"{ob.x:.3f}",
                f"{ob.y:.3f}",
                ob.photo,
            ]
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text.getvalue())
    return path


def _by_baselines(
    record: dict[str, Any], given: SurveyInput, output: Path, crs: str | None
) -> dict[str, Any]:
    """The record judged by distances between cameras, if the photos have positions."""
    known = baselines(given.survey.photos, crs)
    if not known:
        return record
    columns = {
        name: column
        if "refused" in column
        else unjudged(column, known)
        if name in REPEATS
        else judged(column, output / name, known)
        for name, column in record["methods"].items()
    }
    return record | {"judged_by": told(known), "methods": columns}


def alignment_of(run: Path) -> Alignment | None:
    """The alignment of a run just made."""
    store = Store(folder=run / STATE / "store", registry=REGISTRY)
    found = sorted(
        (run / STATE / "store" / "alignment").glob("*.npz"), key=lambda p: p.stat().st_mtime
    )
    kept = store.get("alignment", found[-1].stem) if found else None
    return kept if isinstance(kept, Alignment) else None


def _record(
    rows: Mapping[str, Mapping[str, Any]], photos: Sequence[str], says: str, folder: Path
) -> dict[str, Any]:
    """The record of compare.json: a column per method, with the figures of Y Table 6.1 and A Tables
    1 and 2.
    """
    return {
        "title": folder.name,
        "version": __version__,
        "photos": list(photos),
        "judged_by": says,
        "methods": {name: _column(row) for name, row in rows.items()},
    }


def _column(row: Mapping[str, Any]) -> dict[str, Any]:
    if "refused" in row:
        return {"refused": row["refused"]}
    m = row["metrics"]
    q = m["quality"]
    return {
        "placed": m["photos_used"],
        "blocks": m["blocks"],
        "distances": [
            {**d, "error_m": None if d["on_map"] is None else round(d["on_map"] - d["metres"], 4)}
            for d in q.get("distances", [])
        ],
        **{
            k: q[k]
            for k in ("alpha", "lambda_spat", "lambda_spat_of_table", "lambda_corr", "lambda")
        },
        "geolocation_mae_m": q.get("geolocation_mae_m"),
        "geolocation_rms_m": q.get("geolocation_rms_m"),
        "ste_per_inlier_px2": q.get("ste_per_inlier_px2"),
        "seam_disparity_px": m["seam_disparity_px"],
        "seconds": m["seconds"]["total"],
        "align_seconds": m["seconds"].get("align"),
        "cpu_seconds": m["cpu_seconds"],
        "photos": q["photos"],
        "correlation_with_last_of_photo": q["correlation_with_last_of_photo"],
        "correlation_with_map_of_photo": q["correlation_with_map_of_photo"],
        "off_position_over_width": q["off_position_over_width"],
        "notes": [*m["notes"]],
    }


def _previews(output: Path, names: Sequence[str]) -> dict[str, Any]:
    """Small images (h, w, 4) of the mosaics, from their overviews."""
    import rasterio

    out = {}
    for name in names:
        path = output / name / "mosaic.tif"
        if not path.is_file():
            continue
        with rasterio.open(path, driver=GEOTIFF) as source:
            factor = max(1.0, max(source.width, source.height) / 900)
            shape = (max(1, int(source.height / factor)), max(1, int(source.width / factor)))
            bands = source.read(out_shape=(source.count, *shape))
            mask = source.dataset_mask(out_shape=shape)
        out[name] = _rgba(bands, mask)
    return out


def _rgba(bands: np.ndarray, mask: np.ndarray) -> np.ndarray:
    if bands.dtype != np.uint8:
        values = bands.astype(np.float32)
        low, high = np.nanpercentile(np.where(mask > 0, values, np.nan), [1, 99])
        bands = np.clip(
            (np.nan_to_num(values, nan=low) - low) / max(high - low, 1e-6) * 255, 0, 255
        ).astype(np.uint8)
    grey_or_rgb = bands[:3] if len(bands) >= 3 else np.repeat(bands[:1], 3, 0)
    return np.dstack([*grey_or_rgb, mask.astype(np.uint8)])
