"""FLIR's radiometric JPEG: the FFF block in APP1 segments, and Planck's law as FLIR parametrises
it.

Layout and radiometry follow the public descriptions of the format (record directory, raw image
record 1, camera record 0x20; radiance budget object, reflection, atmosphere, window).
"""

import io
import math
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import UnreadablePhotoError
from skyquilt.outside import check_picture
from skyquilt.photos.headers import APP1, JpegHeader

_PREFIX = b"FLIR\x00"
_RAW_IMAGE, _CAMERA = 1, 0x20
_ZERO_CELSIUS = 273.15
MOST_THERMAL_MP = 16.0
"""Largest area of a radiometric frame in megapixels; thermal sensors have 3 at most."""
_ROWS = 256
"""Rows converted at a time, since the formula needs many times the memory of the counts."""


@dataclass(frozen=True, kw_only=True)
class FlirCamera:
    """The radiometric constants of one frame; temperatures in K, distance in m, the others without
    unit.
    """

    planck_r1: float
    planck_b: float
    planck_f: float
    planck_o: float
    planck_r2: float
    emissivity: float = 1.0
    distance_m: float = 0.0
    reflected_k: float = 293.15
    atmosphere_k: float = 293.15
    window_k: float = 293.15
    window_transmission: float = 1.0
    humidity: float = 0.5
    alpha1: float = 0.0
    alpha2: float = 0.0
    beta1: float = 0.0
    beta2: float = 0.0
    x: float = 1.0

    def signal(self, kelvin: float) -> float:
        """Counts recorded for a black body of this temperature."""
        return self.planck_r1 / (
            self.planck_r2 * (math.exp(self.planck_b / kelvin) - self.planck_f)
        ) - (self.planck_o)

    @property
    def transmission(self) -> float:
        """Transmission of the air between object and camera, from humidity and distance."""
        t = self.atmosphere_k - _ZERO_CELSIUS
        water = self.humidity * math.exp(1.5587 + 0.06939 * t - 2.7816e-4 * t**2 + 6.8455e-7 * t**3)
        d, w = math.sqrt(max(self.distance_m, 0.0)), math.sqrt(max(water, 0.0))
        first = math.exp(-d * (self.alpha1 + self.beta1 * w))
        second = math.exp(-d * (self.alpha2 + self.beta2 * w))
        return self.x * first + (1 - self.x) * second

    def celsius(self, counts: NDArray[np.generic]) -> NDArray[np.float32]:
        """Object temperature in deg C, shape as given; NaN where the counts correspond to no
        radiance.
        """
        out = np.empty(counts.shape, np.float32)
        for row in range(0, len(counts), _ROWS):
            out[row : row + _ROWS] = self._celsius(counts[row : row + _ROWS])
        return out

    def _celsius(self, counts: NDArray[np.generic]) -> NDArray[np.float32]:
        tau, e, w = self.transmission, self.emissivity, self.window_transmission
        seen = (counts.astype(np.float64) - (1 - w) * self.signal(self.window_k)) / w
        seen -= (1 - tau) * self.signal(self.atmosphere_k) + (1 - e) * tau * self.signal(
            self.reflected_k
        )
        with np.errstate(all="ignore"):
            ratio = (
                self.planck_r1 / (self.planck_r2 * (seen / (e * tau) + self.planck_o))
                + self.planck_f
            )
            celsius = self.planck_b / np.log(ratio) - _ZERO_CELSIUS
        celsius[~np.isfinite(celsius) | (celsius < -_ZERO_CELSIUS)] = np.nan
        return celsius.astype(np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class FlirFrame:
    """Raw counts of one frame, and the constants to convert them to temperatures."""

    counts: NDArray[np.uint16]
    """(height, width)."""
    camera: FlirCamera | None
    """None where the file lacks the constants."""


def read_flir(jpeg: JpegHeader) -> FlirFrame | None:
    """The raw frame of a FLIR JPEG; None where there is none or it is broken.

    Raises:
        UnreadablePhotoError: the frame declares a size that is refused.
    """
    parts = [p for m, p in jpeg.segments if m == APP1 and p.startswith(_PREFIX) and len(p) > 8]
    block = b"".join(p[8:] for p in sorted(parts, key=lambda p: p[6]))
    if block[:4] not in (b"FFF\x00", b"AFF\x00"):
        return None
    try:
        records = _records(block)
        counts = _counts(records[_RAW_IMAGE])
        return FlirFrame(counts=counts, camera=_camera(records.get(_CAMERA, b"")))
    except UnreadablePhotoError:  # its declared size is refused
        raise
    except (
        Exception
    ):  # struct, Pillow and numpy raise many exceptions on bad data; all mean: no frame
        return None


def _records(block: bytes) -> dict[int, bytes]:
    order = next((o for o in "><" if 100 <= struct.unpack_from(o + "I", block, 0x14)[0] < 200), ">")
    start, count = struct.unpack_from(order + "II", block, 0x18)
    records: dict[int, bytes] = {}
    for i in range(min(count, 1000)):
        kind = struct.unpack_from(order + "H", block, start + 32 * i)[0]
        offset, length = struct.unpack_from(order + "II", block, start + 32 * i + 12)
        if kind:
            records.setdefault(kind, block[offset : offset + length])
    return records


def _order(record: bytes) -> str:
    """Byte order of a record: every record starts with the number 2 in its own byte order."""
    return "<" if record[:2] == b"\x02\x00" else ">"


def _counts(record: bytes) -> NDArray[np.uint16]:
    order = _order(record)
    width, height = struct.unpack_from(order + "HH", record, 2)
    check_picture(width, height, 2, most_mp=MOST_THERMAL_MP, option="")
    body = record[32:]
    if body.startswith(b"\x89PNG"):
        from PIL.PngImagePlugin import PngImageFile

        with PngImageFile(io.BytesIO(body)) as image:
            if image.size != (width, height) or not image.mode.startswith("I"):
                raise ValueError("its raw PNG is not a 16-bit image of the size in the record")
            swapped = np.asarray(image, dtype=np.uint16)
        return np.asarray(
            swapped.byteswap(), dtype=np.uint16
        )  # little-endian words in a big-endian format
    data = np.frombuffer(body, dtype=order + "u2", count=width * height)
    return np.asarray(data.reshape(height, width), dtype=np.uint16)


def _camera(record: bytes) -> FlirCamera | None:
    if len(record) < 0x310:
        return None
    order = _order(record)

    def real(offset: int) -> float:
        return float(struct.unpack_from(order + "f", record, offset)[0])

    r1, b, f, r2 = real(0x58), real(0x5C), real(0x60), real(0x30C)
    offset = float(struct.unpack_from(order + "i", record, 0x308)[0])
    if not (r1 > 0 and b > 0 and r2 > 0 and math.isfinite(r1 * b * f * r2)):
        return None
    humidity, window, emissivity = real(0x3C), real(0x34), real(0x20)
    camera = FlirCamera(
        planck_r1=r1,
        planck_b=b,
        planck_f=f,
        planck_o=offset,
        planck_r2=r2,
        emissivity=emissivity if 0.05 < emissivity <= 1 else 1.0,
        distance_m=_within(real(0x24), 0, 1e4, 0.0),
        reflected_k=_within(real(0x28), 150, 1000, 293.15),
        atmosphere_k=_within(real(0x2C), 150, 1000, 293.15),
        window_k=_within(real(0x30), 150, 1000, 293.15),
        window_transmission=window if 0.05 < window <= 1 else 1.0,
        humidity=_within(humidity / 100 if humidity > 2 else humidity, 0, 1, 0.5),
        alpha1=_within(real(0x70), -1, 1, 0.0),
        alpha2=_within(real(0x74), -1, 1, 0.0),
        beta1=_within(real(0x78), -1, 1, 0.0),
        beta2=_within(real(0x7C), -1, 1, 0.0),
        x=_within(real(0x80), -10, 10, 1.0),
    )
    return camera if _is_thermometer(camera) else None


def _is_thermometer(camera: FlirCamera) -> bool:
    """Whether the constants are plausible: more counts for higher temperatures, and air that
    transmits.
    """
    try:
        steps = [camera.signal(kelvin) for kelvin in (150.0, 250.0, 350.0, 1000.0)]
        return (
            steps == sorted(steps)
            and math.isfinite(sum(steps))
            and 0.05 < camera.transmission < 1.5
        )
    except ArithmeticError:
        return False


def _within(value: float, low: float, high: float, otherwise: float) -> float:
    return value if low <= value <= high else otherwise
