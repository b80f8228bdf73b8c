"""The head of the page: when, how high and with what the photos were taken, and the files."""

from collections.abc import Iterator

import numpy as np

from skyquilt.report.input import ReportInput
from skyquilt.report.numbers import DASH, fixed, mapping, number, plain, significant
from skyquilt.report.parts import Section, Table

MOST_PHOTOS = 3000
"""Rows of the table of photos; the others are in shots.geojson."""


def facts_of(data: ReportInput) -> tuple[tuple[str, str], ...]:
    """Pairs of a name and a value: captured, processed, flying height, cameras."""
    return tuple(_facts(data))


def _facts(data: ReportInput) -> Iterator[tuple[str, str]]:
    # frames of a clip that does not tell when it was filmed count from the epoch
    times = sorted(s.time for s in data.shots if s.time and not s.time.startswith("1970-"))
    if times:
        first, last = times[0], times[-1]
        day, until = first[:10], last[11:16] if last[:10] == first[:10] else last[:16]
        yield "Captured", f"{day} {first[11:16]} to {until.replace('T', ' ')}"
    if data.processed:
        yield "Processed", data.processed.replace("T", " ")[:16]
    heights = np.array([s.above_ground_m for s in data.shots if s.above_ground_m is not None])
    if len(heights) and data.metric:
        low, high = np.percentile(heights, [5, 95])
        span = f" ({fixed(low, 0)} to {fixed(high, 0)})" if high - low > 2 else ""
        yield "Flying height", f"{fixed(float(np.median(heights)), 0)} m above ground{span}"
    if cameras := mapping(data.metrics.get("cameras")):
        names = [plain(k) for k in cameras if not str(k).endswith("/turned")]
        yield "Camera", ", ".join(names[:4]) + (f" and {len(names) - 4} more" if names[4:] else "")


def photos_section(data: ReportInput) -> tuple[Section, ...]:
    """A row for every placed photo."""
    if not data.shots:
        return ()
    head = (
        "Photo", "Time", "Height, m", "Yaw", "Tilt", "From GPS, m", "Tie points", "Error, px",
        "Block",
    )  # fmt: skip
    rows = []
    for shot in data.shots[:MOST_PHOTOS]:
        off = float(np.linalg.norm(np.subtract(shot.xyz, shot.reported_xyz)[:2]))
        rows.append(
            (
                shot.name,
                shot.time[11:19] if shot.time else DASH,
                fixed(shot.above_ground_m, 1),
                f"{fixed(shot.yaw_deg, 1)}\u00b0" if number(shot.yaw_deg) is not None else DASH,
                f"{fixed(shot.tilt_deg, 1)}\u00b0" if number(shot.tilt_deg) is not None else DASH,
                fixed(off, 2),
                fixed(shot.tie_points, 0),
                significant(shot.error_px, 2),
                str(shot.block + 1),
            )
        )
    more = len(data.shots) - MOST_PHOTOS
    note = "Heights above ground; tilt is the angle from the vertical."
    if more > 0:
        note += f" {more} more in shots.geojson."
    table = Table(
        title=f"{len(data.shots)} photos", head=head, rows=tuple(rows), numeric="ctnnnnnnn",
        note=note,
    )  # fmt: skip
    return (Section(id="photos", title="All photos", blocks=(table,), folded=True),)
