"""Colours and temperatures of surface materials in summer and winter."""

from dataclasses import dataclass

import numpy as np

from skyquilt.simulate.grid import Floats
from skyquilt.simulate.weather import Weather

Colour = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class Material:
    """One kind of surface."""

    summer: Colour
    """Red, green, blue, 0-255, in direct sunlight on level ground."""
    winter: Colour
    """The same in winter."""
    day_k: float
    """Temperature above the air when fully heated by the sun, K."""
    night_k: float
    """Temperature above the air before sunrise, K."""

    def look(self, weather: Weather) -> Floats:
        """(4,) red, green, blue, and temperature in degrees Celsius."""
        rgb = self.summer if weather.season == "summer" else self.winter
        excess = weather.warmth * self.day_k + (1 - weather.warmth) * self.night_k
        return np.array([*rgb, weather.air_c + excess], dtype=np.float32)


def _m(summer: Colour, winter: Colour, day_k: float, night_k: float) -> Material:
    return Material(summer=summer, winter=winter, day_k=day_k, night_k=night_k)


MEADOW = _m((114, 128, 80), (138, 130, 92), 5, -3)
LAWN = _m((112, 130, 78), (124, 126, 84), 3, -3)
CROP = _m((96, 120, 72), (112, 106, 78), 4, -2)
WHEAT = _m((188, 168, 108), (120, 98, 74), 8, -2)
MAIZE = _m((84, 110, 60), (150, 134, 102), 2, -1)
STUBBLE = _m((182, 160, 116), (150, 134, 108), 11, -3)
BARE = _m((150, 122, 96), (110, 92, 76), 14, 0)
WOOD_FLOOR = _m((84, 80, 56), (104, 92, 72), -2, 1)
TREE = _m((72, 94, 56), (112, 98, 80), -3, 1)
CONIFER = _m((46, 74, 46), (44, 66, 46), -3, 1.5)
BUSH = _m((74, 104, 52), (108, 98, 74), -2, 1)
SAND = _m((206, 190, 158), (232, 234, 238), 12, -4)
PANEL = _m((40, 50, 80), (38, 46, 74), 27, -6)
FRAME = _m((176, 178, 182), (172, 174, 178), 20, -5)
WATER = _m((56, 78, 76), (60, 74, 82), -8, 6)
REED = _m((128, 134, 80), (160, 144, 104), 1, 1)
ASPHALT = _m((122, 122, 124), (116, 116, 120), 18, 5)
GRAVEL = _m((176, 166, 146), (162, 154, 140), 12, 1)
PAVING = _m((168, 162, 154), (158, 154, 150), 14, 3)
PAINT = _m((228, 228, 222), (220, 220, 216), 10, 3)
WALL = _m((206, 198, 184), (198, 192, 182), 8, 4)
GUTTER = _m((122, 116, 110), (118, 112, 108), 12, -1)
TARGET_WHITE = _m((250, 250, 250), (250, 250, 250), 3, -2)
TARGET_BLACK = _m((18, 18, 20), (18, 18, 20), 20, 0)
ROOFS = (
    _m((170, 92, 68), (158, 88, 68), 22, -4),
    _m((146, 74, 58), (138, 72, 58), 23, -4),
    _m((120, 104, 96), (116, 102, 96), 24, -4),
    _m((92, 94, 100), (92, 94, 100), 26, -5),
    _m((186, 180, 170), (180, 176, 168), 14, -5),
)
CARS = (
    _m((196, 40, 40), (180, 40, 40), 20, -2),
    _m((236, 236, 236), (228, 228, 228), 12, -3),
    _m((44, 46, 52), (44, 46, 52), 26, -2),
    _m((60, 92, 160), (58, 88, 150), 20, -2),
    _m((150, 152, 156), (148, 150, 154), 18, -3),
)
