"""How the thermal map finds its place on the visual one: the routes, and which of them is believed."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.config_register import registration_method
from skyquilt.errors import RefusedError
from skyquilt.geometry.transforms import transfer
from skyquilt.model.photo import RejectedPhoto
from skyquilt.model.registration import Guess, Matrix, Picture, RefusedRegistration, Registration
from skyquilt.pipelines.pictures import Source, guess_of, open_picture
from skyquilt.spectral.orientation import between, full_size, orientation
from skyquilt.spectral.sharpen import Sharpen
from skyquilt.spectral.usable import both_usable

ROUTES = ("auto", "rig", "maps", "pairs", "heights", "positions")
"""How the thermal map finds its place: by the rig where one drone took both, by the pictures of both maps, by pairs
of photos, by heights, or by its positions alone; auto takes what can be believed.
"""
FINE = 700.0
"""Side in px of the square whose area the maps have when the join is sharpened: finer detail is shadows, which have
moved between two flights, and the join would follow them."""
CONFIRMED_PX = 10.0
"""Px of the thermal map within which two routes find the same place."""
Outcome = Registration | RefusedRegistration
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


def join(
    a: Source, b: Source, surfaces: tuple[Path, Path], route: str, *, pairs: Callable[[], Outcome] = lambda: _NO_PHOTOS,
    finer: Callable[[Registration], Outcome] = lambda outcome: outcome,
) -> Joined:  # fmt: skip
    """The place of the thermal map b on the visual map a.

    `auto` takes the first of pictures, pairs and heights that can be believed. Where heights then find the same place
    as pictures or pairs, it takes the heights': shadows and shading, which turn with the sun, do not draw them aside.
    `pairs` registers pairs of the photos behind both maps, px of a to px of b; `finer` sharpens a registration by
    heights measured in those photos.

    Raises:
        RefusedError: the one route asked for cannot be believed.
    """
    guess = guess_of(a, b)
    if guess is None and route == "positions":
        raise RefusedError(
            "the two maps have no common place: one of them is not georeferenced; use --thermal-route maps"
        )
    ways: dict[str, Callable[[], Outcome]] = {
        "maps": lambda: _registered(a, b, a.picture, b.picture, guess),
        "pairs": pairs,
        "heights": lambda: _by_heights(a, b, surfaces, guess, finer),
    }
    refused: list[tuple[str, str]] = []
    for name in ways if route == "auto" else (route,) if route in ways else ():
        outcome = ways[name]()
        if isinstance(outcome, Registration):
            if route == "auto" and name != "heights":
                name, outcome = _exacter(name, outcome, ways["heights"](), b, refused)
            return Joined(route=name, thermal_H_visual=outcome.b_H_a, outcome=outcome, refused=tuple(refused))
        refused.append((name, outcome.reason))
    if guess is None or route not in ("auto", "positions"):
        told = "; ".join(f"by {name}: {why}" for name, why in refused)
        raise RefusedError(
            f"the thermal map cannot be laid on the visual one ({told}); both maps are in the output"
        )
    full = b.full_S_picture @ guess.b_H_a @ np.linalg.inv(a.full_S_picture)
    return Joined(route="positions", thermal_H_visual=full / full[2, 2], outcome=None, refused=tuple(refused))


def _exacter(
    name: str, outcome: Registration, heights: Outcome, b: Source, refused: list[tuple[str, str]]
) -> tuple[str, Registration]:
    """The heights' place where another route confirms it, else that of the other route."""
    if isinstance(heights, RefusedRegistration):
        refused.append(("heights", heights.reason))
        return name, outcome
    apart = _apart_px(outcome.b_H_a, heights.b_H_a, b)
    if apart > CONFIRMED_PX:
        refused.append(
            ("heights", f"they find a place {apart:.0f} px of the thermal map from that of the {name}")
        )
        return name, outcome
    told = {**heights.evidence, f"px_from_{name}": round(apart, 2)}
    return "heights", replace(heights, evidence=told)


def _apart_px(one: Matrix, other: Matrix, b: Source) -> float:
    """Median distance over b of the places that two transforms give the same px of a."""
    x, y = np.meshgrid(np.linspace(0, b.width - 1, 9), np.linspace(0, b.height - 1, 9))
    px = np.column_stack([x.ravel(), y.ravel()])
    moved = transfer(np.asarray(other @ np.linalg.inv(one), np.float64), px)
    return float(np.median(np.linalg.norm(moved - px, axis=1)))


def _by_heights(
    a: Source,
    b: Source,
    surfaces: tuple[Path, Path],
    guess: Guess | None,
    finer: Callable[[Registration], Outcome],
) -> Outcome:
    """Both surfaces as pictures on the grids of their maps [Y 5.8], then the heights themselves."""
    if not all(path.is_file() for path in surfaces):
        return RefusedRegistration(reason="a map has no surface.tif")
    one, other = (heights_on(source, path) for source, path in zip((a, b), surfaces, strict=True))
    outcome = _registered(a, b, one, other, guess)
    return finer(outcome) if isinstance(outcome, Registration) else outcome


def heights_on(source: Source, surface: Path) -> Picture:
    """The heights of a run on the grid of its map's picture, the general slope taken away: what stands out of the
    ground is what both surfaces share, whatever their heights count from.
    """
    ground = opened(surface)
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


def _registered(a: Source, b: Source, one: Picture, other: Picture, guess: Guess | None) -> Outcome:
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


def opened(path: Path) -> Source:
    """A map of ours, read to be registered.

    Raises:
        RefusedError: it cannot be used.
    """
    found = open_picture(path)
    if isinstance(found, RejectedPhoto):
        raise RefusedError(f"{path} cannot be used for the registration: {found.reason}")
    return found


def as_registration(joined: Joined) -> Registration:
    """The join as a registration to be drawn."""
    if joined.outcome is not None:
        return joined.outcome
    none = np.zeros((0, 2))
    return Registration(model="affine", b_H_a=joined.thermal_H_visual, px_a=none, px_b=none)
