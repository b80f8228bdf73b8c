"""The layers of the map, each drawn once in the page's definitions and reused by every picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from skyquilt.report import images
from skyquilt.report.ground import Ground
from skyquilt.report.input import Bounds, ReportInput, SeamMark, Shot
from skyquilt.report.numbers import fixed, nice
from skyquilt.report.parts import LegendItem
from skyquilt.report.svg import arrows, dots, path, polyline

PREVIEW_PX, VIEWS_PX, SURFACE_PX = 1600, 700, 480
MOST_SHOTS, MOST_SEAMS = 2500, 4000
VALUE_STEPS = 6
"""Entries of the legend of measured values."""
MANY = 300
"""Number of photos from which marks are drawn finer."""
SEAM_EDGES = (0.5, 1.0, 2.0, 5.0)
SEAM_COLOURS = ("#2166ac", "#67a9cf", "#f6e27f", "#ef8a62", "#c2183b", "#8b8f96")
SEAM_LABELS = (
    "up to 0.5 px",
    "0.5 to 1 px",
    "1 to 2 px",
    "2 to 5 px",
    "more than 5 px",
    "not measured",
)
MOST_VIEWS = 9
BLOCK_COLOURS = ("#ffd54a", "#4fc3f7", "#f48fb1", "#aed581", "#ffab66", "#c5b3f5")


@dataclass(frozen=True, kw_only=True)
class Layer:
    """A layer of the map that can be switched on and off."""

    id: str
    """Id of the layer; its definition has the id `layer-...`."""
    label: str
    """Label of its switch."""
    shape: Markup
    """Its definition: one element with that id."""
    styles: tuple[str, ...] = ("",)
    """CSS classes in which it is drawn, one on top of the other."""
    on: bool = False
    """Whether it is shown initially."""
    legend: tuple[LegendItem, ...] = ()
    """Explanation of its colours, if they have a meaning."""


def layers_of(data: ReportInput, ground: Ground) -> tuple[Layer, ...]:
    """All layers for which there are data, from bottom to top."""
    found = (
        mosaic(data, ground),
        surface(data, ground),
        overlap(data, ground),
        footprints(data.shots, ground),
        flight(data.shots, ground),
        gps(data.shots, ground),
        centres(data.shots, ground),
        seams(data.seams, ground),
    )
    return tuple(layer for layer in found if layer)


def mosaic(data: ReportInput, ground: Ground) -> Layer | None:
    """The map's pixels."""
    if data.preview is None or data.bounds is None or not data.preview.size:
        return None
    small = images.shrunk(data.preview, PREVIEW_PX)
    return Layer(
        id="mosaic",
        label="Mosaic",
        shape=clipped("mosaic", small, data.bounds, ground),
        on=True,
        legend=() if data.values is None else value_legend(*data.values),
    )


def value_legend(low: float, high: float, unit: str) -> tuple[LegendItem, ...]:
    """Colours of measured values from the lowest to the highest."""
    share = np.linspace(0, 1, VALUE_STEPS)
    grey = np.rint(255 * share).astype(np.uint8)[None]
    bgr = cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO)[0]
    decimals = 1 if high - low < 50 else 0
    return tuple(
        LegendItem(
            colour=images.css(colour[::-1]),
            text=f"{fixed(low + s * (high - low), decimals)} {unit}",
        )
        for s, colour in zip(share, bgr, strict=True)
    )


def clipped(
    name: str, rgba: NDArray[Any], bounds: Bounds, ground: Ground, *, within: str = ""
) -> Markup:
    """A raster as JPEG, clipped to the outline of its alpha and to another clip path."""
    height, width = rgba.shape[:2]
    west, south, east, north = bounds
    metres = np.array([(east - west) / width, (north - south) / height])
    corner = ground.xy([[west, north]])
    rings = [ring * metres + corner for ring in images.outline(rgba[..., 3])]
    return Markup(
        '<clipPath id="{0}-rim"><path clip-rule="evenodd" d="{1}"/></clipPath>'
        '<g id="layer-{0}" clip-path="url(#{0}-rim)"><g{4}><image {2} href="{3}"/></g></g>'
    ).format(
        name,
        "".join(polyline(ring, ground.decimals, close=True) for ring in rings),
        ground.box(bounds),
        Markup(images.jpeg_uri(rgba)),
        Markup(' clip-path="url(#{})"').format(within) if within else "",
    )


