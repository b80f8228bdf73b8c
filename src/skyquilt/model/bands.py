"""Names of the bands of multispectral cameras."""

import re

_NAMES = {
    "blue": ("blue",),
    "green": ("green", "gre"),
    "red": ("red",),
    "red edge": ("rededge", "edge", "re", "reg"),
    "nir": ("nir", "nearinfrared", "nearir"),
    "panchro": ("panchro", "panchromatic", "pan"),
    "lwir": ("lwir", "thermal", "thermalinfrared"),
}
_SPELLINGS = {spelling: name for name, spellings in _NAMES.items() for spelling in spellings}
_RANGES = {
    "blue": (430.0, 510.0),
    "green": (520.0, 590.0),
    "red": (610.0, 690.0),
    "red edge": (695.0, 760.0),
    "nir": (770.0, 1000.0),
    "lwir": (7000.0, 15_000.0),
}
"""Wavelengths in nm at the centre of bands that have no name."""


def canonical(name: str, wavelength_nm: float | None = None) -> str:
    """One of blue, green, red, red edge, nir, panchro and lwir, however a maker spells it, and from
    the wavelength where there is no name; else the name (a camera's second blue is `blue-444`).
    """
    spelling = re.sub(r"[^a-z0-9]", "", name.lower())
    if found := _SPELLINGS.get(spelling):
        return found
    if name.strip() or wavelength_nm is None:
        return name
    return next((n for n, (a, b) in _RANGES.items() if a <= wavelength_nm <= b), name)
