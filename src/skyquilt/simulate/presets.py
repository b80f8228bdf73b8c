"""Preset flights by name."""

from collections.abc import Callable

from skyquilt.errors import UsageError
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, FlightSettings, Reporting, Route, Thermal


def _default() -> FlightSettings:
    return FlightSettings()


def _demo() -> FlightSettings:
    return FlightSettings(lens=Lens().scaled(1120, 840), route=Route(photos=15, overlap=0.72))


def _strip() -> FlightSettings:
    return FlightSettings(
        route=Route(pattern="strip", photos=20), control=Control(points=0, checks=5)
    )


def _roundtrip() -> FlightSettings:
    return FlightSettings(
        route=Route(pattern="roundtrip", photos=40, overlap=0.60, lost=3),
        reporting=Reporting(focal_error=0.0),
        control=Control(points=0, checks=12),
    )


def _thermal() -> FlightSettings:
    return FlightSettings(route=Route(photos=20), thermal=Thermal())


def _drones() -> FlightSettings:
    return FlightSettings(route=Route(photos=48, drones=3))


PRESETS: dict[str, Callable[[], FlightSettings]] = {
    "default": _default,
    "demo": _demo,
    "strip": _strip,
    "roundtrip": _roundtrip,
    "thermal": _thermal,
    "drones": _drones,
}
"""Name -> settings: 40 photos in four lines; a small quick one; one line; once around with losses;
with a thermal flight; three drones at once with different clock errors.
"""


def preset(name: str) -> FlightSettings:
    """Settings by name; raises UsageError that lists the names."""
    if name not in PRESETS:
        raise UsageError(f"there is no preset '{name}'; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]()
