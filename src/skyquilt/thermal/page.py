"""Section: how a thermal map lies on the visual one, put into the finished report of the visual
map.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.page import picture
from skyquilt.report.images import shrunk
from skyquilt.report.numbers import DASH, fixed, mapping, number, plain
from skyquilt.report.page import section_html
from skyquilt.report.parts import UNITS, Block, Section, Sentences, Table

LONGEST = 1000
"""Px of the longer side of pictures in the page."""
_ROUTES = {
    "rig": "One drone took both: the thermal photos lie on the poses and the surface of the visual"
    " ones, turned by what"
    " both cameras differ by.",
    "maps": "Both flights are maps by themselves; the pictures of both maps were registered.",
    "pairs": "Both flights are maps by themselves; pairs of their photos were registered and their"
    " places carried into"
    " both maps.",
    "heights": "Both flights are maps by themselves; the heights under them were registered, which"
    " look alike at any"
    " hour.",
    "positions": "Both flights are maps by themselves and lie where their own positions put them:"
    " no registration could"
    " be believed.",
}
_EVIDENCE = {
    "surprise": "agreement of independent patches, -log10 of what chance would give",
    "patches": "patches that could be asked",
    "patches_agreeing": "of them, those that find the same place by themselves",
    "correlation": "correlation of edge orientations over the overlap",
    "likeness": "correlation of edge orientations once sharpened",
    "by_colour": "sharpened by the visual picture's colours (1) or by its brightness (0)",
    "colour_surprise": "agreement of independent patches on the colours alone, -log10 of what"
    " chance would give",
    "correspondences": "correspondences carried into both maps",
    "pairs": "pairs of photos used",
    "pairs_agreeing": "of them, those that agree",
    "pairs_tried": "pairs of photos tried",
    "pairs_registered": "of them, those that could be registered",
    "pairs_by_colour": "of them, those sharpened by the visual picture's colours",
    "spread_deg": "spread of the pairs' rotations, degrees",
    "focal_px": "thermal focal length, px",
    "cells": "cells of heights compared",
    "residual_m": "robust deviation of the heights' differences, m",
    "halves_apart_m": "distance between the places that two halves of the ground find by"
    " themselves, m",
}
_CAPTIONS = (
    ("Thermal map", "On the visual map's grid, {low} (dark) to {high} (bright)."),
    (
        "Checkerboard",
        "Visual and thermal map by turns: what runs on across the squares' edges is registered.",
    ),
    ("False colour", "Visual map in green, thermal map in magenta: fringes show where edges part."),
    ("Thermal over visual", "The thermal map in warm colours, half transparent."),
)
_BEGIN, _END = "<!-- other spectrum -->", "<!-- /other spectrum -->"


def thermal_section(
    record: Mapping[str, Any], pictures: Sequence[NDArray[np.uint8]], ends: tuple[float, float]
) -> Section:
    """From what metrics.json says under `thermal`, RGB pictures in the order of the captions, and
    the values of the darkest and the brightest colour.
    """
    unit = UNITS.get(str(record.get("unit")), "")
    low, high = (f"{fixed(v, 1)} {unit}".strip() for v in ends)
    figures = [
        picture(shrunk(p, LONGEST), title, caption.format(low=low, high=high))
        for p, (title, caption) in zip(pictures, _CAPTIONS, strict=True)
    ]
    blocks: list[Block] = [_error(record), *figures, *_refused(record)]
    return Section(
        id="thermal", title="Thermal map", lead=_ROUTES[str(record["route"])], blocks=tuple(blocks)
    )


def _error(record: Mapping[str, Any]) -> Table:
    rows = [
        ("route", plain(record["route"])),
        (
            "thermal photos used",
            f"{plain(record['photos_used'])} of {plain(record['photos_total'])}",
        ),
        ("places or pairs that agree", plain(record["inliers"])),
    ]
    if number(record.get("residual_m")) is not None:
        px = fixed(record.get("residual_px"), 2)
        rows.append(
            (
                "RMS distance between these places and the transform",
                f"{fixed(record['residual_m'], 2)} m, {px} px",
            )
        )
    rows += [
        (_EVIDENCE.get(k, k.replace("_", " ")), plain(v) if v is not None else DASH)
        for k, v in mapping(record.get("evidence")).items()
    ]
    return Table(title="How it was placed", head=("what", "figure"), rows=tuple(rows), numeric="tn")


def _refused(record: Mapping[str, Any]) -> list[Block]:
    refused = mapping(record.get("routes_refused"))
    return (
        [Sentences(items=tuple(f"Not by {k}: {v}." for k, v in refused.items()))] if refused else []
    )


def with_section(page: str, section: Section) -> str:
    """A finished report with this section at its end, in the place of a former one."""
    body = f"{_BEGIN}\n{section_html(section)}\n{_END}"
    found = re.search(f"{re.escape(_BEGIN)}.*?{re.escape(_END)}", page, re.DOTALL)
    return (
        page[: found.start()] + body + page[found.end() :]
        if found
        else page.replace("</main>", f"{body}\n</main>", 1)
    )