def overlap(data: ReportInput, ground: Ground) -> Layer | None:
    """Number of photos per cell, as steps of colour."""
    if data.views is None or data.views_bounds is None or not (np.asarray(data.views) > 0).any():
        return None
    colours = view_colours()
    table = np.zeros((MOST_VIEWS + 1, 4), np.uint8)
    table[1:, :3], table[1:, 3] = colours, 255
    index = np.clip(images.thinned(np.asarray(data.views), VIEWS_PX), 0, MOST_VIEWS).astype(
        np.uint8
    )
    shape = Markup('<image id="layer-overlap" {} href="{}"/>').format(
        ground.box(data.views_bounds), Markup(images.png_uri(index, table))
    )
    legend = tuple(
        LegendItem(
            colour=images.css(colours[k]),
            text=f"{k + 1}" if k + 1 < MOST_VIEWS else f"{MOST_VIEWS} or more",
        )
        for k in range(MOST_VIEWS)
    )
    return Layer(id="overlap", label="Overlap", shape=shape, styles=("haze",), legend=legend)


def view_colours() -> NDArray[np.uint8]:
    """Colours (MOST_VIEWS, 3) of 1, 2, ... photos."""
    return np.asarray(images.scale(np.linspace(0.02, 0.98, MOST_VIEWS)[None])[0])


def surface(data: ReportInput, ground: Ground) -> Layer | None:
    """Heights in shaded colours."""
    z, bounds = data.surface, data.surface_bounds
    if z is None or bounds is None or not np.isfinite(z).any():
        return None
    small = images.shrunk(np.asarray(z, np.float32), SURFACE_PX, cv2.INTER_NEAREST)
    rgba = images.shaded(small, (bounds[2] - bounds[0]) / small.shape[1])
    shape = clipped(
        "heights", rgba, bounds, ground, within="" if data.preview is None else "mosaic-rim"
    )
    return Layer(id="heights", label="Heights", shape=shape)


def footprints(shots: Sequence[Shot], ground: Ground) -> Layer | None:
    """Outlines on the ground, one path per shot in order."""
    if not any(len(s.footprint) > 2 for s in shots):
        return None
    outlines = "".join(f'<path d="{_outline(s.footprint, ground)}"/>' for s in shots[:MOST_SHOTS])
    shape = Markup('<g id="layer-footprints">{}</g>').format(Markup(outlines))
    return Layer(id="footprints", label="Footprints", shape=shape, styles=("footprints",))


def _outline(footprint: NDArray[Any], ground: Ground) -> str:
    if len(footprint) < 3 or not np.isfinite(footprint).all():
        return ""
    ring = ground.xy(footprint).astype(np.float32)[:, None]
    return polyline(
        cv2.approxPolyDP(ring, ground.diagonal / 1500, True)[:, 0], ground.decimals, close=True
    )


def placed(shots: Sequence[Shot]) -> NDArray[np.float64]:
    """Solved centres (n, 3); NaN where a shot has none."""
    return np.array([np.reshape(s.xyz, 3) for s in shots], np.float64).reshape(-1, 3)


def reported(shots: Sequence[Shot]) -> NDArray[np.float64]:
    """Reported positions (n, 3); NaN where there are none."""
    return np.array([np.reshape(s.reported_xyz, 3) for s in shots], np.float64).reshape(-1, 3)


def flight(shots: Sequence[Shot], ground: Ground) -> Layer | None:
    """The solved centres in order of capture."""
    xyz = placed(shots)
    xyz = xyz[np.isfinite(xyz).all(1)]
    if len(xyz) < 2:
        return None
    shape = Markup('<path id="layer-flight" d="{}"/>').format(
        polyline(ground.xy(xyz), ground.decimals)
    )
    return Layer(
        id="flight", label="Flight path", shape=shape, styles=("casing", "flight"), on=True
    )


