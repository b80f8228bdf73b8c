"""Radiometric thermal frames: raw data, never the palette."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from skyquilt.photos.flir import read_flir
from skyquilt.photos.jpeg import APP3, JpegHeader

_DJI_SIZES = ((640, 512), (1280, 1024), (640, 480), (336, 256), (320, 256), (256, 192), (160, 120))
_CENTIKELVIN = (22_000, 42_000)
_DECIKELVIN = (2_200, 4_200)
_KELVIN = (220.0, 420.0)
_CELSIUS = (-60.0, 160.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class ThermalFrame:
    """One radiometric frame."""

    values: NDArray[np.float32]
    """(height, width) in `unit`; NaN where there is no measurement."""
    unit: Literal["celsius", "counts"]
    """What a value means."""
    note: str
    """A sentence on how the values were read."""


def thermal_frame_of_jpeg(jpeg: JpegHeader, *, make: str) -> ThermalFrame | None:
    """The radiometric frame inside a FLIR or DJI JPEG; None where there is none."""
    flir = read_flir(jpeg)
    if flir is not None and flir.camera is not None:
        note = f"Temperatures follow from FLIR's constants with emissivity {flir.camera.emissivity:.2f}."
        return ThermalFrame(values=flir.camera.celsius(flir.counts), unit="celsius", note=note)
    if flir is not None:
        note = "It is a FLIR frame without radiometric constants: values are counts, no temperatures."
        return ThermalFrame(values=flir.counts.astype(np.float32), unit="counts", note=note)
    return _dji(jpeg) if "dji" in make.lower() else None


def _dji(jpeg: JpegHeader) -> ThermalFrame | None:
    """DJI's R-JPEG: the joined APP3 segments are width * height little-endian 16-bit counts, nothing else."""
    raw = jpeg.joined(APP3)
    sizes = ((jpeg.width, jpeg.height), *_DJI_SIZES)
    size = next((s for s in sizes if 2 * s[0] * s[1] == len(raw)), None)
    if size is None:
        return None
    counts = np.frombuffer(raw, dtype="<u2").reshape(size[1], size[0])
    note = (
        "It is a DJI radiometric frame: values are sensor counts, ordered as temperatures are; "
        "degrees need the maker's own library, and the palette is no measurement."
    )
    return ThermalFrame(values=counts.astype(np.float32), unit="counts", note=note)


def thermal_frame_of_values(values: NDArray[np.generic]) -> ThermalFrame:
    """Degrees Celsius from a single-band thermal TIFF, its unit guessed from the median value.

    Whole numbers: hundredths or tenths of a kelvin; real numbers: kelvin or degrees Celsius; else counts.
    """
    real = values.astype(np.float32)
    whole = values.dtype.kind in "iu"
    if whole:
        real[values == 0] = np.nan
    finite = real[np.isfinite(real)]
    middle = float(np.median(finite)) if finite.size else float("nan")
    steps = ((_CENTIKELVIN, 0.01), (_DECIKELVIN, 0.1)) if whole else ((_KELVIN, 1.0),)
    for (low, high), kelvin in steps:
        if low <= middle <= high:
            note = (
                f"Its median value {middle:g} reads as {kelvin:g} K per unit; temperatures follow from that."
            )
            return ThermalFrame(
                values=real * np.float32(kelvin) - np.float32(273.15), unit="celsius", note=note
            )
    if not whole and _CELSIUS[0] <= middle <= _CELSIUS[1]:
        return ThermalFrame(values=real, unit="celsius", note=f"Its median value {middle:g} reads as deg C.")
    note = f"Its median value {middle:g} fits no unit of temperature: values are counts."
    return ThermalFrame(values=real, unit="counts", note=note)
