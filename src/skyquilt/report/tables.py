"""Sections made of tables: calibration, control points, contradictions, rejected photos,
settings.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from skyquilt.report.input import ReportInput
from skyquilt.report.numbers import (
    DASH,
    axes,
    count,
    fixed,
    items,
    mapping,
    number,
    plain,
    significant,
)
from skyquilt.report.parts import Block, Missing, Section, Sentences, Table

MOST_ROWS = 200
MEANINGS = {
    "focal": "focal length, px",
    "cx": "principal point, from the left, px",
    "cy": "principal point, from the top, px",
    "k1": "radial distortion, r\u00b2",
    "k2": "radial distortion, r\u2074",
    "k3": "radial distortion, r\u2076",
    "p1": "tangential distortion",
    "p2": "tangential distortion",
    "aspect": "focal length along columns over rows",
}
FAR = 3.0
"""Number of standard deviations of the prior from which a parameter counts as far from it."""
UNITS = {"yaw": "\u00b0", "altitude": " m", "position": " m", "focal": " px"} | dict.fromkeys(
    ("lens", "principal_point", "calibration"), " px"
)


def calibration_section(data: ReportInput) -> Section:
    """Intrinsics with standard deviations and priors, a table per camera."""
    cameras = mapping(data.metrics.get("cameras"))
    blocks: list[Block] = [_camera(str(k), v) for k, v in list(cameras.items())[:12] if mapping(v)]
    if not blocks:
        blocks = [
            Missing(
                why="No calibration was estimated: the values in the photos\u2019 metadata were "
                "used unchanged."
            )
        ]
    if len(cameras) > 12:
        blocks.append(Missing(why=f"{count(len(cameras) - 12, 'camera')} more in metrics.json."))
    return Section(id="cameras", title="Camera calibration", blocks=tuple(blocks))


def _camera(name: str, parameters: Mapping[str, Any]) -> Table:
    rows, far = [], []
    for key, entry in parameters.items():
        entry = mapping(entry) or {"value": entry}
        value, sigma, prior, prior_sigma = (
            number(entry.get(k)) for k in ("value", "sigma", "prior", "prior_sigma")
        )
        pixels = key in ("focal", "cx", "cy")
        shown = [
            fixed(v, 1) if pixels else significant(v) for v in (value, sigma, prior, prior_sigma)
        ]
        held = sigma == 0 or (sigma is None and value == 0)
        moved = (
            (value - prior) / prior_sigma
            if value is not None and prior is not None and prior_sigma
            else None
        )
        if moved is not None and abs(moved) > FAR:
            far.append(key)
        rows.append(
            (
                key,
                MEANINGS.get(key, ""),
                shown[0],
                "held" if held else shown[1],
                shown[2],
                shown[3],
                fixed(moved, 1, sign=True),
            )
        )
    note = "The last column is the change from the prior in units of its standard deviation."
    if far:
        note += (
            f" More than {FAR:.0f} for {', '.join(far)}: the prior is wrong or the flight does not"
            " determine it."
        )
    return Table(
        title=name,
        head=("Parameter", "Meaning", "Value", "\u00b1", "Prior", "\u00b1", "Change, \u03c3"),
        rows=tuple(rows),
        numeric="ctnnnnn",
        note=note,
    )


def control_section(data: ReportInput) -> Section:
    """Control and check points."""
    points = [mapping(v) for v in items(data.metrics.get("control"))]
    if not any(points):
        why = "No surveyed points were given: absolute accuracy depends on the photos\u2019 GPS."
        return Section(id="control", title="Control and check points", blocks=(Missing(why=why),))
    rows = tuple(
        (
            plain(p.get("name")),
            "check" if p.get("check") else "control",
            *(fixed(p.get(k), 3, sign=True) for k in ("dx_m", "dy_m", "dz_m")),
            fixed(p.get("reprojection_px"), 2),
            fixed(p.get("sightings"), 0),
        )
        for p in sorted(points, key=lambda p: bool(p.get("check")))[:MOST_ROWS]
    )
    sums = [_rms(points, check, name) for check, name in ((False, "control"), (True, "check"))]
    offset = number(data.metrics.get("control_height_offset_m"))
    if offset:
        sums.append(
            f"Heights differ by {fixed(offset, 2, sign=True)} m between the two datums; this"
            " offset is removed."
        )
    return Section(
        id="control",
        title="Control and check points",
        lead="Solution minus survey. Control points were used in the adjustment; check points were "
        "not and are an independent test.",
        blocks=(
            Table(
                title="Residuals",
                head=(
                    "Point",
                    "Role",
                    "East, m",
                    "North, m",
                    "Up, m",
                    "Reprojection, px",
                    "Photos",
                ),
                rows=rows,
                numeric="ctnnnnn",
                note=" ".join(s for s in sums if s),
            ),
        ),
    )


def _rms(points: list[Mapping[str, Any]], check: bool, name: str) -> str:
    chosen = [p for p in points if bool(p.get("check")) == check]
    parts = []
    for key, word in (("dx_m", "east"), ("dy_m", "north"), ("dz_m", "up")):
        values = [v for p in chosen if (v := number(p.get(key))) is not None]
        if values:
            parts.append(f"{word} {fixed(float(np.sqrt(np.mean(np.square(values)))), 3)} m")
    return f"RMS of {count(len(chosen), name + ' point')}: {', '.join(parts)}." if parts else ""


def conflicts_section(data: ReportInput) -> Section:
    """Metadata that contradict the image observations."""
    found = [mapping(v) for v in items(data.metrics.get("metadata_conflicts"))]
    found = [c for c in found if c]
    if not found:
        why = "The metadata agree with what the photos show; no contradiction was found."
        if "metadata_conflicts" not in data.metrics:
            why = "The metadata were not compared with what the photos show."
        none = Missing(why=why)
        return Section(id="conflicts", title="Metadata conflicts", blocks=(none,))
    rows = tuple(
        (
            plain(c.get("photo")),
            plain(c.get("field")),
            _figure(c, "reported"),
            _figure(c, "estimated"),
            plain(c.get("meaning")) or "the metadata and the images disagree",
        )
        for c in found[:MOST_ROWS]
    )
    kinds = sorted({str(c.get("field")) for c in found})
    told = ", ".join(f"{sum(str(c.get('field')) == k for c in found)} \u00d7 {k}" for k in kinds)
    head = ("Photo", "Field", "Reported", "Estimated", "What it means")
    table = Table(
        title=f"Contradictions: {told}",
        head=head,
        rows=rows,
        numeric="ctnnt",
        note=_cut(len(found)),
    )
    return Section(
        id="conflicts",
        title="Metadata conflicts",
        lead="Metadata are measurements, not facts. These contradict the image observations and"
        " were not used as reported.",
        blocks=(table,),
    )


def _figure(conflict: Mapping[str, Any], key: str) -> str:
    value, field = conflict.get(key), str(conflict.get("field"))
    figure = number(value)
    if figure is not None:
        return fixed(figure, 1) + UNITS.get(field, "")
    if any(v is not None for v in axes(value)):
        return ", ".join(fixed(v, 1) for v in axes(value) if v is not None) + UNITS.get(field, "")
    return plain(value)


def rejected_section(data: ReportInput) -> Section:
    """Photos that were not used."""
    rejected = mapping(data.metrics.get("photos_rejected"))
    if not rejected:
        why = (
            "No photo was rejected."
            if "photos_rejected" in data.metrics
            else "Rejections were not recorded."
        )
        return Section(id="rejected", title="Rejected photos", blocks=(Missing(why=why),))
    rows = tuple((str(k), plain(v)) for k, v in list(rejected.items())[:MOST_ROWS])
    table = Table(
        title=count(len(rejected), "photo"),
        head=("Photo", "Reason"),
        rows=rows,
        numeric="ct",
        note=_cut(len(rejected)),
    )
    return Section(id="rejected", title="Rejected photos", blocks=(table,))


def _cut(n: int) -> str:
    return f"{n - MOST_ROWS} more in metrics.json." if n > MOST_ROWS else ""


def added_sentence(added: Mapping[str, Any]) -> str:
    """What became of photos that were added to a map: the entry `added` of metrics.json."""
    more, before = number(added.get("photos")) or 0, number(added.get("to")) or 0
    moved, share = number(added.get("moved")) or 0, number(added.get("share_made_anew")) or 0
    were = "was" if more == 1 else "were"
    return (
        f"{count(more, 'photo')} {were} added to a map of {fixed(before, 0)}, {fixed(moved, 0)} of"
        f" which moved; {fixed(100 * share, 0)} % of the map is made anew."
    )


def notes_section(data: ReportInput) -> Section:
    """Notes of the stages."""
    notes = tuple(plain(v) for v in items(data.metrics.get("notes")))[:MOST_ROWS]
    if added := mapping(data.metrics.get("added")):
        notes = (added_sentence(added), *notes)
    blocks: tuple[Block, ...] = (
        (Sentences(items=notes),) if notes else (Missing(why="No stage left a note."),)
    )
    return Section(id="notes", title="Notes", blocks=blocks)


def settings_section(data: ReportInput) -> Section:
    """The resolved settings, one row each."""
    rows = tuple(_flat(data.settings))
    if not rows:
        none = Missing(why="The settings were not recorded with this run.")
        return Section(id="settings", title="Settings", blocks=(none,))
    table = Table(
        title="As resolved for this run", head=("Name", "Value"), rows=rows[:500], numeric="ct"
    )
    return Section(id="settings", title="Settings", blocks=(table,), folded=True)


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", plain(value) or DASH
