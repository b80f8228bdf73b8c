"""Bands that are less sharp than the others of their rig, and files that are less sharp than the
others of their band.

All bands of a capture show the same ground, so what fine detail it has cancels out of a comparison
between them.
"""

from collections.abc import Sequence

import numpy as np

from skyquilt.multispectral.captures import THERMAL
from skyquilt.multispectral.draw import PlacedBand
from skyquilt.multispectral.recorded import Recorded

_FEWEST = 3
"""Fewest bands of a capture that can be compared."""
_UNSHARP = 0.33
"""Share of the fine detail of other bands below which a band is told: a blur of 1 px (standard
deviation). Sharp bands of one rig differ by a third at most."""
_SHAKEN = 0.1
"""The same of a file against the others of its band; over water, which has no fine detail, they
differ by a factor of 4."""


def relative_detail(
    bands: Sequence[PlacedBand], recorded: dict[str, Recorded]
) -> dict[str, dict[int, float]]:
    """Fine detail of each file over that of the middle one of all bands of its capture, by the
    band's name and the index of the map's photo; without temperatures, and without bands of another
    number of pixels than most.
    """
    light = [b for b in bands if b.files.name != THERMAL]
    sizes = [b.files.photos[0].width * b.files.photos[0].height for b in light]
    usual = max(sorted(set(sizes)), key=sizes.count, default=0)
    alike = [b for b, size in zip(light, sizes, strict=True) if size == usual]
    logs = {b.files.name: _logs(b, recorded) for b in alike}
    found: dict[str, dict[int, float]] = {name: {} for name in logs}
    for i in sorted({i for b in alike for i in b.of_photo}):
        here = {name: of[i] for name, of in logs.items() if np.isfinite(of.get(i, np.nan))}
        if len(here) >= _FEWEST:
            middle = float(np.median(list(here.values())))
            for name, value in here.items():
                found[name][i] = float(np.exp(value - middle))
    return found


def _logs(band: PlacedBand, recorded: dict[str, Recorded]) -> dict[int, float]:
    photos = band.files.photos
    return {i: recorded[photos[j].name].detail for i, j in band.of_photo.items()}


def unsharp_notes(bands: Sequence[PlacedBand], detail: dict[str, dict[int, float]]) -> list[str]:
    """What is told of bands and files that are blurred."""
    middle = {name: value for name, of in detail.items() if (value := typical(of)) is not None}
    notes = []
    for band in bands:
        name = band.files.name
        of = detail.get(name, {})
        if not of:
            continue
        if middle[name] < _UNSHARP:
            others = [f"{n} {v:.0%}" for n, v in middle.items() if n != name]
            notes.append(
                f"The band {name} is not sharp: it has {middle[name]:.0%} of the fine detail of the"
                f" middle one of all bands ({', '.join(others)}); its indices are wrong at edges."
            )
        shaken = [i for i, value in of.items() if value < _SHAKEN * middle[name]]
        if shaken and 2 * len(shaken) < len(of):
            first = band.files.photos[band.of_photo[shaken[0]]].name
            notes.append(
                f"{len(shaken)} of {len(of)} files of the band {name} are blurred against the same"
                f" captures of other bands ({first} for one)."
            )
    return notes


def typical(detail: dict[int, float]) -> float | None:
    """The detail of a band over all its files (by index); None where that of none is known."""
    return float(np.median(list(detail.values()))) if detail else None