def centres(shots: Sequence[Shot], ground: Ground) -> Layer | None:
    """A dot under each solved centre, coloured by block where there are several."""
    xyz, blocks = placed(shots), np.array([s.block for s in shots])
    known = np.isfinite(xyz).all(1)
    if not known.any():
        return None
    kinds = np.unique(blocks[known])
    last = len(BLOCK_COLOURS) - 1
    shapes, legend = [], []
    for k, block in enumerate(kinds[: last + 1].tolist()):
        member = known & ((blocks == block) if k < last else np.isin(blocks, kinds[last:]))
        shapes.append(path(dots(ground.xy(xyz[member]), ground.decimals), f"b{k}"))
        legend.append(
            LegendItem(
                colour=BLOCK_COLOURS[k], text=f"block {block + 1}" if k < last else "other blocks"
            )
        )
    shape = Markup('<g id="layer-centres">{}</g>').format(Markup().join(shapes))
    return Layer(
        id="centres",
        label="Photo centres",
        shape=shape,
        styles=("dot-casing", "dots")
        if known.sum() <= MANY
        else ("small dot-casing", "small dots"),
        on=True,
        legend=tuple(legend) if len(kinds) > 1 else (),
    )


def exaggeration(shots: Sequence[Shot], ground: Ground) -> float:
    """Round factor at which the arrows from reported to solved positions can be seen; at least
    1.
    """
    off = placed(shots)[:, :2] - reported(shots)[:, :2]
    length = np.linalg.norm(off, axis=1)
    length = length[np.isfinite(length) & (length > 0)]
    if not len(length):
        return 1.0
    room = min(
        0.05 * ground.diagonal, 0.8 * float(np.sqrt(ground.width * ground.height / len(length)))
    )
    wanted = room / float(np.percentile(length, 75))
    return max(1.0, nice(wanted / 2, 1)) if wanted > 1 else 1.0


def gps(shots: Sequence[Shot], ground: Ground) -> Layer | None:
    """Arrows from the reported towards the solved position of each photo, exaggerated."""
    tails, off = reported(shots)[:, :2], placed(shots)[:, :2] - reported(shots)[:, :2]
    near = np.linalg.norm(off, axis=1) < ground.diagonal
    if not near.any():
        return None
    factor = exaggeration(shots, ground)
    tails, off = tails[near][:MOST_SHOTS], off[near][:MOST_SHOTS]
    shape = Markup('<path id="layer-gps" d="{}"/>').format(
        arrows(
            ground.xy(tails),
            ground.xy(tails + factor * off),
            ground.decimals,
            longest=ground.diagonal / 90,
        )
    )
    return Layer(
        id="gps",
        label=f"GPS to solution \u00d7{factor:g}",
        shape=shape,
        styles=("casing", "gps") if len(tails) <= MANY else ("gps",),
    )


def seams(marks: Sequence[SeamMark], ground: Ground) -> Layer | None:
    """Samples along the seams, coloured by disparity; at most `MOST_SEAMS` of them."""
    if not marks:
        return None
    stride = -(-len(marks) // MOST_SEAMS)
    xy = ground.xy([[m.x, m.y] for m in marks[::stride]])
    kind = seam_kinds(marks[::stride])
    order = (5, 0, 1, 2, 3, 4)  # the largest disparities on top
    shapes = [
        path(dots(xy[kind == k], ground.decimals), f"s{k}") for k in order if (kind == k).any()
    ]
    shape = Markup('<g id="layer-seams">{}</g>').format(Markup().join(shapes))
    legend = tuple(
        LegendItem(colour=c, text=t) for c, t in zip(SEAM_COLOURS, SEAM_LABELS, strict=True)
    )
    return Layer(
        id="seams",
        label="Seam samples",
        shape=shape,
        styles=("fine dot-casing", "fine dots"),
        legend=legend,
    )


def disparities(marks: Sequence[SeamMark]) -> NDArray[np.float64]:
    """(n,) in px, NaN where not measured."""
    return np.array(
        [np.nan if m.disparity_px is None else m.disparity_px for m in marks], np.float64
    )


def seam_kinds(marks: Sequence[SeamMark]) -> NDArray[np.int64]:
    """(n,) index of each sample's colour."""
    value = disparities(marks)
    return np.where(np.isfinite(value), np.searchsorted(SEAM_EDGES, value), 5)
