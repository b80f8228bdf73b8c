"""Section: the quality function of the thesis, its graphs, and depth maps of pairs (Y 4.8, 6.1,
Fig. 6.4).
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from skyquilt.report.graphs import COLOURS, lines, picture
from skyquilt.report.input import ReportInput
from skyquilt.report.numbers import DASH, count, fixed, items, mapping, number
from skyquilt.report.parts import Block, Figure, LegendItem, Missing, Section, Table

MOST_DISTANCES = 60


def quality_section(data: ReportInput) -> Section:
    """Agreement of photos at their places, and known distances on the map."""
    quality = mapping(data.metrics.get("quality"))
    if not quality:
        return Section(
            id="quality", title="Quality", blocks=(Missing(why="Not measured in this run."),)
        )
    blocks: list[Block] = [
        _lambda(quality),
        *_distances(quality),
        *_graphs(quality),
        *_depths(data),
    ]
    return Section(
        id="quality",
        title="Quality",
        blocks=tuple(blocks),
        lead="The photos are placed again in order of capture, at one ground resolution: how well"
        " does each photo fit the map so far?",
    )


def _lambda(quality: Mapping[str, Any]) -> Table:
    rows = [
        (
            "\u03bb corr",
            _percent(quality.get("lambda_corr")),
            "fit to the map so far, mean of (1 + CC) / 2",
        ),
        (
            "\u03bb spat",
            _percent(quality.get("lambda_spat")),
            "agreement with known distances, mean of 1 / (1 + relative error)",
        ),
        (
            "\u03bb spat, as printed",
            _percent(quality.get("lambda_spat_of_table")),
            "1 minus the sum of relative errors",
        ),
        (
            "\u03bb",
            _percent(quality.get("lambda")),
            f"weight of distances {_plain(quality.get('alpha'), 2)}",
        ),
    ]
    ste = mapping(quality.get("ste_per_inlier_px2"))
    if ste:
        told = f"{_plain(ste.get('median'), 2)} (worst {_plain(ste.get('worst'), 2)})"
        rows.append(
            (
                "STE per inlier, px\u00b2",
                told,
                "symmetric transfer error of the registrations, at 1500 px width",
            )
        )
    for key, label in (
        ("geolocation_mae_m", "MAE x, y, z, m"),
        ("geolocation_rms_m", "RMS x, y, z, m"),
    ):
        axes = mapping(quality.get(key))
        if axes:
            told = ", ".join(_plain(axes.get(a), 2) for a in "xyz")
            rows.append((label, told, "photos' centres against their reported positions"))
    return Table(
        title="Quality function", head=("", "value", "meaning"), rows=tuple(rows), numeric="tnt"
    )


def _distances(quality: Mapping[str, Any]) -> list[Block]:
    known = [mapping(d) for d in items(quality.get("distances"))]
    if not known:
        return []
    rows = []
    for d in known[:MOST_DISTANCES]:
        metres, found = number(d.get("metres")), number(d.get("on_map"))
        off = None if metres is None or found is None else found - metres
        rows.append(
            (f"{d.get('a')} to {d.get('b')}", _plain(metres, 3), _plain(found, 3), _plain(off, 3))
        )
    note = (
        f"{count(len(known) - MOST_DISTANCES, 'distance')} more in metrics.json."
        if len(known) > MOST_DISTANCES
        else ""
    )
    head = ("between", "known, m", "on the map, m", "error, m")
    return [Table(title="Known distances", head=head, rows=tuple(rows), numeric="cnnn", note=note)]


def _graphs(quality: Mapping[str, Any]) -> list[Block]:
    both = [
        ("with the previous photo", _array(quality.get("correlation_with_last_of_photo"))),
        ("with the map so far", _array(quality.get("correlation_with_map_of_photo"))),
    ]
    if max((np.isfinite(v).sum() for _, v in both), default=0) < 2:
        return []
    legend = tuple(LegendItem(colour=COLOURS[k], text=name) for k, (name, _) in enumerate(both))
    upper = lines(both, title="Correlation of overlapping parts", x_label="photo", y_label="CC")
    figures: list[Block] = [
        Figure(
            svg=upper,
            title="Correlation",
            legend=legend,
            wide=True,
            caption="A low value is a photo that does not fit the map so far: moving objects,"
            " relief, or a wrong position.",
        )
    ]
    off = _array(quality.get("off_position_over_width"))
    if np.isfinite(off).sum() > 1:
        lower = lines(
            [("", off)],
            title="Distance from the reported position",
            x_label="photo",
            y_label="photo widths",
        )
        figures.append(
            Figure(
                svg=lower,
                title="Distance from the reported position",
                wide=True,
                caption="As a multiple of the width of a photo on the ground.",
            )
        )
    return figures


def _depths(data: ReportInput) -> list[Block]:
    return [
        picture(
            d.pixels,
            f"Depth map of {d.name}",
            f"Disparity vectors of {count(d.features, 'inlier')} after the transformation: red is"
            " x, green the length, blue y, each stretched to its range;"
            f" {count(d.removed, 'feature')} off the dominant plane left out.",
            longest=420,
        )
        for d in data.depths
    ]


def _array(values: object) -> np.ndarray:
    return np.array([np.nan if number(v) is None else number(v) for v in items(values)], np.float64)


def _percent(value: object) -> str:
    known = number(value)
    return DASH if known is None else f"{100 * known:.1f}\u202f%"


def _plain(value: object, digits: int) -> str:
    known = number(value)
    return DASH if known is None else fixed(known, digits)
