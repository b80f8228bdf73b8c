"""Radiometric thermal frames: the raw data, never the displayed palette."""

import re
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import UnreadablePhotoError
from skyquilt.model.photo import Stored
from skyquilt.outside import real
from skyquilt.photos.flir import read_flir
from skyquilt.photos.headers import APP3, JpegHeader
from skyquilt.photos.tags import Xmp

_DJI_SIZES = ((640, 512), (1280, 1024), (640, 480), (336, 256), (320, 256), (256, 192), (160, 120))
_CENTIKELVIN = (22_000, 42_000)
_DECIKELVIN = (2_200, 4_200)
_KELVIN = (220.0, 420.0)
_CELSIUS = (-60.0, 160.0)
_REFLECTANCE = (-0.1, 1.5)
_DECICELSIUS, _CENTICELSIUS = 600.0, 6000.0
_COLDEST, _HOTTEST = -273.15, 5000.0
"""Degrees Celsius between which anything on the ground is; what a frame states beyond is none."""
_COLD, _HOT = -150.0, 1500.0
"""Degrees Celsius between which the median of a frame is; beyond them its unit is another one."""
_FILLS = (-9999.0, -32768.0)
"""Values with which programs fill pixels that have none."""
_LARGEST = 1e9
"""Values beyond this are fillings, too."""
_KELVIN_PER = {"kelvin": 1.0, "decikelvin": 0.1, "centikelvin": 0.01}
_CELSIUS_PER = {"celsius": 1.0, "decicelsius": 0.1, "centicelsius": 0.01, "fahrenheit": 5 / 9}
_LEAST_PX = 80 * 60
"""Pixels of the smallest thermal sensors."""
UNSTATED = "no unit is stated (set it with --thermal-unit)"
"""Part of the note on a frame whose unit follows from its values."""
UNFIT = "fits no unit of temperature"
"""The same where none does."""
UNREAD = "It holds raw data in a form that is not read; its colours are."
"""Note on a JPEG with segments like those in which DJI keeps counts."""
STATED = "as stated by the file or --thermal-unit."
"""The end of the note on a frame whose unit is stated."""
_STATED = re.compile(
    r"""\bunit\s*[:=]\s*["']?([a-z]+)|role=["']unittype["'][^>]*>\s*([^<]+?)\s*<""", re.IGNORECASE
)
_SCALED = re.compile(
    r"""<Item(?=[^>]*\srole=["'](scale|offset)["'])(?=[^>]*\ssample=["']0["'])[^>]*>\s*([^<\s]+)""",
    re.IGNORECASE,
)
_WORDS: dict[str, Stored] = {
    "celsius": "celsius",
    "degc": "celsius",
    "c": "celsius",
    "\u00b0c": "celsius",
    "degreescelsius": "celsius",
    "kelvin": "kelvin",
    "k": "kelvin",
    "decikelvin": "decikelvin",
    "centikelvin": "centikelvin",
    "ck": "centikelvin",
    "decicelsius": "decicelsius",
    "centicelsius": "centicelsius",
    "fahrenheit": "fahrenheit",
    "degf": "fahrenheit",
    "f": "fahrenheit",
    "\u00b0f": "fahrenheit",
    "degreesfahrenheit": "fahrenheit",
    "counts": "counts",
    "dn": "counts",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class ThermalFrame:
    """One radiometric frame."""

    values: NDArray[np.float32]
    """(height, width) in `unit`; NaN where there is no measurement."""
    unit: Literal["celsius", "counts"]
    """What a value means."""
    note: str
    """A sentence on how the values were read."""
    stored: Stored = ""
    """What a value of a TIFF meant as stored."""


def thermal_frame_of_jpeg(jpeg: JpegHeader, *, make: str) -> ThermalFrame | None:
    """The radiometric frame inside a FLIR or DJI JPEG; None where there is none."""
    flir = read_flir(jpeg)
    if flir is not None and flir.camera is not None:
        note = (
            "Temperatures are computed with FLIR's constants and emissivity"
            f" {flir.camera.emissivity:.2f}."
        )
        return ThermalFrame(values=flir.camera.celsius(flir.counts), unit="celsius", note=note)
    if flir is not None:
        note = (
            "It is a FLIR frame without radiometric constants: values are counts, not temperatures."
        )
        return ThermalFrame(values=flir.counts.astype(np.float32), unit="counts", note=note)
    return _dji(jpeg) if "dji" in make.lower() else None


def _dji(jpeg: JpegHeader) -> ThermalFrame | None:
    """DJI's R-JPEG: the joined APP3 segments are width * height little-endian 16-bit counts,
    nothing else.
    """
    raw = jpeg.joined(APP3)
    sizes = ((jpeg.width, jpeg.height), *_DJI_SIZES)
    size = next((s for s in sizes if 2 * s[0] * s[1] == len(raw)), None)
    if size is None:
        return None
    counts = np.frombuffer(raw, dtype="<u2").reshape(size[1], size[0])
    note = (
        "It is a DJI radiometric frame: values are sensor counts, ordered as temperatures are; "
        "degrees need the manufacturer's library, and the palette contains no measurements."
    )
    return ThermalFrame(values=counts.astype(np.float32), unit="counts", note=note)


def has_raw_data(jpeg: JpegHeader) -> bool:
    """Whether a JPEG holds as many bytes beside its pixels, in APP3 segments, as counts of a small
    thermal sensor need.
    """
    return len(jpeg.joined(APP3)) >= 2 * _LEAST_PX


def stated_unit(text: str) -> Stored:
    """The unit named in a TIFF's description or in GDAL's metadata; empty where none is named."""
    found = _STATED.search(text)
    word = (found[1] or found[2]).lower().replace(" ", "") if found else ""
    return _WORDS.get(word, "")


def stated_scale(text: str) -> tuple[float, float] | None:
    """Scale and offset of the first band in GDAL's metadata: values in their unit are those stored
    times the scale plus the offset. None where neither is stated.
    """
    told = {m[1].lower(): real(m[2]) for m in _SCALED.finditer(text)}
    scale, offset = told.get("scale", 1.0), told.get("offset", 0.0)
    if scale is None or offset is None or not scale or (scale, offset) == (1.0, 0.0):
        return None
    return scale, offset


def linear_gain(xmp: Xmp) -> float | None:
    """Kelvins per count that FLIR's TIFFs state (`TlinearGain`: Duo Pro R, Vue Pro R, Zenmuse XT2);
    None where counts are not linear in temperature, or nothing is stated.
    """
    gain = xmp.number("TlinearGain")
    return gain if gain is not None and 0 < gain <= 1 else None


def thermal_frame_of_values(
    values: NDArray[np.generic], stored: Stored = "", kind: str = ""
) -> ThermalFrame:
    """Degrees Celsius from a single-band thermal TIFF whose values mean `stored`.

    Where the meaning is not stated, it is derived from the median value. Integers: hundredths or
    tenths of a kelvin, and if they have a sign also of a degree Celsius; real numbers: kelvin or
    degrees Celsius; otherwise counts. `kind`: type of the values in the file (`int16`), where they
    were converted. Infinite values, those with which programs fill gaps, and temperatures that
    there are not become NaN.

    Raises:
        UnreadablePhotoError: in the stated unit, most values are no temperatures.
    """
    kind = kind or values.dtype.name
    whole = kind.startswith(("int", "uint"))
    numbers = values.astype(np.float32)
    if kind.startswith("uint"):
        numbers[values == 0] = np.nan
    numbers[np.isin(numbers, _FILLS) | ~(np.abs(numbers) < _LARGEST)] = np.nan
    if stored:
        return _frame(numbers, stored, f"Its values are read as {stored}, {STATED}")
    finite = numbers[np.isfinite(numbers) & ((numbers != 0) | (not whole))]
    middle = float(np.median(finite)) if finite.size else float("nan")
    found = _likely(middle, whole=whole, signed=kind.startswith("int"))
    if found == "counts":
        words = f"{UNFIT}: values are counts, unless --thermal-unit states their unit."
        return _frame(numbers, found, f"Its median value {middle:g} {words}")
    frame = _frame(numbers, found, "")
    degrees = float(np.nanmedian(frame.values))
    words = f"fits {found}, {degrees:.1f} degrees Celsius; {UNSTATED}."
    return replace(frame, note=f"Its median value {middle:g} {words}")


def like_reflectance(values: NDArray[np.floating[Any]]) -> bool:
    """Whether real numbers are shares of light, or an index of such: nearly all lie between 0 and
    1, where temperatures of a whole frame hardly do.
    """
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [1, 99]) if finite.size else (np.nan, np.nan)
    return bool(_REFLECTANCE[0] <= low and high <= _REFLECTANCE[1])


