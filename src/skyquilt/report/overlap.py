"""Sections on the number of photos per place and on the heights of the ground."""

import numpy as np

from skyquilt.report import images
from skyquilt.report.ground import Ground, picture, use
from skyquilt.report.input import ReportInput
from skyquilt.report.layers import MOST_VIEWS, Layer, view_colours
from skyquilt.report.numbers import fixed, nice
from skyquilt.report.parts import Block, Figure, Missing, Section
from skyquilt.report.svg import bars, colour_bar, columns

DATUMS = {
    "takeoff": "above the take-off point",
    "sea_level": "above sea level",
    "egm96": "above sea level (EGM96)",
    "ellipsoid": "above the WGS\u202f84 ellipsoid",
    "control": "in the height system of the control points",
    "unknown": "above an unknown zero",
}


def overlap_section(data: ReportInput, ground: Ground | None, layers: dict[str, Layer]) -> Section:
    """Number of photos that show each place."""
    blocks: tuple[Block, ...] = (
        Missing(why="The number of photos per place was not computed in this run."),
    )
    if data.views is not None and (np.asarray(data.views) > 0).any():
        blocks = (_histogram(data.views),)
        if ground and "overlap" in layers:
            title = "Photos that see each place"
            caption = (
                "Where only one photo shows the ground, heights cannot be measured and errors "
                "cannot be detected. Three or more photos allow both."
            )
            svg = picture(
                ground,
                [
                    use("mosaic", "faded") if "mosaic" in layers else use("overlap"),
                    use("overlap", "haze"),
                ],
                title,
            )
            blocks = (
                Figure(svg=svg, title=title, caption=caption, legend=layers["overlap"].legend),
                *blocks,
            )
    return Section(id="overlap", title="Overlap", blocks=blocks)


def _heights(z: np.ndarray, low: float, high: float, unit: str) -> Figure:
    title = "Share of the cells by height"
    step = nice(high - low, 24)
    edges = np.arange(np.floor(low / step), np.ceil(high / step) + 1) * step
    counts = np.histogram(z, edges)[0]
    median = float(np.median(z))
    svg = bars(
        edges,
        counts / max(len(z), 1) * 100,
        title=title,
        x_label=f"height, {unit}",
        y_label="share of the cells",
        unit="\u202f%",
        marks=((median, f"median {fixed(median, 1)}"),),
    )
    caption = (
        "A few cells far from all others are probably undetected outliers; they distort the map"
        " at that place."
    )
    return Figure(svg=svg, title=title, caption=caption)


def _histogram(views: np.ndarray) -> Figure:
    views = images.thinned(np.asarray(views), 1000)
    seen = np.clip(views[views > 0].astype(np.int64), 1, MOST_VIEWS)
    shares = np.bincount(seen, minlength=MOST_VIEWS + 1)[1:] / len(seen) * 100
    enough = float(shares[2:].sum())
    title = "Share of the mapped ground by number of photos"
    labels = [str(k + 1) for k in range(MOST_VIEWS - 1)] + [f"{MOST_VIEWS}+"]
    svg = columns(
        labels,
        shares,
        [images.css(c) for c in view_colours()],
        title=title,
        x_label="photos that see a place",
        y_label="share of the ground",
    )
    judged = "good" if enough >= 90 else "fair" if enough >= 70 else "poor"
    caption = (
        f"{fixed(enough, 0)}\u202f% of the ground is seen by three photos or more: {judged} "
        "(good from 90\u202f%, fair from 70\u202f%)."
    )
    return Figure(svg=svg, title=title, caption=caption)


def surface_section(data: ReportInput, ground: Ground | None, layers: dict[str, Layer]) -> Section:
    """The heights over which the photos were rectified."""
    blocks: tuple[Block, ...] = (
        Missing(why="The photos were placed on a plane: there is no height surface to show."),
    )
    if (
        ground
        and "heights" in layers
        and data.surface is not None
        and data.surface_bounds is not None
    ):
        z = np.asarray(data.surface)[np.isfinite(data.surface)]
        low, high = images.height_range(z)
        datum = DATUMS.get(data.vertical_datum, data.vertical_datum)
        stops = [images.css(c) for c in images.scale(np.linspace(0, 1, 24)[None])[0]]
        unit = ground.unit
        title = f"Heights {datum}"
        svg = picture(ground, [use("heights")], title)
        bar = colour_bar(stops, f"{fixed(low, 1)} {unit}", f"{fixed(high, 1)} {unit}", "height")
        caption = (
            f"Heights from {fixed(z.min(), 1)} to {fixed(z.max(), 1)} {unit}, shaded from the "
            "north-west. Height errors displace the map horizontally, most near photo edges."
        )
        heights = data.metrics.get("heights", {})
        caption = " ".join([caption, *heights.get("trust", ())])
        blocks = (Figure(svg=svg + bar, title=title, caption=caption), _heights(z, low, high, unit))
        if z.max() - z.min() < 1e-3:
            blocks = (
                Missing(
                    why=f"The surface is level at {fixed(low, 1)} {unit} {datum}: there is no"
                    " relief to show."
                ),
            )
    return Section(id="surface", title="Height surface", blocks=blocks)
