"""The story of two spectra: a visual map, and the thermal map on its grid.

    visual mosaic -> thermal mosaic -> registration of the two -> thermal.tif on the visual grid
    visual mosaic -> photos taken together -> their cameras' rotation -> thermal.tif on the visual poses

Where one drone took both, by times or names, the cameras' rotation is found once, and the thermal photos are drawn
where the visual ones were. Otherwise both flights become maps by themselves, each by its own adjustment. What their
positions leave open, a few metres, the registration of the finished maps closes [Yahyanejad 2013, 5.2.3]: of the
pictures, or of the heights under them, which look alike in every spectrum, by day and night, in summer and winter
(5.8). Where neither is to be believed, the thermal map lies where its own positions put it, and says so.
"""

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.config import MosaicSettings, methods
from skyquilt.config_register import registration_method
from skyquilt.errors import RefusedError, UsageError
from skyquilt.model.event import Event, Note, Result, StageFinished, StageStarted
from skyquilt.model.photo import RejectedPhoto
from skyquilt.model.registration import Guess, Picture, RefusedRegistration, Registration
from skyquilt.photos.survey import read_survey
from skyquilt.photos.together import taken_together
from skyquilt.pipelines.mosaic import iter_mosaic
from skyquilt.pipelines.pictures import Source, guess_of, open_picture
from skyquilt.pipelines.register_files import overlays, resample_onto
from skyquilt.pipelines.scene import scene_of_run
from skyquilt.pipelines.thermal_files import write_figures, write_overlays
from skyquilt.pipelines.thermal_pairs import by_pairs
from skyquilt.pipelines.thermal_rig import draw_rigged, rig_figures, rigged
from skyquilt.run.clock import Clock
from skyquilt.spectral.orientation import between, full_size, orientation
from skyquilt.spectral.sharpen import Sharpen
from skyquilt.spectral.usable import both_usable

ROUTES = ("auto", "rig", "maps", "pairs", "heights", "positions")
"""How the thermal map finds its place: by the rig where one drone took both, by the pictures of both maps, by pairs
of photos, by heights, or by its positions alone; auto takes the first of these that can be believed.
"""
FINE = 700.0
"""Side in px of the square whose area the maps have when the join is sharpened: finer detail is shadows, which have
moved between two flights, and the join would follow them."""
FOLDER = "thermal"
"""Folder of the thermal run, below the visual one's."""
_NO_PHOTOS = RefusedRegistration(reason="the photos behind the maps are not at hand")


@dataclass(frozen=True, kw_only=True, eq=False)
class Joined:
    """How the thermal map was laid on the visual one."""

    route: str
    """One of `ROUTES` but `auto`."""
    thermal_H_visual: NDArray[np.float64]
    """(3, 3) takes px of the visual map to those of the thermal map."""
    outcome: Registration | None
    """The registration it rests on; None for positions."""
    refused: tuple[tuple[str, str], ...]
    """Routes tried in vain, and why."""


def iter_thermal(
    photos: Path | str, thermal: Path | str, output: Path | str, settings: MosaicSettings | None = None, *,
    route: str = "auto", overwrite: bool = False, rerun_from: str | None = None,
) -> Iterator[Event]:  # fmt: skip
    """Makes the visual map and the thermal map on its grid; the last event is the `Result` of both.

    Raises:
        RefusedError: the one route asked for cannot be believed; both maps are there by then.
        SkyquiltError: anything else a user can mend.
    """
    asked, output = settings or MosaicSettings(), Path(output)
    settings = replace(asked, thermal_unit=None)
    heated = replace(asked, thermal_unit=asked.thermal_unit or "auto")
    if route not in ROUTES:
        raise UsageError(f"--thermal-route {route!r} is not one of {', '.join(ROUTES)}")
    if not Path(thermal).is_dir():
        raise UsageError(f"--thermal {thermal} is no folder; give the folder of the thermal photos")
    visual = yield from _told(
        iter_mosaic(photos, output, settings, overwrite=overwrite, rerun_from=rerun_from)
    )
    refused: tuple[tuple[str, str], ...] = ()
    if route in ("auto", "rig"):
        began = Clock.now()
        yield StageStarted(stage="rig", total=0)
        result = _by_rig(photos, thermal, visual, heated)
        yield _finished("rig", began)
        if isinstance(result, Result):
            yield result
            return
        if route == "rig":
            raise RefusedError(
                f"the thermal photos cannot be laid on the visual poses: {result.reason}; use --thermal-route auto"
            )
        refused = (("rig", result.reason),)
    own = replace(
        heated, gcp=None, geo=None, cameras=None, bounds=None, boundary=None, gsd_cm=None,
        crs=visual.metrics["crs"] or settings.crs, compress="auto",
    )  # fmt: skip
    yield Note(text="the thermal photos become a map of their own, then it is laid on the visual one")
    heat = yield from _told(
        iter_mosaic(thermal, output / FOLDER, own, overwrite=overwrite, rerun_from=rerun_from)
    )
    began = Clock.now()
    yield StageStarted(stage="join", total=0)
    a, b = (_opened(result.output / "mosaic.tif") for result in (visual, heat))

    def pairs() -> Registration | RefusedRegistration:
        return by_pairs(scene_of_run(photos, visual, settings), scene_of_run(thermal, heat, own))

    joined = join(a, b, (visual.output / "surface.tif", heat.output / "surface.tif"), route, pairs)
    joined = replace(joined, refused=(*refused, *joined.refused))
    resample_onto(output / "thermal.tif", a, b, joined.thermal_H_visual)
    shown = replace_transform(joined)
    write_overlays(output, overlays(a, b, shown))
    figures = {"thermal": _figures(joined, heat, b)}
    write_figures(output, visual.metrics, figures)
    yield _finished("join", began)
    yield from (
        Note(text=f"registration by {name} was refused: {why}", warning=True) for name, why in joined.refused
    )
    yield Result(output=output, metrics={**visual.metrics, **figures})


