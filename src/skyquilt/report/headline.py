"""The headline figures, each with a sentence that explains it and its thresholds."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from skyquilt.report.input import ReportInput
from skyquilt.report.numbers import axes, count, fixed, items, mapping, number, seconds, significant
from skyquilt.report.parts import Tile, Verdict

SEAMS_MEASURED, SEAM_GOOD_PX, SEAM_FAIR_PX = 0.6, 2.0, 5.0
"""Share of samples that must be measured, and displacements in px up to which seams are good and
fair.
"""


def verdict(value: float, good: float, fair: float) -> Verdict:
    """The verdict on a figure where smaller is better."""
    return "good" if value <= good else "fair" if value <= fair else "poor"


def tiles(data: ReportInput) -> tuple[Tile, ...]:
    """All headline figures for which there are data."""
    return tuple(_tiles(data))


def _tiles(data: ReportInput) -> Iterator[Tile]:
    m = data.metrics
    makers = (
        photos,
        georeference,
        blocks,
        gsd,
        area,
        reprojection,
        gps,
        leave_one_out,
        seam,
        checks,
        time,
        memory,
    )
    for make in makers:
        if tile := make(m, data):
            yield tile


def photos(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """Photos used, of all photos."""
    used, total = number(m.get("photos_used")), number(m.get("photos_total"))
    if used is None or not total:
        return None
    share = used / total
    return Tile(
        label="Photos used",
        value=f"{fixed(used, 0)} of {fixed(total, 0)}",
        anchor="rejected",
        verdict="good" if share >= 0.95 else "fair" if share >= 0.8 else "poor",
        says="A photo that is left out may leave a gap. Good from 95\u202f%, fair from 80\u202f%.",
    )


def georeference(m: Mapping[str, Any], data: ReportInput) -> Tile:
    """Whether the map is georeferenced."""
    if not data.crs:
        return Tile(
            label="Coordinates",
            value="not georeferenced",
            verdict="poor",
            anchor="map",
            says="The position on Earth is unknown. It needs photos with GPS, a geo.txt or control"
            " points.",
        )
    return Tile(
        label="Coordinates",
        value=data.crs,
        verdict="good",
        anchor="map",
        says=f"{crs_name(data.crs)}A GIS shows the map at its place.",
    )


def crs_name(crs: str) -> str:
    """A sentence with the name of a common coordinate system; empty for others."""
    code = crs.upper().removeprefix("EPSG:")
    if (
        len(code) == 5
        and code[:3] in ("326", "327")
        and code.isdigit()
        and 1 <= int(code[3:]) <= 60
    ):
        return f"WGS\u202f84 / UTM zone {int(code[3:])}{'N' if code[2] == '6' else 'S'}. "
    return ""


def blocks(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """Blocks of connected photos."""
    sizes = [n for v in items(m.get("blocks")) if (n := number(v)) is not None]
    if not sizes:
        return None
    says = "All photos are connected by tie points. One block is good."
    if len(sizes) > 1:
        listed = ", ".join(fixed(n, 0) for n in sizes[:6]) + (" \u2026" if len(sizes) > 6 else "")
        says = (
            f"Blocks of {listed} photos, each placed by its own GPS: expect offsets between them."
            " One block is good."
        )
    return Tile(
        label="Blocks",
        value=fixed(len(sizes), 0),
        verdict="good" if len(sizes) == 1 else "fair",
        says=says,
    )


def gsd(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """Ground size of a pixel."""
    value = number(m.get("gsd_m"))
    if value is None:
        return None
    if not data.metric:
        return Tile(
            label="Pixel size", value=significant(value), unit="units", says="The scale is unknown."
        )
    says = (
        f"Side of one map pixel on the ground; objects of about {fixed(value * 300, 0)} cm can be"
        " recognised."
    )
    return Tile(
        label="Ground sampling distance", value=significant(value * 100), unit="cm", says=says
    )


def area(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """Area of ground that the map covers."""
    value = number(m.get("area_m2"))
    if value is None and data.preview is not None and data.bounds is not None and data.preview.size:
        west, south, east, north = data.bounds
        value = float((data.preview[::4, ::4, 3] > 127).mean()) * (east - west) * (north - south)
    if value is None:
        return None
    if not data.metric:
        return Tile(
            label="Area",
            value=significant(value),
            unit="square units",
            says="The scale is unknown.",
        )
    large = value >= 1e4
    return Tile(
        label="Area",
        value=fixed(value / 1e4, 2) if large else fixed(value, 0),
        unit="ha" if large else "m\u00b2",
        says="Area of the map without holes.",
    )


def reprojection(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """Reprojection error of the tie points."""
    error = mapping(m.get("reprojection_error_px"))
    mean, rms = number(error.get("mean")), number(error.get("rms"))
    shown = mean if mean is not None else rms
    if shown is None:
        return None
    points = number(m.get("tie_points"))
    behind = f" over {count(points, 'tie point')}" if points else ""
    also = f", RMS {fixed(rms, 2)}" if mean is not None and rms is not None else ""
    return Tile(
        label="Reprojection error",
        value=fixed(shown, 2),
        unit="px",
        anchor="residuals",
        verdict=verdict(shown, 1, 2),
        says=f"Mean distance between observed and computed image points{behind}{also}. Good up to"
        " 1 px, fair up to 2.",
    )


def gps(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """Distance between reported and solved positions."""
    x, y, z = axes(m.get("gps_residual_rms_m"))
    if x is None or y is None:
        return None
    flat = float(np.hypot(x, y))
    height = f"; height {fixed(z, 2)} m" if z is not None else ""
    return Tile(
        label="GPS residual",
        value=fixed(flat, 2),
        unit="m",
        anchor="positions",
        verdict=verdict(flat, 3, 10),
        says=f"RMS horizontal distance of the photos from their GPS positions{height}. It describes"
        " the GPS more than the map: up to 3 m is normal, up to 10 m poor but usable.",
    )


def leave_one_out(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """How well each position is predicted from all others."""
    value = m.get("gps_leave_one_out_rms_m")
    x, y, _ = axes(value)
    shown = float(np.hypot(x, y)) if x is not None and y is not None else number(value)
    if shown is None:
        return None
    return Tile(
        label="GPS, leave one out",
        value=fixed(shown, 2),
        unit="m",
        anchor="positions",
        verdict=verdict(shown, 3, 10),
        says="Error of each photo\u2019s GPS position predicted from all other photos. A value near"
        " the GPS residual means that no single photo deforms the map. Good up to 3 m, fair up"
        " to 10.",
    )


def seam(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """Displacement between neighbouring photos at the seams."""
    seams = mapping(m.get("seam_disparity_px"))
    median, p95 = number(seams.get("median")), number(seams.get("p95"))
    if median is None:
        return None
    measured, attempted = number(seams.get("measured")), number(seams.get("attempted"))
    share = measured / attempted if measured is not None and attempted else None
    judged = verdict(median, SEAM_GOOD_PX, SEAM_FAIR_PX)
    also = f" 95\u202f% are below {fixed(p95, 1)} px." if p95 is not None else ""
    says = f"Typical displacement where two photos meet.{also} Good up to 2 px, fair up to 5."
    if share is not None and share < SEAMS_MEASURED:
        judged = "poor" if judged == "poor" else "fair"
        says = (
            f"Only {share:.0%} of the samples could be measured; below {SEAMS_MEASURED:.0%} the "
            "figure is not reliable."
        )
    return Tile(
        label="Seam disparity",
        value=fixed(median, 2),
        unit="px",
        verdict=judged,
        anchor="seams",
        says=says,
    )


def checks(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """Error at points that were not used in the adjustment."""
    rows = [mapping(v) for v in items(m.get("control")) if mapping(v).get("check")]
    off = [(number(r.get("dx_m")), number(r.get("dy_m"))) for r in rows]
    flat = [float(np.hypot(dx, dy)) for dx, dy in off if dx is not None and dy is not None]
    pixel = number(m.get("gsd_m"))
    if not flat or not pixel:
        return None
    rms = float(np.sqrt(np.mean(np.square(flat))))
    return Tile(
        label="Check points",
        value=fixed(rms, 3),
        unit="m",
        anchor="control",
        verdict=verdict(rms, 2 * pixel, 5 * pixel),
        says=f"RMS horizontal error at {count(len(flat), 'surveyed point')} not used in the "
        "adjustment: the most independent "
        f"figure here. Good up to 2 pixels ({fixed(2 * pixel, 3)} m), fair up to 5.",
    )


def time(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """Duration of the run."""
    total = number(mapping(m.get("seconds")).get("total"))
    if total is None:
        return None
    cpu, n = number(m.get("cpu_seconds")), number(m.get("photos_total"))
    each = f"{fixed(total / n, 2)} s per photo" if n else "The whole run"
    also = f", {seconds(cpu)} of processor time" if cpu is not None else ""
    return Tile(label="Time", value=seconds(total), says=f"{each}{also}.", anchor="time")


def memory(m: Mapping[str, Any], data: ReportInput) -> Tile | None:
    """Largest memory use."""
    peak = number(m.get("peak_memory_mb"))
    if peak is None:
        return None
    large = peak >= 1000
    return Tile(
        label="Memory",
        value=fixed(peak / 1000 if large else peak, 2 if large else 0),
        unit="GB" if large else "MB",
        says="Largest memory use during the run.",
    )


def summary(data: ReportInput) -> str:
    """The run in one sentence."""
    m = data.metrics
    used, total = number(m.get("photos_used")), number(m.get("photos_total"))
    words = [
        f"{fixed(used, 0)} of {count(total, 'photo')}"
        if used is not None and total is not None
        else "A run without figures"
    ]
    if n := len(items(m.get("blocks"))):
        words.append(f"in {'one block' if n == 1 else count(n, 'block')}")
    if method := m.get("method"):
        words.append(f"aligned by the method \u2018{method}\u2019")
    pixel = number(m.get("gsd_m"))
    if pixel is not None and data.metric:
        words.append(f"at {significant(pixel * 100)} cm per pixel")
    place = f"georeferenced in {data.crs}" if data.crs else "not georeferenced"
    return " ".join(words) + f", {place}."
