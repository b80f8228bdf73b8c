"""Side files whose places are far from where the photos themselves say that they were taken."""

import math
from collections.abc import Callable, Sequence
from statistics import median

from skyquilt.errors import SideFileError

FAR_KM = 50.0
"""Distance of control points from all photos that no flight explains: another coordinate system, or
x and y swapped.
"""
_ELSEWHERE_KM = 1.0
"""Distance of positions in a side file from those in the photos that receivers do not explain."""
_NO_CAMERA_KM = 5.0
"""So near do all known mistakes of a file bring its positions, once they are undone."""
_KM_PER_DEGREE = 111.32
_UTM = (326, 327)
"""Hundreds of EPSG's codes of the UTM zones of WGS 84, north and south."""
_FEET = (3.15, 3.42)
"""Ratio of heights in feet to those in metres, with 4 % for the photos' own heights."""
_FEET_APART_M = 50.0

Place = tuple[float, float]
"""Latitude and longitude in degrees."""


def apart_km(a: Place, b: Place) -> float:
    """About the distance of two places."""
    turn = (a[1] - b[1] + 180) % 360 - 180
    shrink = math.cos(math.radians((a[0] + b[0]) / 2))
    return _KM_PER_DEGREE * math.hypot(a[0] - b[0], turn * shrink)


def check_positions(
    file: str, own: Sequence[Place], given: Sequence[Place], system: str = ""
) -> tuple[str, ...]:
    """A note where a side file places half of the photos or more elsewhere than they do themselves:
    `own` are their own places, `given` those of the file, which were in a coordinate `system` or in
    degrees.

    Raises:
        SideFileError: a mistake of the file explains it, which no camera makes.
    """
    every = list(zip(own, given, strict=True))
    pairs = [(a, b) for a, b in every if apart_km(a, b) > _ELSEWHERE_KM]
    if not pairs or 2 * len(pairs) < len(every):
        return ()
    away = median(apart_km(a, b) for a, b in pairs)
    which = "the photos" if len(pairs) == len(every) else f"{len(pairs)} of {len(every)} photos"
    where = f"{file} places {which} {away:,.0f} km from where their own metadata do (median)"
    zones = round(median((b[1] - a[1] + 180) % 360 - 180 for a, b in pairs) / 6)
    mistakes: dict[str, Callable[[Place], Place]] = {
        "latitude and longitude (or x and y) are exchanged": lambda b: (b[1], b[0]),
        "its degrees are radians": lambda b: (math.degrees(b[0]), math.degrees(b[1])),
        "its degrees are degrees and minutes": lambda b: (_of_minutes(b[0]), _of_minutes(b[1])),
        f"its UTM zone is {abs(zones)} too {'high' if zones > 0 else 'low'}": lambda b: (
            b[0],
            (b[1] - 6 * zones + 180) % 360 - 180,
        ),
    }
    for said, undone in (mistakes | (_mistakes_in(system) if system else {})).items():
        if median(apart_km(a, undone(b)) for a, b in pairs) < min(_NO_CAMERA_KM, away / 10):
            raise SideFileError(f"{where}: {said}. Correct the file.")
    return (
        f"{where}, and they are mapped where it says. Correct it if it is wrong: its coordinate"
        " system, hemispheres, or the flight that it belongs to.",
    )


def _mistakes_in(system: str) -> dict[str, Callable[[Place], Place]]:
    """Mistakes with the numbers of a projected coordinate system, by what is said of them."""
    from pyproj import CRS, Transformer  # few files lie elsewhere

    to_map = Transformer.from_crs(4326, system, always_xy=True).transform
    back = Transformer.from_crs(system, 4326, always_xy=True).transform

    def exchanged(place: Place) -> Place:
        x, y = to_map(place[1], place[0])
        longitude, latitude = back(y, x)
        return latitude, longitude

    mistakes: dict[str, Callable[[Place], Place]] = {
        "x and y (easting and northing) are exchanged": exchanged
    }
    code = CRS(system).to_epsg() or 0
    if code // 100 in _UTM:
        other = code + 100 if code // 100 == _UTM[0] else code - 100
        beyond = Transformer.from_crs(other, 4326, always_xy=True).transform

        def hemisphere(place: Place) -> Place:
            longitude, latitude = beyond(*to_map(place[1], place[0]))
            return latitude, longitude

        mistakes[f"its UTM zone is that of the other hemisphere (EPSG:{other} is right)"] = (
            hemisphere
        )
    return mistakes


def _of_minutes(value: float) -> float:
    """46.35988 read as 46 degrees and 35.988 minutes."""
    rest, whole = math.modf(value)
    return whole + rest * 100 / 60


def check_heights(file: str, own: Sequence[float], given: Sequence[float]) -> tuple[str, ...]:
    """A note where a side file's heights look like feet: `own` are the photos' heights in m from
    the same zero, `given` those of the file.
    """
    pairs = [(a, b) for a, b in zip(own, given, strict=True) if a > 0]
    ratios = sorted(b / a for a, b in pairs)
    some = ratios[len(ratios) // 4 : len(ratios) - len(ratios) // 4]
    if not some or not (_FEET[0] < some[0] and some[-1] < _FEET[1]):
        return ()
    if median(b - a for a, b in pairs) < _FEET_APART_M:
        return ()
    return (
        f"The heights in {file} are {median(ratios):.2f} times those in the photos: they may be in"
        " feet, and are taken as metres. Convert them to metres if so.",
    )