def _finished(stage: str, began: tuple[float, float]) -> StageFinished:
    now = Clock.now()
    return StageFinished(
        stage=stage,
        seconds=round(now[0] - began[0], 3),
        cpu_seconds=round(now[1] - began[1], 3),
        reused=False,
    )


def _by_rig(
    photos: Path | str, thermal: Path | str, visual: Result, settings: MosaicSettings
) -> Result | RefusedRegistration:
    """thermal.tif from the visual poses, where one drone took both, or why not."""
    survey = read_survey(Path(thermal), thermal_unit=settings.thermal_unit)
    if not taken_together(read_survey(Path(photos), geo=settings.geo).photos, survey.photos):
        return RefusedRegistration(
            reason="no thermal photo was taken together with a visual one, by time or name"
        )
    scene = scene_of_run(photos, visual, replace(settings, thermal_unit=None))
    found = rigged(scene, survey.photos)
    if isinstance(found, RefusedRegistration):
        return found
    output = visual.output
    draw_rigged(output / "thermal.tif", found, scene, methods(settings).blend)
    none = np.zeros((0, 2))
    same = Registration(model="identity", b_H_a=np.eye(3), px_a=none, px_b=none)
    write_overlays(output, overlays(_opened(output / "mosaic.tif"), _opened(output / "thermal.tif"), same))
    figures = {"thermal": rig_figures(found, len(survey.photos) + len(survey.rejected))}
    write_figures(output, visual.metrics, figures)
    return Result(output=output, metrics={**visual.metrics, **figures})


def _told(events: Iterator[Event]) -> Generator[Event, None, Result]:
    """All events but the last; returns the result."""
    found: Result | None = None
    for happened in events:
        if isinstance(happened, Result):
            found = happened
        else:
            yield happened
    if found is None:
        raise RuntimeError("the story ended without a result")
    return found


def join(
    a: Source, b: Source, surfaces: tuple[Path, Path], route: str,
    pairs: Callable[[], Registration | RefusedRegistration] = lambda: _NO_PHOTOS,
) -> Joined:  # fmt: skip
    """The place of the thermal map b on the visual map a, by the first route that can be believed.

    `pairs` registers pairs of the photos behind both maps, px of a to px of b.

    Raises:
        RefusedError: the one route asked for cannot.
    """
    guess = guess_of(a, b)
    if guess is None and route == "positions":
        raise RefusedError(
            "the two maps have no common place: one of them is not georeferenced; use --thermal-route maps"
        )
    refused: list[tuple[str, str]] = []
    ways = {
        "maps": lambda: _by_maps(a, b, guess),
        "pairs": pairs,
        "heights": lambda: _by_heights(a, b, surfaces, guess),
    }
    for name in ways if route == "auto" else (route,):
        if name == "positions":
            break
        outcome = ways[name]()
        if isinstance(outcome, Registration):
            return Joined(route=name, thermal_H_visual=outcome.b_H_a, outcome=outcome, refused=tuple(refused))
        refused.append((name, outcome.reason))
    if guess is None or route not in ("auto", "positions"):
        told = "; ".join(f"by {name}: {why}" for name, why in refused)
        raise RefusedError(
            f"the thermal map cannot be laid on the visual one ({told}); both maps are in the output"
        )
    full = b.full_S_picture @ guess.b_H_a @ np.linalg.inv(a.full_S_picture)
    return Joined(route="positions", thermal_H_visual=full / full[2, 2], outcome=None, refused=tuple(refused))


def _by_maps(a: Source, b: Source, guess: Guess | None) -> Registration | RefusedRegistration:
    return _registered(a, b, a.picture, b.picture, guess)


