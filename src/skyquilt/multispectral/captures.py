"""The files of a multispectral camera, by band and by the capture that they belong to."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from skyquilt.errors import UnreadablePhotoError
from skyquilt.model.bands import canonical
from skyquilt.model.photo import Photo
from skyquilt.multispectral.reflectance import KINDS, Kind, Reflectance, smoothed_irradiance
from skyquilt.photos.band_tags import BandTags, read_band_tags
from skyquilt.photos.together import SECONDS, clocks, nearest_in_time, taken_together, whole_seconds

THERMAL = "lwir"
"""The band of temperatures, which says nothing of reflectance."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BandFiles:
    """The files of one band."""

    name: str
    """Its name, one of `model.bands.canonical` where it is known."""
    photos: tuple[Photo, ...]
    """Its files."""
    tags: tuple[BandTags, ...]
    """What each tells of itself."""
    converts: tuple[Reflectance, ...] = field(default=())
    """How the counts of each become values."""

    @cached_property
    def wavelength_nm(self) -> float | None:
        """Wavelength at its centre in nm; None where no file tells it."""
        told = [t.wavelength_nm for t in self.tags if t.wavelength_nm is not None]
        return float(np.median(told)) if told else None

    @property
    def order(self) -> tuple[float, str]:
        """Its place among the bands: by wavelength, usual ones where no file tells it."""
        return self.wavelength_nm or _USUAL.get(self.name, 1e9), self.name

    def only(self, kept: Sequence[int]) -> "BandFiles":
        """The band with these of its files."""
        return replace(
            self,
            photos=tuple(self.photos[j] for j in kept),
            tags=tuple(self.tags[j] for j in kept),
            converts=tuple(self.converts[j] for j in kept),
        )

    def as_kind(self, kind: Kind) -> "BandFiles":
        """The band with values of a weaker kind, save for files whose kind is weaker still."""
        return replace(
            self,
            converts=tuple(c.as_kind(min(kind, c.kind, key=KINDS.index)) for c in self.converts),
        )


def bands_of_files(photos: Sequence[Photo]) -> tuple[BandFiles, ...]:
    """The bands that files show, in order of wavelength. The irradiance of each photo is that of
    the sun sensor, smoothed over the flight.
    """
    named: dict[str, list[tuple[Photo, BandTags]]] = {}
    for photo in photos:
        tags = tags_of(photo)
        name = canonical(photo.band_name or tags.name, tags.wavelength_nm)
        named.setdefault(name or "band", []).append((photo, tags))
    found = [
        BandFiles(
            name=name,
            photos=tuple(p for p, _ in files),
            tags=tuple(t for _, t in files),
            converts=_converting(files),
        )
        for name, files in named.items()
    ]
    return tuple(sorted(found, key=lambda b: b.order))


_USUAL = {
    "blue": 475.0,
    "green": 560.0,
    "red": 668.0,
    "red edge": 717.0,
    "nir": 842.0,
    "panchro": 635.0,
    THERMAL: 11_000.0,
}
"""Usual wavelengths in nm, for the order of bands that tell none."""


def tags_of(photo: Photo) -> BandTags:
    """What a file tells of its band; only the name where it cannot be read any more."""
    try:
        return read_band_tags(photo.path)
    except (UnreadablePhotoError, OSError):  # it is lost or damaged: told when it is drawn
        return BandTags(name=photo.band_name)


def _converting(files: Sequence[tuple[Photo, BandTags]]) -> tuple[Reflectance, ...]:
    """How each file's counts become values, with the irradiance smoothed over the flight."""
    found = [Reflectance.of(tags, photo.width, photo.height) for photo, tags in files]
    read = np.array([np.nan if c.irradiance is None else c.irradiance for c in found])
    smooth = smoothed_irradiance(clocks([photo for photo, _ in files]), read)
    return tuple(
        c if np.isnan(light) else c.with_irradiance(float(light))
        for c, light in zip(found, smooth, strict=True)
    )


def captured_together(
    photos: Sequence[Photo], captures: Sequence[str], band: BandFiles
) -> dict[int, int]:
    """Index of the map's photo -> index of the band's file of the same capture: by what files tell
    of their capture, else by their times and names. `captures`: what the map's photos tell.
    """
    known = {capture: i for i, capture in enumerate(captures) if capture}
    found: dict[int, int] = {}
    for j, tags in enumerate(band.tags):
        if tags.capture in known:
            found.setdefault(known[tags.capture], j)
    for rule in (_at_once, taken_together, _same_second):
        left_a = [i for i in range(len(photos)) if i not in found]
        taken = set(found.values())
        left_b = [j for j in range(len(band.photos)) if j not in taken]
        pairs = rule([photos[i] for i in left_a], [band.photos[j] for j in left_b])
        found |= {left_a[i]: left_b[j] for i, j in pairs}
    return found


def _at_once(a: Sequence[Photo], b: Sequence[Photo]) -> list[tuple[int, int]]:
    """Files of one time: the cameras of a rig have one clock, and numbers in names may be those of
    another capture where files were lost.
    """
    return nearest_in_time(a, b, SECONDS)


def _same_second(a: Sequence[Photo], b: Sequence[Photo]) -> list[tuple[int, int]]:
    """Files less than a second apart, where the times of either camera are whole seconds."""
    return nearest_in_time(a, b, 1.0) if whole_seconds(a) or whole_seconds(b) else []
