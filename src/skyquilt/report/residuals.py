"""Section: residuals of the tie points."""

from dataclasses import replace
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from skyquilt.report import images
from skyquilt.report.input import CameraResiduals, ReportInput
from skyquilt.report.numbers import count, decimals_of, fixed, nice
from skyquilt.report.parts import Block, Figure, Missing, Section
from skyquilt.report.svg import (
    BOTTOM,
    LEFT,
    RIGHT,
    TOP,
    WIDTH,
    Axes,
    arrows,
    bars,
    coordinate,
    dots,
    drawing,
    path,
    rect,
    text,
)

COLUMNS, ROWS = 8, 6
FEWEST = 10
"""Smallest number of observations in a cell of the image for a mean."""
MOST_CAMERAS = 6
CELLS = 61
"""Cells per side of the density image."""


def residuals_section(data: ReportInput) -> Section:
    """Density of the residuals, mean residuals over the image per camera, histogram."""
    cameras = [_finite(r) for r in data.residuals]
    cameras = sorted((r for r in cameras if len(r.px)), key=lambda r: -len(r.px))
    if not cameras:
        why = "This method uses no tie points, so there are no residuals to show."
        return Section(id="residuals", title="Reprojection residuals", blocks=(Missing(why=why),))
    every = np.concatenate([r.residual_px for r in cameras])
    apart = max(r.every for r in cameras)
    blocks: list[Block] = [
        _density(every),
        _lengths(every),
        *(_field(r) for r in cameras[:MOST_CAMERAS]),
    ]
    if (more := len(cameras) - MOST_CAMERAS) > 0:
        blocks.append(Missing(why=f"{count(more, 'camera')} with fewer observations not drawn."))
    return Section(
        id="residuals",
        title="Reprojection residuals",
        lead="Computed minus observed image position of every tie point in every photo of it."
        + (f" One of {apart} observations is taken." if apart > 1 else ""),
        blocks=tuple(blocks),
    )


def _finite(r: CameraResiduals) -> CameraResiduals:
    px, residual = np.reshape(r.px, (-1, 2)), np.reshape(r.residual_px, (-1, 2))
    keep = np.isfinite(px).all(1) & np.isfinite(residual).all(1)
    return replace(r, px=px[keep], residual_px=residual[keep])


def _density(residual: NDArray[Any]) -> Figure:
    """Density of the end points of residual vectors, darker where there are more."""
    title = "Residual vectors"
    rms = float(np.sqrt((residual**2).sum(1).mean()))
    reach = max(nice(3 * float(np.percentile(np.abs(residual), 95)) / 2, 1), 1e-3)
    size = 320.0
    axes = Axes(
        x=(-reach, reach), y=(reach, -reach), width=size + LEFT + RIGHT, height=size + TOP + BOTTOM
    )
    inside = (np.abs(residual) < reach).all(1)
    body = (
        _points(residual[inside], axes)
        if inside.sum() <= 1500
        else _cells(residual[inside], reach, axes, size)
    )
    circle = Markup('<ellipse class="marker" cx="{}" cy="{}" rx="{}" ry="{}"/>').format(
        *(
            coordinate(float(v))
            for v in (axes.px(0), axes.py(0), rms / reach * size / 2, rms / reach * size / 2)
        )
    )
    words = text(float(axes.px(0)), float(axes.py(-rms)) - 5, f"RMS {fixed(rms, 2)} px", "mark mid")
    svg = drawing(
        [axes.grid("to the right, px", "downwards, px"), body, circle, words],
        title,
        WIDTH,
        axes.height,
        (WIDTH - axes.width) / 2,
    )
    beyond = int((~inside).sum())
    outside = f" {count(beyond, 'observation')} outside the graph not drawn." if beyond else ""
    caption = (
        f"{count(len(residual), 'observation')}. A round, centred cloud is noise; a shifted or "
        f"elongated one is a systematic error.{outside}"
    )
    return Figure(svg=svg, title=title, caption=caption)


def _points(residual: NDArray[Any], axes: Axes) -> Markup:
    return path(dots(axes.points(residual)), "cloud")


def _cells(residual: NDArray[Any], reach: float, axes: Axes, size: float) -> Markup:
    index = np.clip(((residual + reach) / (2 * reach) * CELLS).astype(np.int64), 0, CELLS - 1)
    counts = np.bincount(index[:, 1] * CELLS + index[:, 0], minlength=CELLS * CELLS).reshape(
        CELLS, CELLS
    )
    index = (255 * np.log1p(counts) / np.log1p(counts.max())).astype(np.uint8)
    colours = np.array([(*images.ACCENT, alpha) for alpha in range(256)], np.uint8)
    return Markup('<image class="cells" x="{}" y="{}" width="{}" height="{}" href="{}"/>').format(
        coordinate(axes.left),
        TOP,
        coordinate(size),
        coordinate(size),
        Markup(images.png_uri(index, colours)),
    )


