"""Simulates a flight over procedural terrain with known truth.

It imports no stage: an oracle must share no code with what it tests.
"""

from skyquilt.simulate.flight import Waypoint
from skyquilt.simulate.presets import PRESETS, preset
from skyquilt.simulate.run import Progress, prepare, simulate
from skyquilt.simulate.settings import FlightSettings
from skyquilt.simulate.strip import Strip, StripSettings, fly_strip

__all__ = [
    "PRESETS",
    "FlightSettings",
    "Progress",
    "Strip",
    "StripSettings",
    "Waypoint",
    "fly_strip",
    "prepare",
    "preset",
    "simulate",
]
