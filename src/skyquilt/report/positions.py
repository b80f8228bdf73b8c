"""Section: reported and solved positions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from skyquilt.report.ground import Ground, picture, use
from skyquilt.report.input import ReportInput, Shot
from skyquilt.report.layers import MANY, Layer, exaggeration, placed, reported
from skyquilt.report.numbers import count, fixed
from skyquilt.report.parts import Figure, Missing, Section, Table
from skyquilt.report.svg import HEIGHT, WIDTH, Axes, coordinate, dots, drawing, path, polyline

WORST = 10
SERIES = (("east", "x0"), ("north", "x1"), ("up", "x2"))


def positions_section(
    data: ReportInput, ground: Ground | None, layers: dict[str, Layer]
) -> Section:
    """GPS residuals on the map, in order of capture and as a table."""
    shots = data.shots
    off = placed(shots) - reported(shots)
    known = np.isfinite(off[:, 0]) & np.isfinite(off[:, 1])
    if not known.any() or ground is None:
        why = "No photo reports a position, so there is nothing to compare the solution with."
        return Section(id="positions", title="GPS and solution", blocks=(Missing(why=why),))
    blocks = [_arrows(ground, layers, shots, off)] if "gps" in layers else []
    blocks.append(_series(off, ground.unit))
    return Section(
        id="positions",
        title="GPS and solution",
        lead="Residuals of the finished map: solved minus reported position. Short arrows in random"
        " directions are noise of the receiver; neighbouring arrows in the same direction show a"
        " drift or a shift.",
        blocks=(*blocks, _worst(shots, off, known)),
    )


def _arrows(
    ground: Ground, layers: dict[str, Layer], shots: Sequence[Shot], off: NDArray[Any]
) -> Figure:
    factor, length = exaggeration(shots, ground), np.linalg.norm(off[:, :2], axis=1)
    far = int((length >= ground.diagonal).sum())
    title = "From the reported to the solved position"
    caption = (
        f"Arrows start at the reported position of the photo and are drawn {factor:g} times as"
        " long as the residual."
    )
    if factor == 1:
        caption = (
            "Arrows point from the reported to the solved position of the photo, at true length."
        )
    if far:
        caption += (
            f" {count(far, 'photo')} with a residual larger than the map: not drawn, see the table."
        )
    under = [use("mosaic", "faded")] if "mosaic" in layers else []
    svg = picture(ground, [*under, *(use("gps", c) for c in layers["gps"].styles)], title)
    return Figure(svg=svg, title=title, caption=caption)


def _series(off: NDArray[Any], unit: str) -> Figure:
    """East, north and up in order of capture, as three graphs."""
    title = "Residuals in order of capture"
    stride = -(-len(off) // 1500)
    strip = (HEIGHT + 50) / 3
    parts = []
    for k, (name, cls) in enumerate(SERIES):
        value = off[::stride, k]
        index = np.flatnonzero(np.isfinite(value))
        if not len(index):
            continue
        reach = float(np.abs(value[index]).max()) * 1.15 or 1.0
        axes = Axes(
            x=(1 - 0.02 * len(off), 1.02 * len(off) + 0.5),
            y=(-reach, reach),
            height=strip if k < 2 else strip + 32,
            bottom=14 if k < 2 else 46,
        )
        xy = axes.points(np.stack([index * stride + 1.0, value[index]], 1))
        runs = np.split(xy, np.flatnonzero(np.diff(index) > 1) + 1)
        lines = path("".join(polyline(r) for r in runs), f"series {cls}") + (
            path(dots(xy), f"points {cls}") if len(off) <= MANY else ""
        )
        grid = axes.grid("photo" if k == 2 else "", f"{name}, {unit}", x_ticks=k == 2, y_parts=5)
        parts.append(
            Markup('<g transform="translate(0 {})">{}</g>').format(
                coordinate(k * strip), grid + lines
            )
        )
    svg = drawing(parts, title, WIDTH, strip * 3 + 32)
    caption = (
        "A step or a trend over many photos is an error of the receiver or the barometer, not"
        " noise."
    )
    return Figure(svg=svg, title=title, caption=caption)


def _worst(shots: Sequence[Shot], off: NDArray[Any], known: NDArray[Any]) -> Table:
    flat = np.where(known, np.linalg.norm(off[:, :2], axis=1), -1.0)
    rows = tuple(
        (shots[k].name, *(fixed(v, 2, sign=True) for v in off[k]), fixed(flat[k], 2))
        for k in np.argsort(-flat, kind="stable")[: min(WORST, int(known.sum()))].tolist()
    )
    silent = int((~known).sum())
    return Table(
        title="Furthest from their reported position",
        head=("Photo", "East, m", "North, m", "Up, m", "Horizontal, m"),
        rows=rows,
        numeric="cnnnn",
        note=f"{count(silent, 'photo')} without a reported position." if silent else "",
    )
