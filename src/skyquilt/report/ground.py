"""Drawings of the ground: metres from the north-west corner, and pictures made of shared layers."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from skyquilt.report.input import Bounds, ReportInput
from skyquilt.report.numbers import decimals_of, fixed, nice
from skyquilt.report.svg import WIDTH, coordinate, drawing, line, text

MAP_WIDTH = 1072


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The area that all pictures show."""

    bounds: Bounds
    """West, south, east, north in m (map frame)."""
    unit: str
    """`m`, or `units` where the scale is unknown."""

    @property
    def width(self) -> float:
        """From west to east in m."""
        return self.bounds[2] - self.bounds[0]

    @property
    def height(self) -> float:
        """From south to north in m."""
        return self.bounds[3] - self.bounds[1]

    @property
    def diagonal(self) -> float:
        """Length of the diagonal in m."""
        return float(np.hypot(self.width, self.height))

    @property
    def decimals(self) -> int:
        """Number of decimals that resolves 1/20 000 of the ground."""
        return decimals_of(nice(self.diagonal, 20_000))

    def xy(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map coordinates (k, 2+) as m right of and below the north-west corner."""
        points = np.asarray(points, np.float64)
        return np.stack([points[:, 0] - self.bounds[0], self.bounds[3] - points[:, 1]], 1)

    def box(self, bounds: Bounds) -> Markup:
        """Attributes that place an image at the bounds."""
        west, south, east, north = bounds
        numbers = (west - self.bounds[0], self.bounds[3] - north, east - west, north - south)
        return Markup('x="{}" y="{}" width="{}" height="{}" preserveAspectRatio="none"').format(
            *(coordinate(v, self.decimals + 1) for v in numbers)
        )


def ground_of(data: ReportInput) -> Ground | None:
    """The area that covers the map and the photos' centres; None if nothing has a position."""
    corners = [
        np.reshape(b, (2, 2)) for b in (data.bounds, data.views_bounds, data.surface_bounds) if b
    ][:1]
    centres = [np.reshape(s.xyz, (1, 3))[:, :2] for s in data.shots]
    marks = [np.array([[m.x, m.y]]) for m in data.seams] if not corners else []
    points = (
        np.concatenate([*corners, *centres, *marks], dtype=np.float64)
        if corners or centres or marks
        else None
    )
    points = points[np.isfinite(points).all(1)] if points is not None else np.zeros((0, 2))
    if not len(points):
        return None
    low, high = points.min(0), points.max(0)
    size = max(float((high - low).max()), 1e-3 if corners else 10.0)
    margin = np.maximum(0.03 * size, (0.25 * size - (high - low)) / 2)
    west, south, east, north = (float(v) for v in (*(low - margin), *(high + margin)))
    return Ground(bounds=(west, south, east, north), unit="m" if data.metric else "units")


def use(layer: str, cls: str = "") -> Markup:
    """Draws a layer of the page's definitions in the style of a class."""
    return Markup('<use href="#layer-{}" class="{}"/>').format(layer, cls)


def fit(ground: Ground, width: float, shortest: float, tallest: float) -> tuple[float, str]:
    """Height in px of a picture of this width, and the transform from the ground to it."""
    height = float(np.clip(width * ground.height / ground.width, shortest, tallest))
    scale = min(width / ground.width, height / ground.height)
    x, y = (width - scale * ground.width) / 2, (height - scale * ground.height) / 2
    return round(height), f"matrix({scale:.8g} 0 0 {scale:.8g} {x:.2f} {y:.2f})"


def picture(ground: Ground, layers: Iterable[Markup], title: str) -> Markup:
    """Draws layers on top of one another, with a scale bar."""
    height, transform = fit(ground, WIDTH, 200, 460)
    scale = min(WIDTH / ground.width, height / ground.height)
    world = Markup('<g transform="{}">{}</g>').format(transform, Markup().join(layers))
    return drawing([world, scale_bar(scale, height, ground.unit)], title, WIDTH, height)


def scale_bar(scale: float, height: float, unit: str) -> Markup:
    """A bar of a round length in the lower left corner; `scale` is px per m."""
    length = nice(140 / scale / 2, 1)
    y, right = height - 16, 16 + length * scale
    label = f"{fixed(length, decimals_of(length))} {unit}"
    return Markup('<g class="furniture">{}{}{}</g>').format(
        line(16, y, right, y, "bar-casing"),
        line(16, y, right, y, "bar-line"),
        text(16, y - 8, label),
    )


def north_arrow(width: float) -> Markup:
    """An arrow to the north in the upper right corner."""
    return Markup(
        '<g class="furniture" transform="translate({} 34)"><path class="needle" d="M0 -20L8 6L0'
        ' 0L-8 6Z"/>'
        '<text y="22" class="mid">N</text></g>'
    ).format(coordinate(width - 30))
