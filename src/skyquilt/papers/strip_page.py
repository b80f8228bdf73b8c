"""The report page of a strip test: eta along the strip, with a curve per variant (Y Fig. 6.5)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from skyquilt.report.page import plain_page
from skyquilt.report.parts import Figure, LegendItem, Section, Sentences, Table, Tile
from skyquilt.report.svg import Axes, drawing, polyline

COLOURS = (
    "#8a8f94",
    "#b3261e",
    "#b8602a",
    "#b08a00",
    "#1f6f8b",
    "#6b5ca5",
    "#2c7a4b",
    "#5a5a5a",
    "#7fa650",
)
"""Colour of each variant."""
DASHES = ("2 3", "6 3", "6 3", "6 3", "", "8 3 2 3", "", "1 3", "1 3")
"""Dash pattern of each variant, for readers who cannot distinguish colours."""
GOOD = 0.97
"""Least eta at the end of a strip without visible deformation."""


def strip_page(found: Mapping[str, Any]) -> str:
    """The page of a strip.json as one self-contained file."""
    variants: Sequence[Mapping[str, Any]] = found["variants"]
    best, worst = variants[6], variants[0]
    ends = [float(np.median(v["eta_end"])) for v in variants]
    tiles = [
        Tile(
            label="Similarity, order 6 + tangential",
            value=f"{ends[6]:.3f}",
            unit="eta",
            verdict="good" if ends[6] >= GOOD else "poor",
            says=f"At the end of the strip, median; {GOOD} and more keeps squares square.",
        ),
        Tile(
            label="Homography, same lens model",
            value=f"{ends[4]:.3f}",
            unit="eta",
            says="At the end of the strip, levelled features.",
        ),
        Tile(
            label="Homography, order 2",
            value=f"{ends[1]:.3f}",
            unit="eta",
            says="At the end of the strip: the effect of too simple a lens model.",
        ),
        Tile(
            label="Homography, no correction",
            value=f"{ends[0]:.3f}",
            unit="eta",
            says="At the end of the strip: every photo adds to the bending of the mosaic.",
        ),
    ]
    photos = len(best["eta"])
    summary = (
        f"How well a chess-board keeps its shape along {photos} photos that are mosaicked from one"
        " to the next:"
        f" eta falls from 1 to {ends[0]:.2f} for {worst['name']}, to {ends[6]:.2f} for"
        f" {best['name']}."
    )
    sections = (_curves(variants, found["flights"]), _table(variants), _how(found))
    return plain_page(
        title="Strip test",
        version=str(found["version"]),
        summary=summary,
        tiles=tuple(tiles),
        sections=sections,
        source="The figures behind this page are in strip.json.",
    )


def _curves(variants: Sequence[Mapping[str, Any]], flights: int) -> Section:
    figures = (
        _figure(variants, 0.0, "eta along the strip", flights),
        _figure(variants, 0.9, "The same from 0.9 upwards", flights),
    )
    lead = (
        "Orthorectification quality of the board below each photo, as mapped into the first"
        " photo (Y 4.7, Fig. 6.5)."
    )
    return Section(id="eta", title="eta along the strip", lead=lead, blocks=figures)


def _figure(variants: Sequence[Mapping[str, Any]], low: float, title: str, flights: int) -> Figure:
    photos = len(variants[0]["eta"])
    axes = Axes(x=(1.0, float(photos)), y=(low, 1.0 + (1.0 - low) * 0.02), width=760, height=400)
    floor = axes.height - axes.bottom
    clip = Markup(
        '<clipPath id="box{}"><rect x="{}" y="0" width="{}" height="{}"/></clipPath>'
    ).format(round(100 * low), axes.left, axes.width - axes.left, floor)
    curves = [_curve(axes, v["eta"], COLOURS[k], DASHES[k]) for k, v in enumerate(variants)]
    group = Markup('<g clip-path="url(#box{})">{}</g>').format(
        round(100 * low), Markup().join(curves)
    )
    legend = tuple(LegendItem(colour=COLOURS[k], text=v["name"]) for k, v in enumerate(variants))
    return Figure(
        svg=drawing([axes.grid("photo", "eta"), clip, group], title, axes.width, axes.height),
        title=title,
        caption=f"Median of {flights} flight(s) that differ in everything random; 1 is the first"
        " photo's board.",
        legend=legend,
        wide=True,
    )


def _curve(axes: Axes, values: Sequence[float | None], colour: str, dashes: str) -> Markup:
    shown = [(k, v) for k, v in enumerate(values, 1) if v is not None]
    points = axes.points(np.array(shown, np.float64))
    return Markup(
        '<path style="fill:none;stroke:{};stroke-width:2;stroke-dasharray:{}" d="{}"/>'
    ).format(colour, dashes or "none", polyline(points))


def _table(variants: Sequence[Mapping[str, Any]]) -> Section:
    rows = []
    for v in variants:
        eta, ends = [e for e in v["eta"] if e is not None], v["eta_end"]
        middle = eta[(len(eta) - 1) // 2]
        rows.append(
            (
                v["name"],
                "yes" if v["levelled"] else "no",
                v["model"],
                f"{v['calibration_rms_px']:.2f}",
                f"{middle:.3f}",
                f"{np.median(ends):.3f}",
                f"{min(ends):.3f}",
                f"{max(ends):.3f}",
            )
        )
    head = (
        "lens model",
        "levelled",
        "transformation",
        "calibration, px",
        "eta, middle",
        "end",
        "least end",
        "best end",
    )
    table = Table(
        title="Nine variants",
        head=head,
        rows=tuple(rows),
        numeric="tttnnnnn",
        note="Calibration: RMS error of the lens model on the board's views. Middle and end:"
        " medians over the flights.",
    )
    return Section(id="variants", title="Variants", blocks=(table,))


def _how(found: Mapping[str, Any]) -> Section:
    s = found["settings"]
    items = (
        f"{found['flights']} flight(s) of {s['photos']} photos of {s['lens']['width']} x"
        f" {s['lens']['height']} px from"
        f" {s['height']:g} m, overlap {100 * s['overlap']:.0f} %, pitch and roll of {s['tilt']:g}"
        " degrees (sigma).",
        "Points are simulated observations, not pixels: the boards' corners, and points on things"
        " up"
        " to"
        f" {s['relief']:g} m high"
        f" ({100 * s['things']:.0f} % of all), with {s['noise']:g} px of noise. Which point is"
        " which is known.",
        f"The lens is fitted for each order of distortion, to {s['views']} simulated views of"
        " a board.",
        "Photo to photo: RANSAC with a loose threshold, then the features of the dominant plane (Y"
        " 4.8, 4.9).",
    )
    return Section(id="how", title="How it was made", blocks=(Sentences(items=items),))
