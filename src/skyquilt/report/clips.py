"""Section: the clips, and which of their frames the map is made of."""

from collections.abc import Mapping
from typing import Any

from skyquilt.report.input import ReportInput
from skyquilt.report.numbers import DASH, count, fixed, items, mapping, number, plain
from skyquilt.report.parts import Section, Table

MOST_ROWS = 300
WHY = {
    "first": "first sharp frame",
    "overlap": "wanted overlap reached",
    "sharpest": "sharpest near the wanted overlap",
    "cut": "first sharp frame after a break in what is seen",
    "last": "end of what is seen",
}
OFFSETS = {
    "turns": "found from the flight",
    "option": "given",
    "span": "not found; positions begin with the clip",
    "clock": "not found; clocks taken as they are",
    "none": "no positions",
}
FOCALS = {
    "mode": "the table of video modes",
    "sensor": "the sensor table",
    "35mm": "the 35 mm equivalent in the telemetry",
    "guess": "a guess",
}
READOUTS = {
    "table": "the table of shutters",
    "option": "given",
    "guess": "a guess",
    "global": "given: all rows at once",
}


def clips_section(data: ReportInput) -> tuple[Section, ...]:
    """A table of clips and one of the chosen frames; nothing where there are no clips."""
    clips = [mapping(c) for c in items(data.metrics.get("clips"))]
    if not clips:
        return ()
    summary = Table(
        title="Clips",
        head=(
            "Clip",
            "Frames looked at",
            "used",
            "with a position",
            "blurred",
            "standing still",
            "Overlap, median",
            "Clock offset, s",
            "\u00b1",
            "",
        ),
        rows=tuple(_row(c) for c in clips),
        numeric="cnnnnnnnnt",
        note="Blurred and standing still: of the frames looked at. The clock offset is added to the"
        " clip\u2019s time to get that of its positions.",
    )
    frames = [f for c in clips for f in map(mapping, items(c.get("frames")))]
    chosen = Table(
        title="Frames used, and why",
        head=("Frame", "Time, s", "Overlap with the one before", "Sharpness", "Why"),
        rows=tuple(_frame(f) for f in frames[:MOST_ROWS]),
        numeric="cnnnt",
        note="Sharpness: logarithm of fine detail against that of the looks around; below -0.3"
        " counts as blurred."
        + (
            f" {count(len(frames) - MOST_ROWS, 'frame')} more in metrics.json."
            if len(frames) > MOST_ROWS
            else ""
        ),
    )
    lenses = Table(
        title="Video modes, before the adjustment",
        head=("Clip", "Focal length, px", "\u00b1", "from", "Readout, ms", "\u00b1", "from"),
        rows=tuple(_lens(c) for c in clips),
        numeric="cnntnnt",
        note="What the adjustment made of them is under Camera calibration.",
    )
    lead = "Frames are chosen by overlap, sharpness and motion, not at fixed times."
    return (Section(id="clips", title="Clips", lead=lead, blocks=(summary, lenses, chosen)),)


def _lens(clip: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        plain(clip.get("name")),
        fixed(clip.get("focal_prior_px"), 0),
        fixed(clip.get("focal_prior_sigma_px"), 0),
        FOCALS.get(str(clip.get("focal_source")), ""),
        fixed(clip.get("readout_prior_ms"), 0),
        fixed(clip.get("readout_prior_sigma_ms"), 0),
        READOUTS.get(str(clip.get("readout_source")), ""),
    )


def _row(clip: Mapping[str, Any]) -> tuple[str, ...]:
    overlap = number(clip.get("overlap_median"))
    return (
        plain(clip.get("name")),
        fixed(clip.get("frames_looked_at"), 0),
        fixed(clip.get("frames_chosen"), 0),
        fixed(clip.get("frames_with_position"), 0),
        fixed(clip.get("blurred"), 0),
        fixed(clip.get("standing_still"), 0),
        DASH if overlap is None else f"{overlap:.0%}",
        fixed(clip.get("clock_offset_s"), 2, sign=True),
        fixed(clip.get("clock_offset_sigma_s"), 2),
        OFFSETS.get(str(clip.get("clock_offset_source")), ""),
    )


def _frame(frame: Mapping[str, Any]) -> tuple[str, ...]:
    overlap = number(frame.get("overlap"))
    return (
        plain(frame.get("name")),
        fixed(frame.get("time_s"), 2),
        DASH if overlap is None else f"{overlap:.0%}",
        fixed(frame.get("sharpness"), 2, sign=True),
        WHY.get(str(frame.get("why")), plain(frame.get("why"))),
    )