def _by_heights(
    a: Source, b: Source, surfaces: tuple[Path, Path], guess: Guess | None
) -> Registration | RefusedRegistration:
    """Both surfaces as pictures on the grids of their maps [Y 5.8]."""
    one, other = (heights_on(source, path) for source, path in zip((a, b), surfaces, strict=True))
    return _registered(a, b, one, other, guess)


def heights_on(source: Source, surface: Path) -> Picture:
    """The heights of a run on the grid of its map's picture, the general slope taken away: what stands out of the
    ground is what both surfaces share, whatever their heights count from.
    """
    ground = _opened(surface)
    rows, columns = source.picture.shape
    seen = source.picture.valid
    fine = _sampled(ground, source)
    valid = np.isfinite(fine) if seen is None else seen & np.isfinite(fine)
    y, x = np.mgrid[0:rows, 0:columns]
    basis = np.stack([np.ones(valid.sum()), x[valid], y[valid]], 1)
    plane, *_ = np.linalg.lstsq(basis[::97], fine[valid][::97], rcond=None)
    flat = np.where(valid, fine - (plane[0] + plane[1] * x + plane[2] * y), np.nan)
    return Picture(values=np.asarray(flat, np.float32), valid=valid)


def _sampled(ground: Source, source: Source) -> NDArray[np.float32]:
    """The heights at the pixels (h, w) of a map's picture: both rasters are north up, their grids are not the same."""
    assert ground.place is not None and source.place is not None
    g, s, full = ground.place.affine, source.place.affine, source.full_S_picture
    rows, columns = source.picture.shape
    x = s[2] + s[0] * (full[0, 0] * np.arange(columns) + full[0, 2] + 0.5)
    y = s[5] + s[4] * (full[1, 1] * np.arange(rows) + full[1, 2] + 0.5)
    column, row = np.meshgrid((x - g[2]) / g[0] - 0.5, (y - g[5]) / g[4] - 0.5)
    values = ground.picture.values.astype(np.float32)
    return np.asarray(
        cv2.remap(
            values, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )  # fmt: skip


def _registered(
    a: Source, b: Source, one: Picture, other: Picture, guess: Guess | None
) -> Registration | RefusedRegistration:
    """In px of the files."""
    outcome = registration_method("auto")(one, other, guess)
    if isinstance(outcome, RefusedRegistration):
        return outcome
    outcome = _sharpened(one, other, outcome)
    full_a, full_b = a.full_S_picture, b.full_S_picture
    matrix = full_b @ outcome.b_H_a @ np.linalg.inv(full_a)
    moved_a, moved_b = (
        px @ S[:2, :2].T + S[:2, 2] for px, S in ((outcome.px_a, full_a), (outcome.px_b, full_b))
    )
    return replace(outcome, b_H_a=matrix / matrix[2, 2], px_a=moved_a, px_b=moved_b)


def _sharpened(a: Picture, b: Picture, outcome: Registration) -> Registration:
    """A believed registration with the freedom that two adjusted blocks have between them: their positions may tilt
    and stretch one against the other by some pixels, which a similarity cannot follow.
    """
    pair = both_usable(a, b)
    if isinstance(pair, RefusedRegistration):
        return outcome
    fields = [orientation(p.grey, p.valid, FINE) for p in pair]
    small = between(fields[0], fields[1], outcome.b_H_a)
    rigid = Sharpen(freedom="similarity")(fields[0], fields[1], small)
    free = Sharpen(freedom="affine", steps=12)(fields[0], fields[1], rigid.b_H_a)
    return replace(outcome, model="affine", b_H_a=full_size(fields[0], fields[1], free.b_H_a))


def _opened(path: Path) -> Source:
    found = open_picture(path)
    if isinstance(found, RejectedPhoto):
        raise RefusedError(f"{path} cannot be used for the registration: {found.reason}")
    return found


def replace_transform(joined: Joined) -> Registration:
    """The join as a registration to be drawn."""
    if joined.outcome is not None:
        return joined.outcome
    none = np.zeros((0, 2))
    return Registration(model="affine", b_H_a=joined.thermal_H_visual, px_a=none, px_b=none)


def _figures(joined: Joined, heat: Result, b: Source) -> dict[str, Any]:
    m, outcome = heat.metrics, joined.outcome
    return {
        "route": joined.route, "routes_refused": dict(joined.refused), "unit": b.unit,
        "thermal_H_visual": joined.thermal_H_visual.tolist(),
        "model": outcome.model if outcome else "positions", "inliers": len(outcome.px_a) if outcome else 0,
        "evidence": dict(outcome.evidence) if outcome else {},
        "photos_used": m["photos_used"], "photos_total": m["photos_total"], "gsd_m": m["gsd_m"],
        "blocks": m["blocks"], "method": m["method"],
    }  # fmt: skip