def _likely(middle: float, *, whole: bool, signed: bool) -> Stored:
    """The unit in which a median value is a plausible temperature on Earth."""
    ranges: tuple[tuple[tuple[float, float], Stored], ...] = (
        ((_CENTIKELVIN, "centikelvin"), (_DECIKELVIN, "decikelvin"))
        if whole
        else ((_KELVIN, "kelvin"), (_CELSIUS, "celsius"))
    )
    if signed:
        more: tuple[tuple[tuple[float, float], Stored], ...] = (
            ((-_DECICELSIUS, _DECICELSIUS), "decicelsius"),
            ((-_CENTICELSIUS, _CENTICELSIUS), "centicelsius"),
        )
        ranges = (*ranges, *more)
    return next((unit for (low, high), unit in ranges if low <= middle <= high), "counts")


def _frame(numbers: NDArray[np.float32], stored: Stored, note: str) -> ThermalFrame:
    if stored == "counts":
        return ThermalFrame(values=numbers, unit="counts", note=note, stored=stored)
    if stored in _KELVIN_PER:
        numbers[numbers <= 0] = np.nan
        degrees = numbers * np.float32(_KELVIN_PER[stored]) - np.float32(273.15)
    else:
        zero = 32.0 if stored == "fahrenheit" else 0.0
        degrees = (numbers - np.float32(zero)) * np.float32(_CELSIUS_PER[stored])
    finite = degrees[np.isfinite(degrees)]
    middle = float(np.median(finite)) if finite.size else 0.0
    if not _COLD < middle < _HOT:
        raise UnreadablePhotoError(
            f"its values cannot be {stored}, as stated by the file or --thermal-unit: most would be"
            f" temperatures of {middle:.0f} degrees Celsius"
        )
    degrees[(degrees < _COLDEST) | (degrees > _HOTTEST)] = np.nan
    return ThermalFrame(values=degrees, unit="celsius", note=note, stored=stored)
