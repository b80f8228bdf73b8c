"""Output files of a thermal map beside the rasters."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.pictures import Source
from skyquilt.ortho.companions import coloured
from skyquilt.raster.atomic import whole_file, write_text
from skyquilt.report.page import write_page
from skyquilt.thermal.page import thermal_section, with_section

OVERLAYS = ("thermal_checkerboard.png", "thermal_false_colour.png", "thermal_alpha.png")
"""Overlays of both maps; the first image of a registration, side by side, is left out."""


def write_overlays(output: Path, pictures: Sequence[NDArray[np.uint8]]) -> None:
    """Writes RGB images in the order of `register_files.OVERLAYS`."""
    for name, picture in zip(OVERLAYS, pictures[1:], strict=True):
        done, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
        assert done
        with whole_file(output / name, needed=len(data)) as file:
            file.write(data.tobytes())


def write_figures(output: Path, visual: Mapping[str, Any], figures: Mapping[str, Any]) -> None:
    """Writes metrics.json of the visual map, with the registration of the thermal map under
    `thermal`.
    """
    write_text(
        output / "metrics.json", json.dumps({**visual, **figures}, indent=1, allow_nan=False)
    )


def write_section(
    output: Path, thermal: Source, pictures: Sequence[NDArray[np.uint8]], record: Mapping[str, Any]
) -> None:
    """Adds the thermal map with its overlays (`register_files.OVERLAYS`) and figures to the visual
    map's report.
    """
    page = output / "report.html"
    values = thermal.picture.values
    seen = np.isfinite(values) if values.ndim == 2 else np.ones(values.shape[:2], bool)
    seen = seen if thermal.picture.valid is None else seen & thermal.picture.valid
    low, high = np.percentile(values[seen], [1, 99]) if seen.any() else (0.0, 1.0)
    flat = np.where(seen, values, 0) if values.ndim == 2 else values
    rgb = coloured(flat.reshape(*seen.shape, -1), seen.astype(np.uint8) * np.uint8(255))[..., :3]
    section = thermal_section(record, [rgb, *pictures[1:]], (float(low), float(high)))
    if page.is_file():
        write_page(page, with_section(page.read_text(encoding="utf-8"), section))
