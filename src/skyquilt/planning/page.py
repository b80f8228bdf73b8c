"""plan.html: a plan on one page, in the style of the reports."""

from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from skyquilt.planning.coverage import Cells
from skyquilt.planning.lattice import to_uv
from skyquilt.planning.records import Array, Plan
from skyquilt.raster.atomic import write_text
from skyquilt.raster.map_source import picture
from skyquilt.raster.older_map import older_map
from skyquilt.report import images
from skyquilt.report.layers import MOST_VIEWS, view_colours
from skyquilt.report.numbers import fixed, seconds
from skyquilt.report.page import plain_page
from skyquilt.report.parts import Figure, LegendItem, Section, Sentences, Table, Tile
from skyquilt.report.svg import dots, polyline
from skyquilt.version import __version__

WIDTH = 1100
"""Width of the map in px."""
MOST_DOTS = 20_000
COLOURS = ("#d97706", "#2563eb", "#7c3aed", "#059669", "#db2777", "#0891b2", "#65a30d", "#b45309")
"""Colours of the drones."""


def write_plan_page(
    path: Path, plan: Plan, cells: Cells, views: NDArray[np.int32], base: Path | None
) -> None:
    """Writes the page; `views`: photos that see each cell, flat; `base`: an old map to draw
    below.
    """
    write_text(path, plan_page(plan, cells, views, base))


def plan_page(plan: Plan, cells: Cells, views: NDArray[np.int32], base: Path | None) -> str:
    """The page as text."""
    frame = Frame(plan)
    sections = [
        Section(
            id="map",
            title="Map",
            lead="Ways of all drones; every dot is a photo.",
            blocks=(_map(plan, frame, base),),
        ),
        Section(id="drones", title="Drones", blocks=(_drones(plan), _sorties(plan))),
        Section(
            id="coverage",
            title="Coverage",
            lead="Number of photos that see each place, by their footprints on the terrain.",
            blocks=(_coverage(plan, frame, cells, views),),
        ),
        Section(id="options", title="Options", blocks=(_options(plan),), folded=True),
    ]
    if plan.warnings:
        sections.insert(
            0, Section(id="warnings", title="Warnings", blocks=(Sentences(items=plan.warnings),))
        )
    flying = sum(bool(any(s.drone == k for s in plan.sorties)) for k in range(len(plan.drones)))
    return plain_page(
        title="Flight plan",
        summary=(
            f"{len(plan.points)} photos by {flying} drone{'s' * (flying != 1)} in"
            f" {len(plan.sorties)} sortie{'s' * (len(plan.sorties) != 1)}."
        ),
        version=__version__,
        source="The whole plan is in plan.json.",
        sections=tuple(sections),
        tiles=_tiles(plan),
    )


class Frame:
    """From the zone to px of the map."""

    def __init__(self, plan: Plan) -> None:
        xy = [np.array([(w.x, w.y) for s in plan.sorties for w in s.way]).reshape(-1, 2)]
        xy += [np.array([(p.x, p.y) for p in plan.points]).reshape(-1, 2)]
        west, south, east, north = plan.site.observe.bounds
        places = np.concatenate([*xy, [(west, south), (east, north)]])
        low, high = places.min(axis=0), places.max(axis=0)
        margin = 0.04 * float(max(high - low))
        low, high = low - margin, high + margin
        self.scale = min(WIDTH / (high[0] - low[0]), 900 / (high[1] - low[1]))
        self.west, self.north = float(low[0]), float(high[1])
        self.bounds = float(low[0]), float(low[1]), float(high[0]), float(high[1])
        self.width = float(high[0] - low[0]) * self.scale
        self.height = float(high[1] - low[1]) * self.scale

    def px(self, xy: Array) -> Array:
        """Places (n, 2) in px."""
        return np.asarray((np.asarray(xy)[:, :2] - [self.west, self.north]) * [1, -1] * self.scale)

    def outline(self, shape: BaseGeometry) -> str:
        """Path data of a polygon."""
        found = []
        for part in getattr(shape, "geoms", [shape]):
            for ring in (part.exterior, *part.interiors):
                found.append(polyline(self.px(np.array(ring.coords)), close=True))
        return "".join(found)

    def drawing(self, parts: list[Markup], title: str) -> Markup:
        """A drawing of the whole map."""
        return Markup(
            '<svg viewBox="0 0 {:.0f} {:.0f}" role="img" aria-label="{}" style="max-width:none">'
            "{}</svg>"
        ).format(self.width, self.height, title, Markup().join(parts))


