"""Multispectral cameras write a file for each band: a map of all of them would be a patchwork of
bands, so it shows one.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from skyquilt.errors import UsageError
from skyquilt.model.photo import Photo, RejectedPhoto, Survey
from skyquilt.outside import plain
from skyquilt.photos.side_rows import sentence_of

PREFERRED = ("green", "red")
"""Bands that are shown before others of as many photos: lawns, fields and roads differ in them."""


def bands_of(photos: Sequence[Photo]) -> Counter[str]:
    """Photos of each band that files of one channel name."""
    return Counter(p.band_name for p in photos if p.band_name and p.channels == 1)


def of_one_band(survey: Survey, wanted: str | None) -> Survey:
    """The survey with the files of one band, those of the others left out with a reason; files that
    name no band stay. `wanted`: its name; None = the one of which there are most.

    Raises:
        UsageError: no file shows the band that is wanted.
    """
    bands = bands_of(survey.photos)
    if wanted is not None and wanted.lower() not in bands:
        there = f"they show {sentence_of(sorted(bands))}" if bands else "they name none"
        raise UsageError(f"no photo shows the band '{plain(wanted, 40)}' (--band): {there}")
    if len(bands) < 2 and wanted is None:
        return survey
    shown = wanted.lower() if wanted is not None else _usual(bands)
    kept = [p for p in survey.photos if p.band_name == shown or not _of_a_band(p)]
    out = [
        RejectedPhoto(
            name=p.name, reason=f"it shows the band {p.band_name}; the map shows {shown} (--band)"
        )
        for p in survey.photos
        if _of_a_band(p) and p.band_name != shown
    ]
    return replace(
        survey,
        photos=tuple(kept),
        rejected=tuple(sorted((*survey.rejected, *out), key=lambda r: r.name)),
    )


def band_note(photos: Sequence[Photo]) -> tuple[str, ...]:
    """What is said where files show several bands."""
    bands = bands_of(photos)
    if len(bands) < 2:
        return ()
    listed = sentence_of([f"{name} ({n})" for name, n in sorted(bands.items())])
    return (
        f"Each file shows one band of a multispectral camera: {listed}. A map shows one of them,"
        f" {_usual(bands)} unless --band names another.",
    )


def _of_a_band(photo: Photo) -> bool:
    return bool(photo.band_name) and photo.channels == 1


def _usual(bands: Counter[str]) -> str:
    rank = {name: k for k, name in enumerate(PREFERRED)}
    return min(bands, key=lambda name: (-bands[name], rank.get(name, len(rank)), name))
