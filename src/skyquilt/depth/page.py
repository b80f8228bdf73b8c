"""The report page of a depth map."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from skyquilt.report.images import jpeg_uri
from skyquilt.report.numbers import fixed, plain
from skyquilt.report.page import plain_page
from skyquilt.report.parts import Block, Figure, Section, Table, Tile

_ROUTES = {
    "pair": "Disparities of every pixel of two photos along their baseline, as heights over the"
    " dominant plane.",
    "disparities": "Disparities of the features of all linked pairs after their homographies,"
    " signed along and normalised by their baselines, merged on the map.",
    "reconstruction": "Heights of the whole adjustment, projected to the plane.",
}
_MOST = 12
"""Largest number of disparity fields shown; all of them are in the folder."""


def depth_page(
    record: Mapping[str, Any],
    depth: NDArray[np.uint8],
    fields: Sequence[tuple[str, NDArray[np.uint8]]],
) -> str:
    """The page from the record in depth.json, the map (h, w, 4) and the pairs' fields (h, w, 3)
    with their names.
    """
    low, high = record["percentiles"]["1"], record["percentiles"]["99"]
    caption = (
        f"Blue {fixed(low, 1)}, red {fixed(high, 1)} {record['unit']}, from"
        f" {record['counted_from']}."
    )
    sections = [
        Section(
            id="depth",
            title="Depth",
            lead=_ROUTES[record["route"]],
            blocks=(_figure(depth, "Depth on the map grid", caption),),
        )
    ]
    if fields:
        sections.append(Section(id="pairs", title="Pairs", blocks=_pairs(record, fields)))
    return plain_page(
        title="Depth map",
        summary=f"{record['route']}, {plain(record['photos_used'])} photos.",
        version=str(record["version"]),
        source="The figures behind this page are in depth.json.",
        sections=tuple(sections),
        tiles=_tiles(record),
    )


def _figure(rgba: NDArray[np.uint8], title: str, caption: str) -> Figure:
    image = Markup('<img src="{}" alt="{}">').format(Markup(jpeg_uri(rgba)), title)
    return Figure(svg=image, title=title, caption=caption, wide=True)


def _pairs(
    record: Mapping[str, Any], fields: Sequence[tuple[str, NDArray[np.uint8]]]
) -> tuple[Block, ...]:
    rows = tuple(
        (
            p["a"],
            p["b"],
            plain(p["points"]),
            plain(p["level"]),
            fixed(p["baseline_m"], 2),
            fixed(p["largest_disparity_px"], 1),
        )
        for p in record["pairs"]
    )
    table = Table(
        title="Pairs that determine heights",
        head=("a", "b", "points", "on the plane", "baseline", "largest disparity, px"),
        rows=rows,
        numeric="ccnnnn",
        note=f"Linked pairs that determine none: {len(record['pairs_without'])}.",
    )
    words = (
        "Red: disparity along x, green: its length, blue: along y, each from its least to its"
        " largest value."
    )
    figures = [
        _figure(np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)]), name, words)
        for name, rgb in fields[:_MOST]
    ]
    return table, *figures


def _tiles(record: Mapping[str, Any]) -> tuple[Tile, ...]:
    low, high = record["percentiles"]["1"], record["percentiles"]["99"]
    return (
        Tile(
            label="Range",
            value=fixed(high - low, 1),
            unit=record["unit"],
            says="From the 1st to the 99th percentile of all heights on the map.",
        ),
        Tile(
            label="Photos",
            value=plain(record["photos_used"]),
            says="Placed photos that cover the ground.",
        ),
        Tile(
            label="Pairs",
            value=plain(len(record["pairs"])),
            says="Pairs whose disparities were measured.",
        ),
        Tile(
            label="Cell",
            value=fixed(record["cell_m"], 2),
            unit=record["unit"],
            says="Spacing of the heights.",
        ),
    )
