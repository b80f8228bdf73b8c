"""The large map: all layers in one drawing, with switches and the names of photos under the
pointer.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from skyquilt.report.ground import MAP_WIDTH, Ground, fit, north_arrow, scale_bar, use
from skyquilt.report.input import ReportInput
from skyquilt.report.layers import MOST_SHOTS, Layer
from skyquilt.report.numbers import fixed


@dataclass(frozen=True, kw_only=True)
class MapView:
    """The parts of the map's section."""

    definitions: Markup
    """Shapes of all layers."""
    layers: tuple[Layer, ...]
    """The layers, for the switches."""
    world: Markup
    """References to the layers, in m."""
    transform: str
    """From m to px of the drawing."""
    furniture: Markup
    """Scale bar and north arrow, in px."""
    width: int
    """Width of the drawing in px."""
    height: float
    """Height of the drawing in px."""
    facts: str
    """JSON for the script: the ground and the photos."""
    extent: str
    """A sentence about the coordinates of the corners."""


def map_view(data: ReportInput, ground: Ground, layers: Sequence[Layer]) -> MapView:
    """Builds the map from these layers."""
    height, transform = fit(ground, MAP_WIDTH, 400, 720)
    scale = min(MAP_WIDTH / ground.width, height / ground.height)
    world = [
        Markup('<g class="layer" id="on-{}">{}</g>').format(
            y.id, Markup().join(use(y.id, c) for c in y.styles)
        )
        for y in layers
    ]
    return MapView(
        definitions=Markup().join(y.shape for y in layers),
        layers=tuple(layers),
        world=Markup().join(world),
        transform=transform,
        furniture=scale_bar(scale, height, ground.unit)
        + (north_arrow(MAP_WIDTH) if data.crs else Markup()),
        width=MAP_WIDTH,
        height=height,
        facts=facts(data, ground),
        extent=extent(data, ground),
    )


def facts(data: ReportInput, ground: Ground) -> str:
    """Data for the script as JSON, escaped for a script element."""
    west, _, _, north = ground.bounds
    shots = [
        [
            k,
            s.name,
            *ground.xy(np.reshape(s.xyz, (1, 3)))[0].round(ground.decimals).tolist(),
            about(data, k, ground),
        ]
        for k, s in enumerate(data.shots[:MOST_SHOTS])
        if np.isfinite(s.xyz).all()
    ]
    known = {
        "west": west + data.origin[0],
        "north": north + data.origin[1],
        "crs": data.crs or "",
        "unit": ground.unit,
        "shots": shots,
    }
    text = json.dumps(known, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def about(data: ReportInput, k: int, ground: Ground) -> str:
    """Text shown for a photo under the pointer."""
    shot = data.shots[k]
    several = any(s.block != data.shots[0].block for s in (data.shots[0], data.shots[-1], shot))
    words = [f"block {shot.block + 1}"] if several or shot.block else []
    words += [shot.method] if shot.method else []
    off = float(np.linalg.norm(np.subtract(shot.xyz, shot.reported_xyz)[:2]))
    words += [f"{fixed(off, 2)} {ground.unit} from its GPS"] if np.isfinite(off) else []
    return ", ".join(words)


def extent(data: ReportInput, ground: Ground) -> str:
    """The coordinates of the corners as a sentence."""
    west, south, east, north = data.bounds or ground.bounds
    east_0, north_0 = data.origin
    if not data.crs:
        size = f"{fixed(east - west, 1)} by {fixed(north - south, 1)} {ground.unit}"
        return (
            f"The map measures {size}; its coordinates start at an arbitrary point and north"
            " is unknown."
        )
    return (
        f"{data.crs}: easting {fixed(west + east_0, 1)} to {fixed(east + east_0, 1)} m, "
        f"northing {fixed(south + north_0, 1)} to {fixed(north + north_0, 1)} m."
    )
