"""What can be said of a survey as a whole."""

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise

from skyquilt.model.photo import Photo
from skyquilt.photos.side_rows import sentence_of

_LONG_GAP_H = 12.0


def survey_notes(photos: Sequence[Photo], copies: int = 0) -> tuple[str, ...]:
    """Plain sentences: several cameras or bands, rolling shutters, clocks, what most photos
    lack.
    """
    return (
        *_cameras(photos),
        *_thermal_units(photos),
        *_gaps(photos),
        *_clocks(photos),
        *_copies(copies),
    )


def _cameras(photos: Sequence[Photo]) -> Iterator[str]:
    keys = Counter(p.camera_key for p in photos)
    if len(keys) > 1:
        listed = sentence_of([f"{key} ({n})" for key, n in keys.items()])
        yield f"There are {len(keys)} cameras: {listed}; each is calibrated by itself."
    bands = Counter(p.band for p in photos)
    if len(bands) > 1:
        counts = " and ".join(f"{n} {band}" for band, n in sorted(bands.items()))
        yield f"The spectra are mixed: {counts} photos."
    rolling = sorted({p.camera_key for p in photos if p.rolling_shutter})
    if rolling:
        yield f"Rolling (electronic) shutter, not modelled: {sentence_of(rolling)}."


def _thermal_units(photos: Sequence[Photo]) -> Iterator[str]:
    units = Counter(p.stored for p in photos if p.stored)
    listed = " and ".join(f"{n} as {unit}" for unit, n in units.most_common())
    if len(units) > 1:
        yield (
            f"Thermal TIFFs are read in different units, {listed}; --thermal-unit says which is"
            " right for all."
        )
    elif units:
        yield f"Thermal TIFFs are read as {listed.split(' as ')[1]} ({sum(units.values())})."


def _gaps(photos: Sequence[Photo]) -> Iterator[str]:
    void = [p.name for p in photos if p.position is None]
    if void:
        which = (
            "No photo carries"
            if len(void) == len(photos)
            else f"{len(void)} of {len(photos)} photos lack"
        )
        yield f"{which} a usable GPS position" + (
            f": {sentence_of(void)}." if len(void) < len(photos) else "."
        )
    if all(p.attitude is None for p in photos):
        yield "No photo carries camera angles."
    guessed = sorted({p.camera_key for p in photos if p.focal.source == "guess"})
    if guessed:
        yield f"The focal length is guessed for {sentence_of(guessed)}."
    edited = [p.name for p in photos if p.editor]
    if edited:
        yield f"{len(edited)} photos were rewritten by another program: {sentence_of(edited)}."


def _clocks(photos: Sequence[Photo]) -> Iterator[str]:
    timeless = [p.name for p in photos if p.time is None]
    if timeless and len(timeless) < len(photos):
        yield f"Without a capture time, put last: {sentence_of(timeless)}."
    times = sorted(p.time.replace(tzinfo=None) for p in photos if p.time)
    gap = max(((b - a).total_seconds() / 3600 for a, b in pairwise(times)), default=0.0)
    if gap > _LONG_GAP_H:
        yield (
            f"The capture times have a gap of {gap:.0f} h: several flights, or clocks that"
            " disagree."
        )


def _copies(copies: int) -> tuple[str, ...]:
    return (f"{copies} files are copies of others and were left out.",) if copies else ()
