"""Heights of photos and control points above one zero: the ellipsoid, the geoid EGM96, take-off.

What a file calls `above sea level` is taken for a height above EGM96, as receivers compute it. A
drone's is often neither: the height of the take-off point, from one GPS fix or a pressure, plus the
barometer.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from skyquilt.errors import UsageError
from skyquilt.geometry.geoid import geoid_height
from skyquilt.model.photo import ControlPoint, Datum, GeoPosition, Photo

STEADY_M = 3.0
"""Largest robust deviation in m of the height of the take-off point, as photos imply it, for which
it is taken as one: more are several flights, or an altitude that drifts.
"""
VERTICAL_EPSG = {"egm96": 5773, "sea_level": 5773, "ellipsoid": 4979}
"""EPSG codes of vertical reference systems; of the three-dimensional one for the ellipsoid."""


def chosen_datum(
    photos: Sequence[Photo], control: Sequence[ControlPoint], asked: str | None, level: bool = False
) -> tuple[Datum, float | None]:
    """The datum of a map's heights, and the height of the take-off point above it where heights
    above take-off are converted. `level`: the method lays photos on level ground, for which
    heights above take-off are taken where there are any.

    Raises:
        UsageError: what the photos report cannot be converted to the datum asked for.
    """
    positions = [p.position for p in photos if p.position and p.position.altitude_m is not None]
    if asked is None:
        if level and any(p.takeoff_m is not None for p in positions):
            return "takeoff", None
        count = Counter(p.datum for p in positions)
        return (count.most_common(1)[0][0] if count else "unknown"), None
    datum = cast(Datum, asked)
    levelled = any(not c.check and c.z is not None for c in control)
    if datum == "takeoff":
        if levelled:
            raise UsageError(
                "--vertical-datum takeoff cannot be had with control points that have heights;"
                " leave it out, or mark them as check points"
            )
        if not any(p.takeoff_m is not None for p in positions):
            raise UsageError(
                "--vertical-datum takeoff needs heights above take-off, and no photo reports one;"
                " choose egm96 or ellipsoid, or leave it out"
            )
        return datum, None
    apart = [
        height - p.takeoff_m
        for p in positions
        if p.takeoff_m is not None and (height := absolute(p, datum)) is not None
    ]
    if not levelled and all(absolute(p, datum) is None for p in positions):
        raise UsageError(
            f"--vertical-datum {asked} needs heights above sea level or the ellipsoid, and no photo"
            " reports one; give them with --geo or control points with --gcp, or choose takeoff"
        )
    if not apart:
        return datum, None
    middle = float(np.median(apart))
    steady = 1.48 * float(np.median(np.abs(np.array(apart) - middle))) <= STEADY_M
    return datum, middle if steady else None


def absolute(position: GeoPosition, datum: Datum) -> float | None:
    """The height above the ellipsoid or the geoid in m; None where it was not measured."""
    above, ellipsoid = position.sea_level_m, position.ellipsoid_m
    if datum == "ellipsoid" and ellipsoid is not None:
        return ellipsoid
    if datum != "ellipsoid" and above is not None:
        return above
    known = above if datum == "ellipsoid" else ellipsoid
    if known is None:
        return None
    sign = 1 if datum == "ellipsoid" else -1
    return known + sign * float(geoid_height(position.latitude_deg, position.longitude_deg))


def height_above(position: GeoPosition, datum: Datum, takeoff_m: float | None) -> float:
    """A photo's height above a map's datum in m; NaN if it contains none.

    `takeoff_m`: height of the take-off point above the datum. With it, a height above take-off is
    preferred to one of a plain GPS: within a flight a barometer is the more precise.
    """
    if position.altitude_m is not None and position.datum == datum:
        return float(position.altitude_m)
    if datum in ("takeoff", "unknown", "control"):
        return np.nan if position.takeoff_m is None or datum != "takeoff" else position.takeoff_m
    if takeoff_m is not None and position.takeoff_m is not None and position.datum != "ellipsoid":
        return position.takeoff_m + takeoff_m
    height = absolute(position, datum)
    return np.nan if height is None else height


def control_datum(control: Sequence[ControlPoint], asked: str | None, datum: Datum) -> Datum:
    """What the heights of control points are converted to, and a map's count from where they hold
    it: the datum asked for, else the one that all of them state; for check points that of the map.
    """
    if asked in ("egm96", "ellipsoid"):
        return cast(Datum, asked)
    stated = {c.datum for c in control if c.z is not None and not c.check}
    if not stated:
        return "egm96" if datum == "sea_level" else datum
    return stated.pop() if len(stated) == 1 else "control"


def control_height(point: ControlPoint, datum: Datum, longitude: float, latitude: float) -> float:
    """The height of a control point above a map's datum in m; NaN where it has none. Heights whose
    datum is not stated are left as they are.
    """
    if point.z is None:
        return np.nan
    if point.datum == datum or {point.datum, datum} != {"egm96", "ellipsoid"}:
        return point.z
    return point.z + (1 if datum == "ellipsoid" else -1) * float(geoid_height(latitude, longitude))


def height_figures(
    photos: Sequence[Photo], control: Sequence[ControlPoint], datum: Datum
) -> dict[str, Any]:
    """What files claim about heights, for reports: `claimed` (number of photos by datum),
    `geoid_m` (EGM96 above the ellipsoid at the survey), `vertical_crs`, and `trust`, sentences.
    """
    positions = [p.position for p in photos if p.position is not None]
    claims = {
        "takeoff": [p.takeoff_m for p in positions if p.takeoff_m is not None],
        "sea_level": [p.sea_level_m for p in positions if p.sea_level_m is not None],
        "ellipsoid": [p.ellipsoid_m for p in positions if p.ellipsoid_m is not None],
    }
    code = VERTICAL_EPSG.get(datum)
    geoid = None
    if positions:
        place = np.median([(p.latitude_deg, p.longitude_deg) for p in positions], axis=0)
        geoid = round(float(geoid_height(*place)), 2)
    return {
        "datum": datum,
        "vertical_crs": None if code is None else f"EPSG:{code}",
        "claimed": {name: len(values) for name, values in claims.items() if values},
        "control": sorted({c.datum for c in control if c.z is not None}),
        "geoid_m": geoid,
        "trust": _trust(positions, datum),
    }


def _trust(positions: Sequence[GeoPosition], datum: Datum) -> list[str]:
    """How far the heights can be trusted."""
    said = []
    plain = [p for p in positions if p.sea_level_m is not None and p.ellipsoid_m is None]
    both = [p.sea_level_m - p.takeoff_m for p in plain if p.sea_level_m and p.takeoff_m is not None]
    if datum in ("egm96", "ellipsoid", "sea_level") and plain:
        said.append(
            f"{len(plain)} photos state a height above sea level. It is taken for one above EGM96;"
            " a drone's is often neither, but that of the take-off point, known to 10 m or worse,"
            " plus the barometer's."
        )
    if len(both) > 1:
        said.append(
            f"By these heights the take-off point lies at {np.median(both):.1f} m (from"
            f" {min(both):.1f} to {max(both):.1f} m by single photos)."
        )
    if datum in ("egm96", "sea_level"):
        said.append("EGM96 itself is accurate to 0.5 to 1 m; a national geoid is to centimetres.")
    if datum == "control":
        said.append(
            "The control points state no height datum; heights are in theirs, whatever it is."
        )
    return said