def _shapes(plan: Plan, frame: Frame) -> list[Markup]:
    """The area and the closed places."""
    area = Markup(
        '<path d="{}" style="fill:#3b82f6;fill-opacity:.12;fill-rule:evenodd;stroke:#3b82f6;'
        'stroke-width:2"/>'
    ).format(frame.outline(plan.site.observe))
    closed = [
        Markup(
            '<path d="{}" style="fill:#dc2626;fill-opacity:.3;stroke:#dc2626;stroke-width:2"/>'
        ).format(frame.outline(k.shape))
        for k in plan.site.keep_out
    ]
    return [area, *closed]


def _map(plan: Plan, frame: Frame, base: Path | None) -> Figure:
    parts = _base(plan, frame, base) + _shapes(plan, frame)
    for s in plan.sorties:
        way = frame.px(np.array([(w.x, w.y) for w in s.way]))
        parts.append(
            Markup('<path d="{}" style="stroke:{};stroke-width:2;stroke-opacity:.85"/>').format(
                polyline(way), colour(s.drone)
            )
        )
        taken = np.array([(w.x, w.y) for w in s.way if w.point is not None]).reshape(-1, 2)
        parts.append(
            Markup('<path d="{}" style="stroke:{};stroke-width:7;stroke-linecap:round"/>').format(
                dots(frame.px(taken[:MOST_DOTS])), colour(s.drone)
            )
        )
    for k, drone in enumerate(plan.drones):
        x, y = frame.px(np.array([drone.start]))[0].tolist()
        parts.append(
            Markup(
                '<rect x="{:.1f}" y="{:.1f}" width="12" height="12" style="fill:{};stroke:#fff;'
                'stroke-width:2"/>'
            ).format(x - 6, y - 6, colour(k))
        )
    parts.append(_scale_bar(frame))
    legend = [LegendItem(colour=colour(k), text=d.name) for k, d in enumerate(plan.drones)]
    legend += [LegendItem(colour="#3b82f6", text="area")]
    legend += [LegendItem(colour="#dc2626", text="keep out")] * bool(plan.site.keep_out)
    return Figure(
        svg=frame.drawing(parts, "Map of the plan"),
        title="Points and ways",
        caption="Squares: take-off places. North is up.",
        legend=tuple(legend),
        wide=True,
    )


def colour(drone: int) -> str:
    """Colour of a drone."""
    return COLOURS[drone % len(COLOURS)]


def _base(plan: Plan, frame: Frame, base: Path | None) -> list[Markup]:
    if base is None:
        return []
    rgba = picture(older_map(base), plan.site.crs, frame.bounds,
                   int(frame.width), int(frame.height))  # fmt: skip
    if rgba is None:
        return []
    return [
        Markup('<image width="{:.0f}" height="{:.0f}" href="{}"/>').format(
            frame.width, frame.height, Markup(images.jpeg_uri(rgba))
        )
    ]


def _scale_bar(frame: Frame) -> Markup:
    metres = float(10 ** np.floor(np.log10(max(frame.width / frame.scale / 4, 1e-3))))
    metres *= 5 if 5 * metres * frame.scale < frame.width / 4 else 2
    y = frame.height - 16
    return Markup(
        '<path d="M16 {0:.0f}h{1:.0f}" style="stroke:#111;stroke-width:4"/>'
        '<text x="16" y="{2:.0f}" style="font-size:14px">{3:g} m</text>'
    ).format(y, metres * frame.scale, y - 8, metres)


