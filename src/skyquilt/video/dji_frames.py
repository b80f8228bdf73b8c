"""DJI's telemetry in a clip (a track of `djmd`): one message a frame, in Protocol Buffers.

DJI publishes no description. Numbers of fields are those that ExifTool documents (tags of DJI, its
version 13): of the Mavic 3, Matrice 30 and Mini 4 Pro the place is 3-3-4, of the Avata 2 and Neo
3-4-4, of the Osmo Action 4 and 5 3-4-2. It holds latitude and longitude (1-2 and 1-3, degrees where
1-1 is 1, otherwise radians) and the height above sea level (2, mm); beside it stand the height
above take-off (5-1, mm) and the aircraft's angles (3, tenths of a degree), and the gimbal's in
3-4-3.
"""

import math
import struct
from collections.abc import Iterator

from skyquilt.video.fixes import Fix

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5
_FRAME = 3
_PLACES = (3, 4), (4, 4), (4, 2)
"""Fields of a frame, and of these, that hold a place."""
_OF_AIRCRAFT, _BESIDE_GIMBAL = 4, 3
"""Which of these stand beside the aircraft's height and angles, and before the gimbal's group."""
_ANGLES = 3

_Fields = dict[int, "int | float | bytes"]


def dji_fix(message: bytes, time: float) -> Fix | None:
    """What a message of a frame says; None where it holds no place, or is damaged."""
    try:
        frame = _inside(dict(_fields(message)), _FRAME)
    except ValueError:
        return None
    for group, which in _PLACES:
        around = _inside(frame, group)
        held = _inside(around, which)
        latitude, longitude = _place(_inside(held, 1))
        if not (abs(latitude) <= 90 and abs(longitude) <= 180):
            continue
        aircraft = which == _OF_AIRCRAFT
        drone = _inside(around, _ANGLES) if aircraft else {}
        gimbal = _inside(_inside(frame, group + 1), _ANGLES) if group == _BESIDE_GIMBAL else {}
        takeoff = _inside(around, which + 1).get(1) if aircraft else None
        return Fix(
            time_s=time,
            latitude_deg=latitude,
            longitude_deg=longitude,
            sea_level_m=_signed(held, 2) / 1000 if 2 in held else math.nan,
            takeoff_m=takeoff / 1000 if isinstance(takeoff, float) else math.nan,
            gimbal_deg=(_tenths(gimbal, 3), _tenths(gimbal, 1), _tenths(gimbal, 2)),
            flight_yaw_deg=_tenths(drone, 3),
        )
    return None


def _place(fields: _Fields) -> tuple[float, float]:
    """Latitude and longitude in degrees; NaN where there is none."""
    latitude, longitude = fields.get(2), fields.get(3)
    if not isinstance(latitude, float) or not isinstance(longitude, float):
        return math.nan, math.nan
    if fields.get(1) == 1:
        return latitude, longitude
    return math.degrees(latitude), math.degrees(longitude)


def _tenths(fields: _Fields, number: int) -> float:
    """An angle in degrees of a message that is there; NaN where it is not."""
    return _signed(fields, number) / 10 if fields else math.nan


def _signed(fields: _Fields, number: int) -> float:
    """A signed integer of 64 bits; a 0 is left out of messages."""
    value = fields.get(number, 0)
    if not isinstance(value, int):
        return math.nan
    return float(value - (1 << 64) if value >> 63 else value)


def _inside(fields: _Fields, number: int) -> _Fields:
    """The message in a field; empty where there is none."""
    value = fields.get(number)
    try:
        return dict(_fields(value)) if isinstance(value, bytes) else {}
    except ValueError:
        return {}


def _fields(data: bytes) -> Iterator[tuple[int, "int | float | bytes"]]:
    """Numbers and values of the fields of a message; raises `ValueError` where it is none."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind == _VARINT:
            value, at = _varint(data, at)
            yield tag >> 3, value
            continue
        length = {_EIGHT: 8, _FOUR: 4}.get(kind)
        if kind == _BYTES:
            length, at = _varint(data, at)
        if length is None or at + length > len(data):
            raise ValueError("no message of Protocol Buffers")
        body = data[at : at + length]
        at += length
        if kind == _BYTES:
            yield tag >> 3, body
        else:
            yield tag >> 3, struct.unpack("<d" if kind == _EIGHT else "<f", body)[0]


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """An integer of up to 64 bits, and where it ends."""
    value = 0
    for k, byte in enumerate(data[at : at + 10]):
        value |= (byte & 0x7F) << 7 * k
        if byte < 0x80:
            return value & (1 << 64) - 1, at + k + 1
    raise ValueError("no integer")
