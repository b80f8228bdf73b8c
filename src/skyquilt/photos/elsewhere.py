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


def check_positions(file: str, own: Sequence[Place], given: Sequence[Place]) -> tuple[str, ...]:
    """A note where a side file places photos elsewhere than they do themselves: `own` are their own
    places, `given` those of the file.

    Raises:
        SideFileError: a mistake of the file explains it, which no camera makes.
    """
    pairs = list(zip(own, given, strict=True))
    if not pairs or (away := median(apart_km(a, b) for a, b in pairs)) <= _ELSEWHERE_KM:
        return ()
    where = f"{file} places the photos {away:,.0f} km from where their own metadata do (median)"
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
    for said, undone in mistakes.items():
        if median(apart_km(a, undone(b)) for a, b in pairs) < min(_NO_CAMERA_KM, away / 10):
            raise SideFileError(f"{where}: {said}. Correct the file.")
    return (
        f"{where}, and they are mapped where it says. Correct it if it is wrong: its coordinate"
        " system, hemispheres, or the flight that it belongs to.",
    )


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