def _coverage(plan: Plan, frame: Frame, cells: Cells, counts: NDArray[np.int32]) -> Figure:
    views = np.where(cells.inside.ravel(), counts, -1).reshape(cells.inside.shape)
    width, height = int(frame.width), int(frame.height)
    x = frame.west + (np.arange(width) + 0.5) / frame.scale
    y = frame.north - (np.arange(height) + 0.5) / frame.scale
    gx, gy = np.meshgrid(x, y)
    uv = to_uv(np.column_stack([gx.ravel(), gy.ravel()]), cells.heading)
    column = np.searchsorted(cells.u, uv[:, 0]) - 1
    row = np.searchsorted(cells.v, uv[:, 1]) - 1
    rows, columns = cells.inside.shape
    known = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    drawn = np.full(len(uv), -1)
    drawn[known] = views[row[known], column[known]]
    asked = plan.proof.views if plan.proof else 1
    colours = np.zeros((MOST_VIEWS + 2, 4), np.uint8)
    colours[1] = (220, 38, 38, 255)
    colours[2:, :3], colours[2:, 3] = view_colours(), 255
    share = np.clip((drawn - asked) * MOST_VIEWS // max(asked, MOST_VIEWS), 0, MOST_VIEWS - 1)
    index = np.where(drawn < 0, 0, np.where(drawn < asked, 1, 2 + share))
    uri = images.png_uri(index.reshape(height, width).astype(np.uint8), colours)
    image = Markup('<image width="{}" height="{}" href="{}"/>').format(width, height, Markup(uri))
    return Figure(
        svg=frame.drawing([image, *_shapes(plan, frame)], "Views of each place"),
        title="Views of each place",
        caption=f"Red: under the {asked} views asked for; from dark ({asked}) to light: more.",
        wide=True,
    )


def _tiles(plan: Plan) -> tuple[Tile, ...]:
    proof = plan.proof
    found = [
        Tile(label="Photos", value=str(len(plan.points)), says="Picture-points of the plan."),
        Tile(
            label="Last landing",
            value=fixed(plan.seconds / 60, 1),
            unit="min",
            says=f"No plan for these points and drones can end before {plan.bound_s / 60:.1f} min.",
        ),
        Tile(label="Sorties", value=str(len(plan.sorties)), says="Flights, one battery each."),
    ]
    if proof:
        found += [
            Tile(
                label="Least views",
                value=str(proof.least),
                verdict="good" if proof.missing_m2 <= 0 else "poor",
                says=f"Of any cell of {proof.cell_m:.1f} m; asked for are {proof.views}.",
            ),
            Tile(
                label="Ground size",
                value=f"{proof.gsd_cm[0]:.2f} to {proof.gsd_cm[1]:.2f}",
                unit="cm",
                says="Of a pixel, on the highest and the lowest ground that photos see.",
            ),
            Tile(
                label="Least overlap",
                value=fixed(100 * proof.overlap, 0),
                unit="%",
                says="Of consecutive photos of a line, on the ground.",
            ),
        ]
    return tuple(found)


def _drones(plan: Plan) -> Table:
    rows = []
    for k, drone in enumerate(plan.drones):
        own = [s for s in plan.sorties if s.drone == k]
        rows.append((
            drone.name, drone.view.name, str(len(own)), str(sum(s.photos for s in own)),
            fixed(sum(s.metres for s in own) / 1000, 2), seconds(sum(s.seconds for s in own)),
            seconds(own[-1].way[-1].time_s) if own else "-",
        ))  # fmt: skip
    return Table(
        title="Each drone",
        head=("drone", "camera", "batteries", "photos", "way, km", "in the air", "lands after"),
        rows=tuple(rows),
        numeric="ccnnnnn",
    )


def _sorties(plan: Plan) -> Table:
    rows = tuple(
        (
            plan.drones[s.drone].name, str(s.number), seconds(s.way[0].time_s), str(s.photos),
            fixed(s.metres / 1000, 2), seconds(s.seconds),
            f"{100 * s.seconds / plan.drones[s.drone].endurance_s:.0f} %",
        )
        for s in plan.sorties
    )  # fmt: skip
    return Table(
        title="Each sortie",
        head=(
            "drone",
            "sortie",
            "takes off after",
            "photos",
            "way, km",
            "duration",
            "of endurance",
        ),
        rows=rows,
        numeric="cnnnnnn",
    )


def _options(plan: Plan) -> Table:
    rows = tuple((k, "-" if v is None else f"{v:g}" if isinstance(v, float) else str(v))
                 for k, v in plan.options.items())  # fmt: skip
    return Table(title="Options", head=("option", "value"), rows=rows, numeric="ct")
