"""Section: displacement between neighbouring photos along the seams of the mosaic."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.report.graphs import picture as image
from skyquilt.report.ground import Ground, picture, use
from skyquilt.report.headline import SEAMS_MEASURED
from skyquilt.report.input import ReportInput
from skyquilt.report.layers import Layer, disparities
from skyquilt.report.numbers import DASH, count, fixed, mapping, nice, number
from skyquilt.report.parts import Block, Figure, Missing, Section, Table
from skyquilt.report.svg import bars


def seams_section(data: ReportInput, ground: Ground | None, layers: dict[str, Layer]) -> Section:
    """Samples on the map and the histogram of their disparities."""
    if not data.seams or ground is None:
        if looks := _looks(data):
            return Section(id="seams", title="Seams", blocks=looks)
        why = "There are no seams between photos, or they were not measured in this run."
        return Section(id="seams", title="Seams", blocks=(Missing(why=why),))
    value = disparities(data.seams)
    measured = value[np.isfinite(value)]
    blocks: list[Block] = [_picture(ground, layers, len(value), len(measured))]
    blocks.append(
        _histogram(measured) if len(measured) else Missing(why="No sample could be measured.")
    )
    blocks += _looks(data)
    return Section(
        id="seams",
        title="Seams",
        lead="Where the mosaic changes from one photo to the next, both photos are compared: the "
        "displacement between them is visible as a step in roads and roofs.",
        blocks=tuple(blocks),
    )


def _looks(data: ReportInput) -> tuple[Block, ...]:
    """Colours and objects at the seams, how evenly photos show the same ground, and the worst
    places.
    """
    m = data.metrics
    colour, tone = mapping(m.get("seam_colour_step")), mapping(m.get("tone_residual"))
    share, hidden = number(m.get("seam_cut_objects")), number(m.get("hidden_m2"))
    rows = []
    if colour:
        at, beside = (
            " / ".join(_plain(colour.get(prefix + k)) for k in ("median", "p95"))
            for prefix in ("", "beside_")
        )
        rows += [
            ("colour step at seams", at, "CIE L*a*b* difference of both photos: median / 95 %"),
            ("the same beside them", beside, "30 px from the seam"),
        ]
    if share is not None:
        rows.append(("seams over objects", f"{share:.1%}", "share of their length, over 1 m high"))
    if hidden is not None:
        rows.append(("seen by no photo", f"{hidden:.1f} m\u00b2", "filled with the best guess"))
    if tone:
        told = " / ".join(_plain(tone.get(k)) for k in ("median", "p95"))
        rows.append(("tone residual", told, "spread of photos over shared ground: median / 95 %"))
    blocks: list[Block] = []
    if rows:
        head = ("", "value", "meaning")
        blocks.append(Table(title="Looks", head=head, rows=tuple(rows), numeric="tnt"))
    blocks += [
        image(crop, f"Largest colour step {k}", "The map at full resolution.")
        for k, crop in enumerate(data.worst_seams, 1)
    ]
    return tuple(blocks)


def _plain(value: Any) -> str:
    found = number(value)
    return DASH if found is None else fixed(found, 2)


def _picture(ground: Ground, layers: dict[str, Layer], attempted: int, measured: int) -> Figure:
    title = "Displacement along the seams"
    under = [use("mosaic", "faded")] if "mosaic" in layers else []
    svg = picture(
        ground, [*under, *(use("seams", f"small {c}") for c in ("dot-casing", "dots"))], title
    )
    share = measured / attempted
    stands = (
        "enough for reliable figures" if share >= SEAMS_MEASURED else "too few for reliable figures"
    )
    caption = (
        f"{fixed(measured, 0)} of {count(attempted, 'sample')} measured ({share:.0%}): {stands} "
        f"({SEAMS_MEASURED:.0%} needed)."
    )
    return Figure(svg=svg, title=title, caption=caption, legend=layers["seams"].legend)


def _histogram(measured: NDArray[Any]) -> Figure:
    title = "Displacements"
    top = max(float(np.percentile(measured, 98)), 1e-3)
    step = nice(top, 24)
    edges = np.arange(0, int(np.ceil(top / step)) + 1) * step
    median, p95 = (float(v) for v in np.percentile(measured, [50, 95]))
    svg = bars(
        edges,
        np.histogram(measured, edges)[0],
        title=title,
        x_label="displacement, map px",
        y_label="samples",
        marks=((median, f"median {fixed(median, 2)}"), (p95, f"95\u202f% below {fixed(p95, 2)}")),
    )
    beyond = int((measured > edges[-1]).sum())
    caption = "In map px. Up to 2 px is not visible in print; more than 5 px interrupts lines."
    return Figure(
        svg=svg,
        title=title,
        caption=caption + (f" {count(beyond, 'sample')} beyond." if beyond else ""),
    )
