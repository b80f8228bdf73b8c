"""Registration of the thermal map to the visual one: the methods, and which of them is accepted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.coregistration.methods import registration_method
from skyquilt.coregistration.pictures import Source, guess_of, open_picture
from skyquilt.coregistration.refine_registration import RefineRegistration
from skyquilt.coregistration.stated_error import state_error
from skyquilt.coregistration.subpixel import SubpixelRefinement
from skyquilt.errors import RefusedError
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.model.registration import Guess, Outcome, Picture, RefusedRegistration, Registration

ROUTES = ("auto", "rig", "maps", "pairs", "heights", "positions", "homographies")
"""Registration methods: by the rig if one drone took both, by the images of both maps, by pairs of
photos, by heights, or by positions alone. `auto` uses the first of these that is accepted.
`homographies` is the thesis's (5.7) as written.
"""
REFINE = RefineRegistration(free=SubpixelRefinement(freedom="affine", steps=12))
"""Refinement of an accepted registration of maps, with as many parameters as the images support."""
FAR_M = 1000.0
"""If the nearest photos of two flights are further apart than this, in m, the flights show
different places.
"""
MOST_STATED = 0.01
"""Largest stated error of a registration of maps, as a share of the thermal picture's diagonal.
Right ones of simulated flights stated 0.001 to 0.006, a wrong one, of maps that have a narrow strip
in common, 0.018.
"""
_NO_PHOTOS = RefusedRegistration(reason="the photos of the maps are not available")


@dataclass(frozen=True, kw_only=True, eq=False)
class Joined:
    """Result of the registration of the thermal map to the visual one."""

    route: str
    """One of `ROUTES` but `auto`."""
    thermal_H_visual: NDArray[np.float64]
    """(3, 3) from px of the visual map to those of the thermal map."""
    outcome: Registration | None
    """The registration used; None for positions."""
    refused: tuple[tuple[str, str], ...]
    """Methods that were refused, with reasons."""


def join(
    a: Source,
    b: Source,
    surfaces: tuple[Path, Path],
    route: str,
    *,
    pairs: Callable[[], Outcome] = lambda: _NO_PHOTOS,
    homographies: Callable[[], Outcome] = lambda: _NO_PHOTOS,
    finer: Callable[[Registration], Outcome] = lambda outcome: outcome,
) -> Joined:
    """Registers the thermal map b to the visual map a.

    `auto` uses the first of images, pairs and heights that is accepted. `pairs` and `homographies`
    register pairs of photos of both maps, px of a to px of b; `finer` refines a registration by
    heights measured in those photos.

    Raises:
        RefusedError: the requested method is refused.
    """
    guess = guess_of(a, b)
    if guess is None and route == "positions":
        raise RefusedError(
            "the two maps have no common frame: one of them is not georeferenced; use"
            " --thermal-route maps"
        )
    ways: dict[str, Callable[[], Outcome]] = {
        "maps": lambda: _by_maps(a, b, guess),
        "pairs": pairs,
        "heights": lambda: _by_heights(a, b, surfaces, guess, finer),
    }
    asked = {**ways, "homographies": homographies}
    refused: list[tuple[str, str]] = []
    for name in ways if route == "auto" else (route,) if route in asked else ():
        outcome = asked[name]()
        if isinstance(outcome, Registration):
            return Joined(
                route=name, thermal_H_visual=outcome.b_H_a, outcome=outcome, refused=tuple(refused)
            )
        refused.append((name, outcome.reason))
    if guess is None or route not in ("auto", "positions"):
        told = "; ".join(f"by {name}: {why}" for name, why in refused)
        raise RefusedError(
            f"the thermal map cannot be registered to the visual one ({told}); both maps are in the"
            " output"
        )
    full = b.full_S_picture @ guess.b_H_a @ np.linalg.inv(a.full_S_picture)
    return Joined(
        route="positions", thermal_H_visual=full / full[2, 2], outcome=None, refused=tuple(refused)
    )


def _by_maps(a: Source, b: Source, guess: Guess | None) -> Outcome:
    """Registers the images of both maps, if they are sure of it all over what both show."""
    return _registered(a, b, a.picture, b.picture, guess, MOST_STATED)


def _by_heights(
    a: Source,
    b: Source,
    surfaces: tuple[Path, Path],
    guess: Guess | None,
    finer: Callable[[Registration], Outcome],
) -> Outcome:
    """Registers images of both surfaces on the grids of their maps [Y 5.8], then the heights
    themselves.
    """
    if not all(path.is_file() for path in surfaces):
        return RefusedRegistration(reason="a map has no surface.tif")
    one, other = (heights_on(source, path) for source, path in zip((a, b), surfaces, strict=True))
    outcome = _registered(a, b, one, other, guess)
    return finer(outcome) if isinstance(outcome, Registration) else outcome


def heights_on(source: Source, surface: Path) -> Picture:
    """The heights of a run on the grid of its map's image, without the general slope. The remaining
    relief is common to both surfaces, whatever their height datum.
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
    """The heights at the pixels (h, w) of a map's image. Both rasters are north up, but have
    different grids.
    """
    assert ground.place is not None and source.place is not None
    g, s, full = ground.place.affine, source.place.affine, source.full_S_picture
    rows, columns = source.picture.shape
    x = s[2] + s[0] * (full[0, 0] * np.arange(columns) + full[0, 2] + 0.5)
    y = s[5] + s[4] * (full[1, 1] * np.arange(rows) + full[1, 2] + 0.5)
    column, row = np.meshgrid((x - g[2]) / g[0] - 0.5, (y - g[5]) / g[4] - 0.5)
    values = ground.picture.values.astype(np.float32)
    return np.asarray(
        cv2.remap(
            values,
            column.astype(np.float32),
            row.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )


def _registered(
    a: Source,
    b: Source,
    one: Picture,
    other: Picture,
    guess: Guess | None,
    most_stated: float | None = None,
) -> Outcome:
    """The registration in px of the files; `most_stated`: largest error that it may state for
    itself, as a share of the other picture's diagonal.
    """
    outcome = registration_method("auto")(one, other, guess)
    if isinstance(outcome, RefusedRegistration):
        return outcome
    if most_stated is not None:
        most = most_stated * float(np.hypot(*other.shape))
        stated = state_error(outcome, one.shape, other.shape, most)
        if stated is not None and stated.error_px > most:
            return RefusedRegistration(
                reason=f"the maps agree in {stated.valid_share:.0%} of what both show only, and may"
                f" lie {stated.error_px:.0f} px apart elsewhere; at most {most:.0f} are accepted",
                inliers=len(outcome.px_a),
                evidence=outcome.evidence,
            )
    outcome = REFINE(one, other, outcome)
    full_a, full_b = a.full_S_picture, b.full_S_picture
    matrix = full_b @ outcome.b_H_a @ np.linalg.inv(full_a)
    moved_a, moved_b = (
        px @ S[:2, :2].T + S[:2, 2] for px, S in ((outcome.px_a, full_a), (outcome.px_b, full_b))
    )
    full = matrix / matrix[2, 2]
    return replace(outcome, b_H_a=full, px_a=moved_a, px_b=moved_b, error=None)


def refuse_apart(visual: Sequence[Photo], thermal: Sequence[Photo]) -> None:
    """Refuses flights over different places, before anything is computed.

    Raises:
        RefusedError: all positions of one flight are far from all of the other.
    """
    places = [
        np.radians(
            [(p.position.latitude_deg, p.position.longitude_deg) for p in photos if p.position]
        )
        for photos in (visual, thermal)
    ]
    if not all(len(p) for p in places):
        return
    a, b = (p[:, None] * [1, np.cos(places[0][0, 0])] for p in places)
    nearest = 6.371e6 * float(np.linalg.norm(a - b.transpose(1, 0, 2), axis=2).min())
    if nearest > FAR_M:
        raise RefusedError(
            f"the thermal photos are {nearest / 1000:.1f} km from the visual ones, by their"
            " positions; give the two"
            " flights over the same place"
        )


def opened(path: Path) -> Source:
    """Opens one of the two maps for registration.

    Raises:
        RefusedError: it cannot be used.
    """
    found = open_picture(path)
    if isinstance(found, RejectedPhoto):
        raise RefusedError(f"{path} cannot be used for the registration: {found.reason}")
    return found


def as_registration(joined: Joined) -> Registration:
    """Converts the result to a registration for drawing."""
    if joined.outcome is not None:
        return joined.outcome
    none = np.zeros((0, 2))
    return Registration(model="affine", b_H_a=joined.thermal_H_visual, px_a=none, px_b=none)
