"""Results as HTML for notebooks: a small map and the figures that matter."""

import base64
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt.model.event import Result
from skyquilt.model.photo import Survey
from skyquilt.raster.colours import coloured
from skyquilt.raster.map_source import FileSource
from skyquilt.raster.picture_files import image_bytes
from skyquilt.runs.layers import LAYERS, is_tiff, range_of

SIDE = 360
"""Longer side of the small map in px."""


def result_html(result: Result) -> str:
    """A result: the map, reduced, and its figures."""
    return _page(small_map(result.output), result.facts())


def survey_html(survey: Survey) -> str:
    """A survey: where its photos were taken, and what there is."""
    return _page(_positions(survey), survey.facts())


def small_map(folder: Path) -> str:
    """The map of a run as an `<img>` of at most `SIDE` px; empty where there is none."""
    path = folder / "mosaic.tif"
    if not is_tiff(path):
        return ""
    source = FileSource(path=path)
    bounds = source.bounds()
    assert bounds is not None
    part = source.part(bounds, max(bounds[2] - bounds[0], bounds[3] - bounds[1]) / SIDE)
    if part is None:
        return ""
    rgb = coloured(part.pixels, range_of(LAYERS[0], source))
    rgba = np.dstack([rgb, part.shown.astype(np.uint8) * 255])
    data = base64.b64encode(image_bytes(rgba, "image/png")).decode()
    return f'<img alt="the map" style="max-width:{SIDE}px" src="data:image/png;base64,{data}">'


def _positions(survey: Survey) -> str:
    """The photos' positions as a drawing, north up."""
    places = [p.position for p in survey.photos if p.position is not None]
    if len(places) < 2:
        return ""
    at = np.array([[p.longitude_deg, p.latitude_deg] for p in places])
    at[:, 0] *= np.cos(np.radians(at[:, 1].mean()))
    at = (at - at.min(0)) / max(float(np.ptp(at, axis=0).max()), 1e-9)
    xy = np.column_stack([at[:, 0], at[:, 1].max() - at[:, 1]]) * (SIDE / 2 - 16) + 8
    width, height = (xy.max(0) + 8).round()
    dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3"/>' for x, y in xy)
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in xy)
    return (
        f'<svg role="img" aria-label="positions of the photos" width="{width:.0f}"'
        f' height="{height:.0f}"><polyline points="{line}" fill="none" stroke="#7d8c9b"/>'
        f'<g fill="#2f7fe0">{dots}</g></svg>'
    )


def _page(picture: str, facts: dict[str, Any]) -> str:
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(str(k))}</th><td style="text-align:left">'
        f"{escape(str(v))}</td></tr>"
        for k, v in facts.items()
    )
    return (
        '<div style="display:flex;gap:1em;align-items:flex-start;flex-wrap:wrap">'
        f'{picture}<table aria-label="what there is">{rows}</table></div>'
    )
