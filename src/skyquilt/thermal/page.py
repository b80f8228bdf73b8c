"""What the thermal map adds to the finished run of the visual one: images, figures, a section of
the report.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.page import picture
from skyquilt.coregistration.pictures import Source
from skyquilt.ortho.companions import coloured
from skyquilt.raster.atomic import whole_file
from skyquilt.report.images import shrunk
from skyquilt.report.layers import value_legend
from skyquilt.report.numbers import DASH, fixed, mapping, number, plain
from skyquilt.report.page import add_section
from skyquilt.report.parts import UNITS, Block, Section, Sentences, Table

OVERLAYS = ("thermal_checkerboard.png", "thermal_false_colour.png", "thermal_alpha.png")
"""Overlays of both maps; the first image of a registration, side by side, is left out."""


def write_overlays(output: Path, pictures: Sequence[NDArray[np.uint8]]) -> tuple[str, ...]:
    """Writes RGB images in the order of `coregistration.files.OVERLAYS`; returns their names."""
    for name, pixels in zip(OVERLAYS, pictures[1:], strict=True):
        done, data = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))
        assert done
        with whole_file(output / name, needed=len(data)) as file:
            file.write(data.tobytes())
    return OVERLAYS


def write_section(
    output: Path, thermal: Source, pictures: Sequence[NDArray[np.uint8]], record: Mapping[str, Any]
) -> None:
    """Adds the thermal map with its overlays (`coregistration.files.OVERLAYS`) and figures to the
    report of the visual map.
    """
    values = thermal.picture.values
    seen = np.isfinite(values) if values.ndim == 2 else np.ones(values.shape[:2], bool)
    seen = seen if thermal.picture.valid is None else seen & thermal.picture.valid
    low, high = np.percentile(values[seen], [1, 99]) if seen.any() else (0.0, 1.0)
    flat = np.where(seen, values, 0) if values.ndim == 2 else values
    rgb = coloured(flat.reshape(*seen.shape, -1), seen.astype(np.uint8) * np.uint8(255))[..., :3]
    section = thermal_section(record, [rgb, *pictures[1:]], (float(low), float(high)))
    add_section(output, section)


LONGEST = 1000
"""Longer side in px of images in the page."""
_ROUTES = {
    "rig": "One drone took both: the thermal photos are placed by the poses and the surface of the"
    " visual ones,"
    " rotated by the relative rotation of the cameras.",
    "maps": "Both flights were mapped separately; the images of both maps were registered.",
    "pairs": "Both flights were mapped separately; pairs of their photos were registered and their"
    " correspondences transferred to"
    " both maps.",
    "homographies": "Both flights were mapped separately; pairs of their photos were registered as"
    " they are, and their correspondences carried to both maps by homographies of level ground.",
    "heights": "Both flights were mapped separately; their ground heights were registered, which"
    " do not depend on the"
    " time of day.",
    "positions": "Both flights were mapped separately and are placed by their own positions:"
    " no registration could"
    " be accepted. Without RTK the thermal map lies several metres beside the visual one, so it"
    " does not tell which roof or plant is warm.",
}
_EVIDENCE = {
    "surprise": "agreement of independent patches, -log10 of its probability by chance",
    "patches": "patches that could be tested",
    "patches_agreeing": "of these, patches that independently find the same position",
    "correlation": "correlation of edge orientations over the overlap",
    "likeness": "correlation of edge orientations after refinement",
    "by_colour": "refined by the visual image's colours (1) or by its brightness (0)",
    "colour_surprise": "agreement of independent patches on the colours alone, -log10 of its"
    " probability by chance",
    "correspondences": "correspondences transferred to both maps",
    "pairs": "pairs of photos used",
    "pairs_agreeing": "of these, pairs that agree",
    "pairs_tried": "pairs of photos tried",
    "pairs_registered": "of these, pairs that could be registered",
    "pairs_by_colour": "of these, pairs refined by the visual image's colours",
    "spread_deg": "spread of the pairs' rotations, degrees",
    "delay_s": "thermal photos taken later than visual ones by, s",
    "focal_px": "thermal focal length, px",
    "k1": "thermal lens, k1",
    "cells": "cells of heights compared",
    "residual_m": "robust standard deviation of the height differences, m",
    "halves_apart_m": "distance between the independent solutions of two halves of the ground, m",
}
_CAPTIONS = (
    ("Thermal map", "On the visual map's grid, {low} (dark) to {high} (bright)."),
    (
        "Checkerboard",
        "Visual and thermal map alternate; if registered, structures continue across edges.",
    ),
    (
        "False colour",
        "Visual map in green, thermal map in magenta: fringes show where edges do not coincide.",
    ),
    ("Thermal over visual", "The thermal map in warm colours, half transparent."),
)


def thermal_section(
    record: Mapping[str, Any], pictures: Sequence[NDArray[np.uint8]], ends: tuple[float, float]
) -> Section:
    """The section from the entry `thermal` of metrics.json, RGB images in the order of the
    captions, and the values of the darkest and the brightest colour.
    """
    unit = UNITS.get(str(record.get("unit")), "")
    low, high = (f"{fixed(v, 1)} {unit}".strip() for v in ends)
    figures = [
        picture(shrunk(p, LONGEST), title, caption.format(low=low, high=high))
        for p, (title, caption) in zip(pictures, _CAPTIONS, strict=True)
    ]
    legend = value_legend(*ends, unit)
    figures = [
        replace(f, legend=legend) if f.title in ("Thermal map", "Thermal over visual") else f
        for f in figures
    ]
    blocks: list[Block] = [_error(record), *figures, *_refused(record)]
    if record.get("unit") == "counts":
        words = "The values are sensor counts, not degrees: higher means warmer."
        blocks.insert(0, Sentences(items=(words,)))
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
                "RMS distance between these places and their transformed positions",
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
