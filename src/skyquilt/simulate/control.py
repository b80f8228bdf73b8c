"""Places targets, surveys them, and observes them in the photos."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.simulate.camera import Lens
from skyquilt.simulate.flight import Shot
from skyquilt.simulate.grid import Doubles
from skyquilt.simulate.layout import Layout
from skyquilt.simulate.reported import Place, Report
from skyquilt.simulate.scene import Country, Scene
from skyquilt.simulate.settings import Control
from skyquilt.simulate.targets import Target

_CANDIDATES = 600
_MARGIN_PX = 10.0


@dataclass(frozen=True, kw_only=True)
class Observation:
    """An observation of a target in a photo."""

    point: str
    """Target name."""
    photo: str
    """File name."""
    x: float
    """px, centres at integers, with observation noise."""
    y: float
    """px."""


@dataclass(frozen=True, kw_only=True)
class Surveyed:
    """A target with its true and its measured coordinates."""

    target: Target
    """The target."""
    true: tuple[float, float, float]
    """Easting, northing, height above the sea, m."""
    measured: tuple[float, float, float]
    """Surveyed easting, northing and height above the sea, m."""


def lay_out(
    settings: Control, country: Country, lens: Lens, shots: Sequence[Shot], reach: float, gsd: float
) -> tuple[Target, ...]:
    """Targets on open ground that several photos show, as far apart as possible.

    `reach` is the largest distance to the nearest nadir, m.
    """
    wanted = settings.points + settings.checks
    if wanted == 0:
        return ()
    rng = np.random.default_rng([country.seed, 41])
    nadirs = np.array([shot.centre[:2] for shot in shots])
    anywhere = nadirs[rng.integers(len(nadirs), size=_CANDIDATES)] + rng.uniform(
        -reach, reach, (_CANDIDATES, 2)
    )
    covered = _covered(country.layout)
    clear = np.array(
        [
            _open(country.layout, covered, place) and country.ground.stands(*map(float, place))
            for place in anywhere
        ]
    )
    views = _views(lens, shots, anywhere)
    places = anywhere[:wanted]
    for least in (1, 2, 3, 4):  # the largest number of views that enough places have
        good = clear & (views >= least)
        if good.sum() >= 3 * wanted:
            places = anywhere[good]
    radius = float(np.clip(7 * gsd, 0.25, 1.0))
    chosen = _spread(places, wanted)
    return tuple(
        Target(
            name=f"{'gcp' if i < settings.points else 'chk'}{i + 1:02d}",
            x=float(x),
            y=float(y),
            radius=radius,
            check=i >= settings.points,
        )
        for i, (x, y) in enumerate(chosen)
    )


def _views(lens: Lens, shots: Sequence[Shot], places: Doubles) -> NDArray[np.int64]:
    """Number of photos that show each place (n, 2), for level ground."""
    points = np.column_stack([places, np.zeros(len(places))])
    size = np.array([lens.width, lens.height])
    count = np.zeros(len(places), dtype=np.int64)
    for shot in shots:
        pixels = shot.project(lens, points)
        count += ((pixels > 0.04 * size) & (pixels < 0.96 * size)).all(axis=1)
    return count


def _covered(layout: Layout) -> Doubles:
    """Circles (n, 3) that trees, houses and cars cover with some space around: x, y and radius."""
    circles = [(t.x, t.y, t.radius + 2.5) for t in layout.trees]
    circles += [(h.x, h.y, h.length / 2 + 6.0) for h in layout.houses]
    circles += [(c.x, c.y, 4.5) for c in layout.cars]
    return np.array(circles).reshape(-1, 3)


def _open(layout: Layout, covered: Doubles, place: Doubles) -> bool:
    """Whether no object covers a place or is close to it."""
    x, y = place
    clear = bool((np.hypot(covered[:, 0] - x, covered[:, 1] - y) > covered[:, 2]).all())
    spot = (float(x), float(y))
    closed = [p.outline for p in layout.parcels if p.kind in ("maize", "wood")] + list(layout.ponds)
    return clear and all(
        cv2.pointPolygonTest(outline.astype(np.float32), spot, True) < -1.5 for outline in closed
    )


def _spread(places: Doubles, count: int) -> Doubles:
    """The outermost place, then repeatedly the place farthest from all chosen ones."""
    chosen = [places[int(np.argmax(np.hypot(*(places - places.mean(axis=0)).T)))]]
    while len(chosen) < min(count, len(places)):
        nearest = np.min([np.hypot(*(places - c).T) for c in chosen], axis=0)
        chosen.append(places[int(np.argmax(nearest))])
    return np.array(chosen)


def survey(settings: Control, country: Country, place: Place) -> list[Surveyed]:
    """Measures the targets' coordinates."""
    rng = np.random.default_rng([country.seed, 42])
    out = []
    for target in country.targets:
        height = country.settings.base + country.ground.at(target.x, target.y)
        true = np.array([place.easting + target.x, place.northing + target.y, height])
        measured = true + rng.normal(0, settings.accuracy, 3)
        out.append(Surveyed(target=target, true=_three(true), measured=_three(measured)))
    return out


