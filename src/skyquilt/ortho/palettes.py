"""Thermal photos that hold a palette's colours: whether all of a map have the same palette.

A camera's operator may change the palette in flight. The map then shows the same temperature in
several colours, and nothing in the files says so.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.photo import Photo, evenly

_MOST = 60
"""Photos that are compared, spread evenly over the flight; each with each other."""
_STEPS = 16
"""Levels of each colour that are told apart."""
_SHARE = 0.005
"""Least share of a picture's pixels that a colour has."""
_APART = 32.0
"""Mean distance of colours, in levels, from which two pictures have different palettes."""


def palette_notes(
    photos: Sequence[Photo], thumbnails: Mapping[int, NDArray[Any]]
) -> tuple[str, ...]:
    """Sentences on placed thermal photos (those with `thumbnails`, (h, w[, 3]) by photo) whose
    palettes differ; none where all are radiometric or visible. Negatives of grey ones are told by
    the links (`matching.levelled`).
    """
    shown = [k for k in sorted(thumbnails) if _is_palette(photos[k])]
    if len(shown) < 2:
        return ()
    some = [shown[k] for k in evenly(len(shown), _MOST)]
    groups = _alike([_colours(thumbnails[k]) for k in some])
    if len(groups) < 2:
        return ()
    listed = ", ".join(f"as {photos[some[g[0]]].name} ({len(g)})" for g in groups[:4])
    return (
        f"Thermal photos have {len(groups)} different palettes, {listed}: the same colour means"
        " different temperatures in the map. Export all with one palette, or use radiometric ones.",
    )


def _is_palette(photo: Photo) -> bool:
    return photo.band == "thermal" and not photo.unit and photo.dtype == "uint8"


def _colours(thumbnail: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 3) the colours of a picture, and their shares (n,)."""
    pixels = thumbnail.reshape(-1, thumbnail.shape[2] if thumbnail.ndim == 3 else 1)
    pixels = np.repeat(pixels, 3, 1) if pixels.shape[1] == 1 else pixels[:, :3]
    code = pixels.astype(int) // (256 // _STEPS) @ [_STEPS * _STEPS, _STEPS, 1]
    count = np.bincount(code, minlength=_STEPS**3)
    often = np.flatnonzero(count >= _SHARE * len(code))
    mean = [np.bincount(code, pixels[:, k], _STEPS**3)[often] / count[often] for k in range(3)]
    return np.stack(mean, 1), count[often] / count[often].sum()


def _alike(colours: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> list[list[int]]:
    """Groups of pictures with the same palette, the largest first. The colours of a palette are a
    line in the space of colours, of which each picture shows a part.
    """
    group = np.arange(len(colours))
    for i, (a, share_a) in enumerate(colours):
        for j, (b, share_b) in enumerate(colours[:i]):
            if group[i] == group[j]:
                continue
            if not (len(a) and len(b)):
                continue
            apart = np.linalg.norm(a[:, None] - b[None], axis=2)
            nearest = min(apart.min(1) @ share_a, apart.min(0) @ share_b)
            if nearest < _APART:
                group[group == group[i]] = group[j]
    found = [np.flatnonzero(group == g).tolist() for g in np.unique(group)]
    return sorted(found, key=len, reverse=True)
