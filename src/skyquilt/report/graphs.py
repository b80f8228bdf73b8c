"""Images, and graphs of several lines, for report pages."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from skyquilt.report.images import jpeg_uri, shrunk
from skyquilt.report.parts import Figure
from skyquilt.report.svg import Axes, drawing, polyline

COLOURS = (
    "#1f6f8b",
    "#d1495b",
    "#edae49",
    "#66a182",
    "#8d5fa8",
    "#2e4057",
    "#b5651d",
    "#5f6c7b",
    "#c2185b",
    "#00897b",
)
"""Colours of the lines in one graph, in order."""


def picture(
    pixels: NDArray[Any], title: str, caption: str, *, longest: int = 1000, wide: bool = False
) -> Figure:
    """An image (H, W, 3 or 4) uint8 as a figure; transparent parts are shown white."""
    small = shrunk(pixels, longest)
    if small.shape[2] == 4:
        alpha = small[..., 3:].astype(np.float32) / 255
        small = (small[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)
    rgba = np.dstack([small, np.full(small.shape[:2], 255, np.uint8)])
    h, w = rgba.shape[:2]
    svg = Markup(
        '<svg viewBox="0 0 {} {}" role="img" aria-label="{}"><image href="{}" width="{}"'
        ' height="{}"/></svg>'
    )
    return Figure(
        svg=svg.format(w, h, title, jpeg_uri(rgba), w, h), title=title, caption=caption, wide=wide
    )


def lines(
    series: Sequence[tuple[str, NDArray[Any]]],
    *,
    title: str,
    x_label: str,
    y_label: str,
    first: float = 1.0,
) -> Markup:
    """Graph of values (n,) against their number, counted from `first`; a line is interrupted at
    NaN.
    """
    values = np.concatenate([v[np.isfinite(v)] for _, v in series] or [np.zeros(1)])
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    pad = 0.06 * (high - low) or 0.5
    longest = max((len(v) for _, v in series), default=2)
    axes = Axes(
        x=(first, first + max(longest - 1, 1)), y=(low - pad, high + pad), width=900, height=360
    )
    parts = [axes.grid(x_label, y_label)]
    for k, (_, value) in enumerate(series):
        colour = COLOURS[k % len(COLOURS)]
        points = axes.points(np.column_stack([first + np.arange(len(value)), value]))
        whole = np.isfinite(value)
        runs = np.split(np.arange(len(value)), np.flatnonzero(np.diff(whole.astype(int)) != 0) + 1)
        d = "".join(polyline(points[r]) for r in runs if whole[r[0]])
        if d:
            parts.append(
                Markup('<path d="{}" style="fill:none;stroke:{};stroke-width:2"/>').format(
                    d, colour
                )
            )
    return drawing(parts, title, width=900, height=360)
