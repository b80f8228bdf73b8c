"""What is worth a look: the weaknesses of a map in sentences, the worst first."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from skyquilt.alignment.outcome import UNDETERMINED, UNSETTLED
from skyquilt.photos.side_rows import sentence_of
from skyquilt.report import headline
from skyquilt.report.input import ReportInput
from skyquilt.report.numbers import count, fixed, items, mapping, number, plain

FEW_VIEWS, FEW_SHARE = 3, 0.1
"""Number of photos that show a place well, and the share of the map with fewer from which this is
told.
"""
LEAST_MS, LEAST_PX = 0.5, 0.05
"""Readout of a rolling shutter, and shift by it, below which it is none."""
Sentence = tuple[str, str]
"""A sentence, and the section that shows more."""


def attention(data: ReportInput) -> tuple[Sentence, ...]:
    """Sentences to be read first."""
    m = data.metrics
    return (
        *((plain(w), "") for w in items(m.get("warnings"))[:20]),
        *((plain(w), "") for w in data.doubts[:20]),
        *_poor(data),
        *_overlap(data),
        *_seams(m),
        *_shutter(m),
        *_counts(m),
        *(() if any(UNSETTLED in told for told in data.doubts) else _focal(m)),
        *_listed(m),
    )


def _poor(data: ReportInput) -> Iterator[Sentence]:
    """Headline figures that are poor."""
    for tile in headline.tiles(data):
        if tile.verdict == "poor" and tile.label != "Seam disparity":
            yield f"{tile.label}: {tile.value} {tile.unit}".rstrip() + ".", tile.anchor
    if holes := number(data.metrics.get("holes_m2")):
        n = number(data.metrics.get("holes")) or 0
        if holes > 1:
            yield f"{count(n, 'hole')} in the map, {fixed(holes, 0)} m\u00b2 in all.", "overlap"


def _overlap(data: ReportInput) -> Iterator[Sentence]:
    """Ground that too few photos show."""
    if data.views is None:
        return
    seen = np.asarray(data.views)[np.asarray(data.views) > 0]
    if not seen.size:
        return
    once, few = float((seen == 1).mean()), float((seen < FEW_VIEWS).mean())
    if few >= FEW_SHARE:
        yield (
            f"Poor overlap: {few:.0%} of the map is shown by fewer than {FEW_VIEWS} photos"
            f" ({once:.0%} by one alone). Heights there are interpolated, and nothing checks them;"
            " fly lines closer together, or do not use the edges.",
            "overlap",
        )


def _seams(m: Mapping[str, Any]) -> Iterator[Sentence]:
    """Seams that disagree, or that could not be measured."""
    seams = mapping(m.get("seam_disparity_px"))
    median, p95 = number(seams.get("median")), number(seams.get("p95"))
    measured, attempted = number(seams.get("measured")), number(seams.get("attempted"))
    if median is not None and median > headline.SEAM_FAIR_PX:
        worst = "" if p95 is None else f", 5\u202f% by more than {fixed(p95, 1)} px"
        yield f"Photos disagree at the seams by {fixed(median, 1)} px{worst}.", "seams"
    if measured is not None and attempted and measured / attempted < headline.SEAMS_MEASURED:
        yield (
            f"Few seams measured: {fixed(measured, 0)} of {fixed(attempted, 0)} places"
            f" ({measured / attempted:.0%}). At the others the two photos look too different"
            " (trees, water, moving things): steps there are not in the figure.",
            "seams",
        )


def _shutter(m: Mapping[str, Any]) -> Iterator[Sentence]:
    """Rolling shutters whose effect is not, or hardly, known: cameras of one kind in one sentence,
    since each size of photos is a camera.
    """
    untold, unmoved, guessed = list[str](), dict[str, list[str]](), list[str]()
    for camera, entry in mapping(m.get("shutter")).items():
        told = mapping(entry)
        readout, source = number(told.get("readout_ms")) or 0.0, told.get("source")
        moved = number(told.get("largest_displacement_px")) or 0.0
        if source == "unknown":
            untold.append(plain(camera))
        elif readout >= LEAST_MS and moved == 0:
            unmoved.setdefault(fixed(readout, 0), []).append(plain(camera))
        elif source == "guess" and moved >= LEAST_PX:
            guessed.append(
                f"Nothing tells the readout of {plain(camera)}, whose shutter is rolling: a guess"
                f" of {fixed(told.get('prior_ms'), 0)} ms was adjusted to {fixed(readout, 1)}"
                f" \u00b1 {fixed(told.get('sigma_ms'), 1)} ms, which moves places by up to"
                f" {fixed(moved, 1)} px; --shutter-readout if you know better."
            )
    if untold:
        yield (
            f"Shutter not modelled: nothing says how {sentence_of(untold)}"
            f" {'expose. If their' if len(untold) > 1 else 'exposes. If its'} shutter is rolling,"
            " give --shutter rolling and --shutter-readout.",
            "cameras",
        )
    for ms, cameras in unmoved.items():
        yield (
            f"Shutter not modelled: that of {sentence_of(cameras)} is rolling ({ms} ms), and"
            f" nothing tells how fast {'they' if len(cameras) > 1 else 'it'} moved.",
            "cameras",
        )
    yield from ((text, "cameras") for text in guessed)


def _counts(m: Mapping[str, Any]) -> Iterator[Sentence]:
    """Thermal values that are no temperatures."""
    for told in (m.get("thermal_values"), mapping(m.get("thermal")).get("thermal_values")):
        if mapping(told).get("unit") == "counts":
            yield (
                "Thermal values are sensor counts, not degrees: higher means warmer, by an unknown"
                " factor that may change from frame to frame.",
                "values",
            )


def _focal(m: Mapping[str, Any]) -> Iterator[Sentence]:
    """Heights that rest on the metadata's focal length."""
    accuracy = mapping(m.get("accuracy"))
    share = number(accuracy.get("focal_sigma_after_over_before"))
    up = number(mapping(accuracy.get("vertical_m")).get("median"))
    held = any(not mapping(c).get("check") for c in items(m.get("control")))
    if share is not None and share > UNDETERMINED and not held:
        height = "" if up is None else f"; heights are uncertain by {fixed(up, 1)} m"
        yield (
            f"The flight does not determine the focal length, which stays about that of the"
            f" metadata"
            f"{height}. Control points, oblique photos or lines at two heights would.",
            "cameras",
        )


def _listed(m: Mapping[str, Any]) -> Iterator[Sentence]:
    """Numbers of what is listed below."""
    conflicts = [mapping(c) for c in items(m.get("metadata_conflicts"))]
    if conflicts:
        kinds = sorted({str(c.get("field", "")).replace("_", " ") for c in conflicts} - {""})
        of = f" ({', '.join(kinds)})" if kinds else ""
        yield f"{count(len(conflicts), 'metadata conflict')}{of}.", "conflicts"
    rejected = mapping(m.get("photos_rejected"))
    if rejected:
        name, why = next(iter(rejected.items()))
        told = f": {plain(name)} ({plain(why)})" if len(rejected) == 1 else ""
        yield f"{count(len(rejected), 'photo')} rejected{told}.", "rejected"