def _lengths(residual: NDArray[Any]) -> Figure:
    title = "Lengths of the residuals"
    length = np.linalg.norm(residual, axis=1)
    top = max(float(np.percentile(length, 99)), 1e-6)
    step = nice(top, 24)
    edges = np.arange(0, int(np.ceil(top / step)) + 1) * step
    counts = np.histogram(length, edges)[0]
    median, p95 = (float(v) for v in np.percentile(length, [50, 95]))
    svg = bars(
        edges,
        counts,
        title=title,
        x_label="length, px",
        y_label="observations",
        marks=((median, f"median {fixed(median, 2)}"), (p95, f"95\u202f% below {fixed(p95, 2)}")),
    )
    beyond = int((length > edges[-1]).sum())
    caption = "Many short residuals and few long ones are good; a second peak means wrong matches."
    return Figure(
        svg=svg,
        title=title,
        caption=caption + (f" {count(beyond, 'observation')} beyond." if beyond else ""),
    )


def _field(r: CameraResiduals) -> Figure:
    """Mean residual in each cell of the image."""
    title = f"Mean residual over the image: {r.camera}"
    at, mean, n = mean_field(r)
    body, width = WIDTH - 2.0, r.width
    scale = body / width
    height = r.height * scale
    frame = [rect(1, 1, body, height, "frame")]
    frame += [
        path(f"M{1 + k * body / COLUMNS:.1f} 1v{height:.1f}", "grid") for k in range(1, COLUMNS)
    ]
    frame += [path(f"M1 {1 + k * height / ROWS:.1f}h{body:.1f}", "grid") for k in range(1, ROWS)]
    if not len(at):
        why = f"No part of the image has {FEWEST} observations; too few for a mean."
        return Figure(svg=drawing(frame, title, WIDTH, height + 2), title=title, caption=why)
    length = np.linalg.norm(mean, axis=1)
    longest = float(length.max())
    step = nice(max(longest, 1e-6) / 2, 1)
    px_per_px = 0.9 * min(body / COLUMNS, height / ROWS) / max(longest, 1e-6)
    middle = at * scale + 1
    shape = arrows(middle - mean * px_per_px / 2, middle + mean * px_per_px / 2, longest=12)
    key = _key(step, step * px_per_px, height)
    svg = drawing([*frame, path(shape, "vectors"), key], title, WIDTH, height + 36)
    left = systematic(r, mean, n)
    judged = "good" if left <= 0.15 else "fair" if left <= 0.5 else "poor"
    caption = (
        f"{count(int(n.sum()), 'observation')} in cells of {FEWEST} or more. Without the random"
        f" part, {fixed(left, 2)} px RMS are systematic: {judged} (good up to 0.15 px, fair up to"
        " 0.5). Arrows that all point inwards or outwards mean a wrong radial distortion."
    )
    return Figure(svg=svg, title=title, caption=caption)


def _key(step: float, length: float, height: float) -> Markup:
    y = height + 22
    arrow = arrows(np.array([[2.0, y]]), np.array([[2.0 + length, y]]), longest=12)
    return path(arrow, "vectors") + text(
        length + 12, y + 4, f"{fixed(step, decimals_of(step))} px", "tick"
    )


def systematic(r: CameraResiduals, mean: NDArray[Any], n: NDArray[Any]) -> float:
    """RMS in px of the cells' means (k, 2), minus what random residuals of this spread
    contribute.
    """
    chance = (r.residual_px**2).sum(1).mean() / n
    return float(np.sqrt(max(0.0, np.average((mean**2).sum(1) - chance, weights=n))))


def mean_field(r: CameraResiduals) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Centres (k, 2) in px, mean residuals (k, 2) in px and counts (k,) of cells with enough
    observations.
    """
    column = np.clip((r.px[:, 0] + 0.5) / r.width * COLUMNS, 0, COLUMNS - 1).astype(np.int64)
    row = np.clip((r.px[:, 1] + 0.5) / r.height * ROWS, 0, ROWS - 1).astype(np.int64)
    cell, size = row * COLUMNS + column, COLUMNS * ROWS
    n = np.bincount(cell, minlength=size)
    total = np.stack([np.bincount(cell, r.residual_px[:, k], minlength=size) for k in (0, 1)], 1)
    enough = np.flatnonzero(n >= FEWEST)
    centre = np.stack(
        [(enough % COLUMNS + 0.5) * r.width / COLUMNS, (enough // COLUMNS + 0.5) * r.height / ROWS],
        1,
    )
    return centre, total[enough] / n[enough, None], n[enough]
