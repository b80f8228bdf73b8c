"""The page of a lens calibration: tables and plots in the form of Yahyanejad 2013, Tables 6.2, 6.3,
Fig. 6.8, 6.9.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from skyquilt.model.board import Board
from skyquilt.model.calibration import Calibration
from skyquilt.report.images import jpeg_uri
from skyquilt.report.numbers import fixed, significant
from skyquilt.report.page import plain_page
from skyquilt.report.parts import Figure, Section, Sentences, Table, Tile
from skyquilt.report.svg import Axes, arrows, coordinate, dots, drawing, path

_SIDE = 340.0
_STYLE = (
    ".grid{stroke:#ddd}.axis{stroke:#999}.tick,.name{font:12px"
    " sans-serif;fill:#444}.mid{text-anchor:middle}"
    ".end{text-anchor:end}"
    ".cloud{stroke:#1f6f8b;stroke-width:3;stroke-linecap:round;fill:none;opacity:.55}"
    ".vectors{stroke:#1f6f8b;stroke-width:1.2;fill:none}"
    ".marker{fill:none;stroke:#b8602a;stroke-width:1.5}"
)
_WORDS = {"centres": "centres of squares", "corners": "corners"}


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationInput:
    """Data of the page."""

    figures: Mapping[str, Any]
    """The record of calibration.json."""
    board: Board
    """The board."""
    centres: Calibration
    """The result."""
    corners: Calibration
    """For comparison, on the same views."""
    boards: NDArray[np.uint8]
    """(H, W, 3) RGB, all views with the detected squares."""
    title: str
    """Heading."""
    version: str
    """Of the program."""


def calibration_page(data: CalibrationInput) -> str:
    """The page as one self-contained file."""
    return plain_page(
        title=f"Lens calibration from {data.title}",
        summary=_summary(data),
        version=data.version,
        source="The figures behind this page are in calibration.json, the camera is in"
        " cameras.json.",
        tiles=_tiles(data),
        sections=(
            Section(
                id="intrinsics",
                title="Intrinsic parameters",
                lead=_LEAD,
                blocks=_parameter_tables(data),
            ),
            Section(id="errors", title="Reprojection errors", blocks=tuple(_figures(data))),
            *_judged_or_open(data),
            Section(id="boards", title="Boards as found", blocks=(_boards(data),)),
            Section(id="views", title="Views", blocks=_views(data)),
        ),
    )


def _judged_or_open(data: CalibrationInput) -> tuple[Section, ...]:
    """The effect of undistortion; or, with too few views to show it, what they leave open."""
    if data.figures["registration"] is None:
        told = Sentences(items=tuple(data.figures["unknown"]))
        return (Section(id="unknown", title="What so few views leave open", blocks=(told,)),)
    title = "Effect of undistortion on registration"
    return (Section(id="registration", title=title, blocks=(_registration(data),)),)


_LEAD = (
    "One camera, two calibrations on the same views: from the centres of the squares, corrected for"
    " perspective and"
    " distortion, and from the corners between them. Deviations are one sigma. A coefficient"
    " smaller than three of"
    " them was dropped and the rest fitted again."
)


def plots(data: CalibrationInput) -> Iterator[str]:
    """Drawings as separate files: errors over the pattern and error charts, centres first."""
    for draw in (_pattern, _chart):
        for found in (data.centres, data.corners):
            svg = str(draw(data, found).svg)
            yield svg.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1).replace(
                ">", f"><style>{_STYLE}</style>", 1
            )


def _summary(data: CalibrationInput) -> str:
    m = data.figures
    size = f"{data.centres.camera.width} x {data.centres.camera.height} px"
    return (
        f"{m['camera']} ({size}): {m['views_used']} views of a board of {data.board.columns} x"
        f" {data.board.rows}"
        f" squares in {m['frames']} frames."
    )


def _tiles(data: CalibrationInput) -> tuple[Tile, ...]:
    found = data.centres
    share = 100 * found.sigma("focal") / found.camera.focal
    return (
        Tile(
            label="Focal length",
            unit="px",
            value=f"{fixed(found.camera.focal, 1)} \u00b1 {fixed(found.sigma('focal'), 1)}",
            verdict="good" if share < 1 else "fair" if share < 2 else "poor",
            says=f"Deviation {fixed(share, 2)} %; below 1 % is good, above 2 % more tilted views"
            " are needed.",
        ),
        Tile(
            label="Reprojection error",
            value=fixed(found.rms_px, 3),
            unit="px",
            says="RMS over all centres.",
        ),
        *_held_out_tiles(data),
    )


def _held_out_tiles(data: CalibrationInput) -> tuple[Tile, ...]:
    """Errors on what the camera was not made from; none with too few views."""
    m, found = data.figures, data.centres
    if m["registration"] is None:
        return ()
    held, gain = m["centres"]["held_out_px"]["centres"], m["registration"]["reduction_percent"]
    return (
        Tile(
            label="On views kept out",
            value=fixed(held, 3),
            unit="px",
            verdict="good"
            if held < 1.2 * found.rms_px
            else "fair"
            if held < 1.5 * found.rms_px
            else "poor",
            says="RMS of views not used for the camera; if much larger than the former, too many"
            " parameters.",
        ),
        Tile(
            label="Registration",
            value=fixed(-gain, 0),
            unit="%",
            verdict="good" if gain > 0 else "poor",
            says="Change of the mean squared error when undistorted views are registered instead of"
            " raw ones.",
        ),
    )


def _parameter_tables(data: CalibrationInput) -> tuple[Table, ...]:
    return tuple(_parameters(data, found) for found in (data.centres, data.corners))


def _parameters(data: CalibrationInput, found: Calibration) -> Table:
    camera, record = found.camera, data.figures[found.marks]
    held = record["held_out_px"]
    x, y = found.mean_error_px

    def row(name: str, keys: tuple[str, ...], decimals: int | None) -> tuple[str, str, str]:
        def shown(values: list[float]) -> str:
            words = [significant(v, 4) if decimals is None else fixed(v, decimals) for v in values]
            return words[0] if len(words) == 1 else f"({', '.join(words)})"

        return (
            name,
            shown([getattr(camera, k) for k in keys]),
            "\u00b1 " + shown([found.sigma(k) for k in keys]),
        )

    return Table(
        title=f"Calibration from {_WORDS[found.marks]}",
        head=("", "Value", "Deviation"),
        numeric="tnn",
        rows=(
            ("Pixel error (mean absolute, x, y), px", f"({fixed(x, 4)}, {fixed(y, 4)})", ""),
            ("Reprojection error (RMS), px", fixed(found.rms_px, 4), ""),
            *(
                (f"RMS of views kept out, judged by {_WORDS[by]}, px", fixed(held[by], 4), "")
                for by in ("centres", "corners")
                if held is not None
            ),
            row("Focal length, px", ("focal",), 2),
            row("Principal point, px", ("cx", "cy"), 2),
            row("Radial coefficients (k1, k2, k3)", ("k1", "k2", "k3"), None),
            row("Tangential coefficients (p1, p2)", ("p1", "p2"), None),
        ),
        note=_dropped(found),
        wide=False,
    )


def _dropped(found: Calibration) -> str:
    if not found.dropped:
        if "k3" not in found.free:
            return "Few views: k3, p1 and p2 were not estimated, the others with priors."
        return "No coefficient was smaller than its tolerance."
    parts = [
        f"{n} ({significant(v, 3)}, tolerance {significant(t, 3)})" for n, v, t in found.dropped
    ]
    return f"Dropped as smaller than its tolerance: {', '.join(parts)}."


def _figures(data: CalibrationInput) -> Iterator[Figure]:
    for draw in (_pattern, _chart):
        for found in (data.centres, data.corners):
            yield draw(data, found)


def _pattern(data: CalibrationInput, found: Calibration) -> Figure:
    """Fig. 6.8: the mean error at every point of the pattern, over all views."""
    board = data.board
    square = board.square_m
    where = np.concatenate([s.board[:, :2] for s in found.observations]) / square
    error = np.concatenate(found.residuals)
    nodes, index = np.unique(np.round(where, 3), axis=0, return_inverse=True)
    count = np.bincount(index.ravel())
    mean = np.stack([np.bincount(index.ravel(), error[:, k]) / count for k in (0, 1)], 1)
    longest = max(float(np.linalg.norm(mean, axis=1).max(initial=0)), 1e-6)
    scale = 0.45 / longest
    axes = Axes(
        x=(0.0, float(board.columns)),
        y=(float(board.rows), 0.0),
        width=_SIDE * 1.4,
        height=_SIDE * 1.4 * board.rows / board.columns + 40,
    )
    tails, tips = axes.points(nodes), axes.points(nodes + scale * mean)
    title = f"Mean error over the pattern, from {_WORDS[found.marks]}"
    errors = path(arrows(tails, tips, longest=7.0), "vectors")
    svg = drawing(
        [axes.grid("squares", "squares"), path(dots(tails), "cloud"), errors],
        title,
        axes.width,
        axes.height,
    )
    return Figure(
        svg=svg,
        title=title,
        caption="Measured minus predicted, mean over all views; the longest arrow is"
        f" {fixed(longest, 3)} px. What"
        " repeats in all views is the board, not the lens.",
    )


def _chart(data: CalibrationInput, found: Calibration) -> Figure:
    """Fig. 6.9: every error as a point; both calibrations at one scale."""
    both = np.concatenate([*data.centres.residuals, *data.corners.residuals])
    reach = float(np.ceil(np.percentile(np.abs(both), 99.5) * 2) / 2) or 0.5
    error = np.concatenate(found.residuals)
    axes = Axes(x=(-reach, reach), y=(reach, -reach), width=_SIDE + 78, height=_SIDE + 58)
    inside = (np.abs(error) < reach).all(1)
    spread = found.rms_px / reach * _SIDE / 2
    circle = Markup('<ellipse class="marker" cx="{}" cy="{}" rx="{}" ry="{}"/>').format(
        *(coordinate(float(v)) for v in (axes.px(0), axes.py(0), spread, spread))
    )
    title = f"Errors, from {_WORDS[found.marks]}"
    cloud = path(dots(axes.points(error[inside])), "cloud")
    svg = drawing([axes.grid("x, px", "y, px"), cloud, circle], title, axes.width, axes.height)
    outside = int((~inside).sum())
    caption = f"{len(error)} points, the circle is the RMS of {fixed(found.rms_px, 3)} px."
    return Figure(
        svg=svg,
        title=title,
        caption=caption + (f" {outside} further out not drawn." if outside else ""),
    )


def _registration(data: CalibrationInput) -> Sentences:
    r = data.figures["registration"]
    how = (
        "which were not used for the camera"
        if r["pairs_unseen_by_the_camera"]
        else "with the camera from all views"
    )
    return Sentences(
        items=(
            f"{r['pairs']} pairs of views were registered by a homography through the board's"
            f" corners, {how}: a board"
            " is flat, so the remaining errors are distortion and noise.",
            f"Mean squared error (6.2): {fixed(r['mse_raw_px2'], 3)} px\u00b2 raw,"
            f" {fixed(r['mse_undistorted_px2'], 3)}"
            f" px\u00b2 undistorted ({fixed(-r['reduction_percent'], 1, sign=True)} %).",
        )
    )


def _boards(data: CalibrationInput) -> Figure:
    opaque = np.dstack([data.boards, np.full(data.boards.shape[:2], 255, np.uint8)])
    image = Markup('<img src="{}" alt="{}">').format(Markup(jpeg_uri(opaque)), "Boards as found")
    caption = "Centroids of white squares red, of black squares green; the first square is ringed."
    return Figure(svg=image, title="Boards as found", caption=caption, wide=True)


def _views(data: CalibrationInput) -> tuple[Table, ...]:
    m = data.figures
    rows = tuple(
        (
            v["name"],
            fixed(v["frames"], 0),
            fixed(v["squares"], 0),
            fixed(v["rms_px"], 3),
            fixed(v["tilt_deg"], 1),
            fixed(v["distance_m"], 2),
        )
        for v in m["views"]
    )
    head = ("View", "Frames", "Centres", "RMS, px", "Tilt, \u00b0", "Distance, m")
    used = Table(title="Used", head=head, rows=rows, numeric="cnnnnn")
    out = tuple((name, reason) for name, reason in m["views_rejected"].items())
    if not out:
        return (used,)
    return used, Table(title="Left out", head=("View", "Reason"), rows=out, numeric="ct")