def _three(values: Doubles) -> tuple[float, float, float]:
    x, y, z = (round(float(v), 4) for v in values)
    return x, y, z


def observations(
    settings: Control,
    country: Country,
    scene: Scene,
    lens: Lens,
    shots: Sequence[Shot],
    reports: Sequence[Report],
) -> list[Observation]:
    """Observations of the targets, where nothing hides them."""
    if not country.targets:
        return []
    rng = np.random.default_rng([country.seed, 43])
    points = np.array([[t.x, t.y, country.ground.at(t.x, t.y)] for t in country.targets])
    found = []
    for shot, report in zip(shots, reports, strict=True):
        pixels = shot.project(lens, points)
        for target, point, pixel in zip(country.targets, points, pixels, strict=True):
            if _inside(lens, pixel) and _in_sight(scene, shot.place, point):
                x, y = (
                    pixel
                    if not report.turned
                    else (lens.width - 1 - pixel[0], lens.height - 1 - pixel[1])
                )
                dx, dy = rng.normal(0, settings.pixel_noise, 2)
                found.append(
                    Observation(
                        point=target.name, photo=shot.name, x=float(x + dx), y=float(y + dy)
                    )
                )
    return found


def _inside(lens: Lens, pixel: Doubles) -> bool:
    x, y = pixel
    return bool(
        _MARGIN_PX < x < lens.width - 1 - _MARGIN_PX
        and _MARGIN_PX < y < lens.height - 1 - _MARGIN_PX
    )


def _in_sight(scene: Scene, eye: Doubles, point: Doubles) -> bool:
    """Whether the line from a point on the ground to the camera stays above the surface."""
    share = np.linspace(0, 1, 400)[1:]
    line = point + share[:, None] * (eye - point)
    line = line[line[:, 2] < point[2] + 25]
    cells = np.round(scene.grid.pixels(line[:, :2])).astype(int)
    rows = np.clip(cells[:, 1], 0, scene.grid.height - 1)
    cols = np.clip(cells[:, 0], 0, scene.grid.width - 1)
    return bool((scene.height[rows, cols] < line[:, 2] + 0.05).all())


def write_gcp_list(
    path: Path, crs: str, points: Sequence[Surveyed], seen: Sequence[Observation]
) -> None:
    """Writes OpenDroneMap's `gcp_list.txt`; check points are marked in the eighth column."""
    by_name = {point.target.name: point for point in points}
    lines = [crs]
    for observation in sorted(seen, key=lambda s: (s.point, s.photo)):
        point = by_name[observation.point]
        x, y, z = point.measured
        words = [f"{x:.3f}", f"{y:.3f}", f"{z:.3f}", f"{observation.x:.2f}", f"{observation.y:.2f}"]
        words += [observation.photo, observation.point] + ["check"] * point.target.check
        lines.append("\t".join(words))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
