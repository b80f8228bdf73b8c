"""Section: displacement between neighbouring photos along the seams of the mosaic."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.report.ground import Ground, picture, use
from skyquilt.report.headline import SEAMS_MEASURED
from skyquilt.report.input import ReportInput
from skyquilt.report.layers import Layer, disparities
from skyquilt.report.numbers import count, fixed, nice
from skyquilt.report.parts import Block, Figure, Missing, Section
from skyquilt.report.svg import bars


def seams_section(data: ReportInput, ground: Ground | None, layers: dict[str, Layer]) -> Section:
    """Samples on the map and the histogram of their disparities."""
    if not data.seams or ground is None:
        why = "There are no seams between photos, or they were not measured in this run."
        return Section(id="seams", title="Seams", blocks=(Missing(why=why),))
    value = disparities(data.seams)
    measured = value[np.isfinite(value)]
    blocks: list[Block] = [_picture(ground, layers, len(value), len(measured))]
    blocks.append(
        _histogram(measured) if len(measured) else Missing(why="No sample could be measured.")
    )
    return Section(
        id="seams",
        title="Seams",
        lead="Where the mosaic changes from one photo to the next, both photos are compared: the "
        "displacement between them is visible as a step in roads and roofs.",
        blocks=tuple(blocks),
    )


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
