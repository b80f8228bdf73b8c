"""The rasters of a finished run as layers: what each shows, in which colours, in which unit."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt.outside import open_regular, read_bounded
from skyquilt.raster.colours import Palette
from skyquilt.raster.map_source import MapSource

UNITS = {"celsius": "\u00b0C", "counts": "counts"}
DATUMS = {
    "takeoff": "above take-off",
    "sea_level": "above sea level",
    "egm96": "above sea level (EGM96)",
    "ellipsoid": "above the ellipsoid",
    "control": "in the control points' height system",
}
OVERVIEW_PX = 512
"""Longer side of the overview from which the range of colours is found."""


@dataclass(frozen=True, kw_only=True)
class RunLayer:
    """A raster of a run."""

    name: str
    """Its name."""
    title: str
    """What it is called in lists."""
    file: str
    """Its file in the folder of the run."""
    palette: Palette = "heat"
    """Colours of its values; colour images are shown as they are."""
    measured: bool = False
    """Whether its values have a meaning of their own: heights, temperatures, numbers."""


LAYERS = (
    RunLayer(name="mosaic", title="Map", file="mosaic.tif"),
    RunLayer(name="thermal", title="Thermal", file="thermal.tif", measured=True),
    RunLayer(name="infrared", title="Colour infrared", file="infrared.tif"),
    RunLayer(name="ndvi", title="NDVI", file="ndvi.tif", palette="plants", measured=True),
    RunLayer(name="ndre", title="NDRE", file="ndre.tif", palette="plants", measured=True),
    RunLayer(name="gndvi", title="GNDVI", file="gndvi.tif", palette="plants", measured=True),
    RunLayer(name="heights", title="Heights", file="dsm.tif", palette="heights", measured=True),
    RunLayer(name="hillshade", title="Hillshade", file="hillshade.tif"),
    RunLayer(name="ground", title="Bare ground", file="dtm.tif", palette="heights", measured=True),
    RunLayer(
        name="views", title="Photos per place", file="views.tif", palette="counts", measured=True
    ),
    RunLayer(
        name="provenance",
        title="Photo shown",
        file="provenance.tif",
        palette="numbers",
        measured=True,
    ),
)
"""The layers that a run may have, in the order of lists."""
FLAT = RunLayer(
    name="heights", title="Heights", file="surface.tif", palette="heights", measured=True
)
"""Heights of runs without a surface model."""


def is_tiff(path: Path) -> bool:
    """Whether a map is a TIFF by its content. GDAL would also read text that names other files and
    addresses.
    """
    try:
        with open_regular(path) as file:
            return file.read(4) in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
    except OSError:
        return False


def layers_in(folder: Path) -> dict[str, RunLayer]:
    """The layers that a run has, by name; a damaged surface model is not replaced by the ground."""
    found = {layer.name: layer for layer in LAYERS if is_tiff(folder / layer.file)}
    named = {layer.name: layer.file for layer in LAYERS}
    if not (folder / named["heights"]).exists() and is_tiff(folder / FLAT.file):
        found["heights"] = FLAT
    return {name: found[name] for name in (x.name for x in LAYERS) if name in found}


def figures_of(folder: Path) -> dict[str, Any]:
    """The content of metrics.json; empty where there is none that can be read."""
    try:
        found = json.loads(read_bounded(folder / "metrics.json"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def unit_of(layer: RunLayer, figures: Mapping[str, Any]) -> str:
    """Unit of a layer's values as printed; empty where they have none."""
    if layer.palette == "heights":
        datum = DATUMS.get(str(figures.get("vertical_datum")), "")
        return f"m {datum}".strip()
    told = figures.get("thermal") if layer.name == "thermal" else figures
    told = told if isinstance(told, Mapping) else {}
    of_values = told.get("thermal_values") or {}
    unit = told.get("unit") or (of_values.get("unit") if isinstance(of_values, Mapping) else "")
    if layer.palette == "plants":
        return ""
    return {"views": "photos", "provenance": ""}.get(
        layer.name, UNITS.get(str(unit), "" if unit is None else str(unit))
    )


def vertical_of(layer: RunLayer, figures: Mapping[str, Any]) -> int | None:
    """EPSG code of the zero of a layer's heights; None where there is none."""
    from skyquilt.alignment.heights import VERTICAL_EPSG

    known = str(figures.get("vertical_datum"))
    return VERTICAL_EPSG.get(known) if layer.palette == "heights" else None


def range_of(layer: RunLayer, source: MapSource) -> tuple[float, float] | None:
    """Values shown in the first and in the last colour: the 2nd and 98th percentile of what is
    measured; None for colour images.
    """
    bounds = source.bounds()
    if bounds is None or layer.palette == "numbers":
        return None
    longest = max(bounds[2] - bounds[0], bounds[3] - bounds[1])
    part = source.part(bounds, longest / OVERVIEW_PX)
    if part is None or not part.shown.any():
        return None
    if part.pixels.dtype == np.uint8 and not layer.measured:
        return None
    shown = part.pixels[..., 0][part.shown]
    if layer.palette == "counts":
        return 0.0, float(shown.max())
    low, high = np.percentile(shown, [2, 98])
    return float(low), float(high)
