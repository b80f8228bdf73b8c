"""What a file of a multispectral camera tells of its band, and of how its counts came about.

Names and units of the tags are those of MicaSense's "RedEdge Camera Radiometric Calibration Model",
of DJI's "P4 Multispectral Image Processing Guide" and "Mavic 3M Image Processing Guide", of
Parrot's application note SEQ-AN-01 for the Sequoia and its description of the list of irradiances,
and of Pix4D's "Specifications of xmp.camera tags".
"""

import base64
import math
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from skyquilt.model.bands import canonical
from skyquilt.outside import MOST_MP, plain, real, whole
from skyquilt.photos import tags as tag
from skyquilt.photos.headers import Header, read_header
from skyquilt.photos.tags import Xmp, as_number

SUN = 3.0
"""More than the sun gives, in W/m2/nm: at the top of the atmosphere it is 2.1 at most."""
_WAVELENGTH, _WIDTH = (200.0, 20_000.0), (0.5, 15_000.0)
_EXPOSURE_S, _GAIN, _APERTURE = (1e-7, 60.0), (1e-3, 1e4), (0.3, 100.0)
_REFLECTANCE = (0.01, 1.2)
_LEAST, _MOST = 1e-9, 1e9
"""Limits of numbers whose unit is the maker's own."""
_MOST_TERMS, _MOST_POWER, _MOST_RADIAL = 64, 8, 8
"""Largest number of terms of a polynomial in columns and rows, its largest exponent, and the
largest number of terms of a radial one."""
_WRONG_EXPOSURE, _RIGHT_EXPOSURE = 1 / 6329, 0.000274
"""Exposure time in s that early RedEdges write, and the true one (MicaSense's own correction)."""
_EARLY = ("rededge", "rededge-m")
_TRUSTED = {"altum": (1, 2, 3), "rededge": (5, 1, 7), "rededge-m": (5, 1, 7)}
"""First firmware of a camera whose irradiance of a level surface is right (MicaSense)."""
_MICROWATT = 0.01
"""W/m2/nm of 1 uW/cm2/nm."""
_READING = struct.Struct("<QHHHHfff")
"""A reading of the Sequoia's sun sensor: time in us, two channels, index of the gain, integration
time in ms, yaw, pitch, roll."""
_FULL = 65535
"""A channel that is saturated."""
_USUAL_GAIN = 1
_BAND = re.compile(r"(\d{2,5}(?:\.\d{1,6})?)\s?(?:\(\s?)?(?:\+/-|\+-|±)\s?(\d{1,4}(?:\.\d{1,6})?)")
"""DJI's `BandFreq`, such as `560(+/-16)nm`."""


@dataclass(frozen=True, kw_only=True)
class Vignetting:
    """How the light falls off towards the edges of a frame, as a polynomial of the pixel."""

    coefficients: tuple[float, ...]
    """Of a radial one those of r, r^2, ..., after the constant 1; of another those of `powers`."""
    centre: tuple[float, float] | None = None
    """Column and row in px from the centre of the first pixel from which r is counted in px; None
    where the polynomial is one of columns and rows, as shares of the width and the height."""
    powers: tuple[tuple[int, int], ...] = ()
    """Exponents of column and row of each coefficient, where there is no centre."""
    corrects: bool = False
    """Whether counts are multiplied by it, as DJI's are; else it is the share of the light that
    arrives, and they are divided by it."""


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A panel of known reflectance in the picture."""

    reflectance: float
    """Its reflectance in the file's band."""
    corners: tuple[tuple[float, float], ...]
    """Column and row in px of its four corners, from the centre of the first pixel."""


@dataclass(frozen=True, kw_only=True)
class BandTags:
    """What one file tells; None or empty where it tells nothing, or nothing that can be meant."""

    name: str = ""
    """The band's name as its file has it, in lower case."""
    wavelength_nm: float | None = None
    """Wavelength at its centre in nm."""
    width_nm: float | None = None
    """Its full width at half maximum in nm."""
    capture: str = ""
    """What all files of one trigger share."""
    index: int | None = None
    """Number of the camera in its rig."""
    black_level: float | None = None
    """Count without light."""
    bits: int | None = None
    """Bits of a count in the file."""
    exposure_s: float | None = None
    """Exposure time in s."""
    gain: float | None = None
    """Gain of the detector: ISO / 100, or DJI's `SensorGain`."""
    gain_adjustment: float | None = None
    """DJI's factor that makes bands comparable."""
    f_number: float | None = None
    """Focal length over aperture."""
    radiometric: tuple[float, float, float] | None = None
    """MicaSense's a1 (W/m2/sr/nm s), a2 (s per row) and a3 (per row)."""
    sensor_model: tuple[float, float, float] | None = None
    """Parrot's A, B and C."""
    vignetting: Vignetting | None = None
    """The fall-off of light."""
    irradiance: float | None = None
    """Of the sun sensor when the photo was taken, greater than 0."""
    irradiance_si: bool = False
    """Whether it is in W/m2/nm; else its unit is the maker's own."""
    normalised: bool = False
    """Whether its values are corrected already: it says so, or they are real numbers."""
    panel: Panel | None = None
    """A panel that the camera recognised (MicaSense)."""
    notes: tuple[str, ...] = ()
    """Sentences on what was ignored."""


def read_band_tags(path: Path, *, most_mp: float = MOST_MP) -> BandTags:
    """What a file tells of its band. Values that cannot be meant are ignored, and named in `notes`.

    Raises:
        UnreadablePhotoError: it is no photo, or larger than `most_mp` megapixels.
    """
    return band_tags(read_header(path, most_mp=most_mp))


def band_tags(header: Header) -> BandTags:
    """The same of a header that was read."""
    said = _Said(header)
    wavelength, width = said.band()
    bits = said.bits()
    name = tag.band_name(header.xmp)
    irradiance, si = said.irradiance() if canonical(name, wavelength) != "lwir" else (None, False)
    return BandTags(
        name=name,
        wavelength_nm=wavelength,
        width_nm=width,
        capture=plain(said.xmp.text("CaptureId", "CaptureUUID", "Camera:ImageUniqueID"), 80),
        index=said.index(),
        black_level=said.black_level(bits),
        bits=bits,
        exposure_s=said.exposure(),
        gain=said.gain(),
        gain_adjustment=said.number("SensorGainAdjustment", _GAIN),
        f_number=said.within("f-number", header.exif.number(tag.F_NUMBER), _APERTURE),
        radiometric=said.three("RadiometricCalibration"),
        sensor_model=said.sensor_model(bits),
        vignetting=said.vignetting(),
        irradiance=irradiance,
        irradiance_si=si,
        normalised=said.normalised(),
        panel=said.panel(),
        notes=tuple(said.notes),
    )


class _Said:
    """A header's values, checked; what is ignored is noted."""

    def __init__(self, header: Header) -> None:
        self.header, self.exif, self.xmp = header, header.exif, header.xmp
        self.notes: list[str] = []
        self.dji = bool(self.xmp.text("drone-dji:SensorGain", "drone-dji:SensorIndex"))

    def ignore(self, what: str, value: object, why: str) -> None:
        """Notes that a value is not used."""
        self.notes.append(f"Its {what} ({plain(str(value), 60)}) was ignored: {why}.")

    def within(self, what: str, value: float | None, limits: tuple[float, float]) -> float | None:
        """A number within limits; another one is noted."""
        if value is None or limits[0] <= value <= limits[1]:
            return value
        self.ignore(what, f"{value:g}", "it is not a possible value")
        return None

    def number(self, name: str, limits: tuple[float, float]) -> float | None:
        """A number in XMP within limits."""
        text = self.xmp.text(name)
        found = self.xmp.number(name)
        if text and found is None:
            self.ignore(name.rpartition(":")[2], text, "it is not a number")
        return self.within(name.rpartition(":")[2], found, limits)

    def numbers(self, name: str, low: int, high: int) -> tuple[float, ...]:
        """A list in XMP of so many numbers; empty where it is none."""
        text, found = self.xmp.text(name), self.xmp.numbers(name)
        if text and not (low <= len(found) <= high and all(abs(n) < _MOST for n in found)):
            count = f"{low}" if low == high else f"{low} to {high}"
            self.ignore(name.rpartition(":")[2], text, f"it is not {count} numbers")
            return ()
        return found

    def three(self, name: str) -> tuple[float, float, float] | None:
        """Three numbers, of which the first is a sensitivity, greater than 0."""
        found = self.numbers(name, 3, 3)
        if not found or self.within(name, found[0], (_LEAST, _MOST)) is None:
            return None
        return found[0], found[1], found[2]

    def sensor_model(self, bits: int | None) -> tuple[float, float, float] | None:
        """The Sequoia's, whose second number is a count without light."""
        found = self.three("SensorModel")
        if found and self.within("SensorModel", found[1], _counts(bits)) is None:
            return None
        return found

    def band(self) -> tuple[float | None, float | None]:
        """Wavelength and full width in nm; DJI writes half of the latter."""
        wavelength = self.number("CentralWavelength", _WAVELENGTH)
        width = self.number("WavelengthFWHM", _WIDTH)
        text = self.xmp.text("BandFreq")
        if text and (wavelength is None or width is None):
            if parts := _BAND.search(text):
                told = self.within("BandFreq", real(parts[1]), _WAVELENGTH)
                half = self.within("BandFreq", real(parts[2]), _WIDTH)
                wavelength = told if wavelength is None else wavelength
                width = 2 * half if width is None and half is not None else width
            else:
                self.ignore("BandFreq", text, "it is not a wavelength and a width")
        return wavelength, width

    def normalised(self) -> bool:
        """Whether the values are no counts."""
        said = self.xmp.text("Camera:IsNormalized").lower() in ("1", "true")
        return said or self.header.stored.startswith("float")

    def panel(self) -> Panel | None:
        """A panel whose reflectance and place are told."""
        reflectance = self.number("Albedo", _REFLECTANCE)
        corners = self.numbers("ReflectArea", 8, 8) if reflectance else ()
        if reflectance is None or not corners:
            return None
        pairs = zip(corners[::2], corners[1::2], strict=True)
        return Panel(reflectance=reflectance, corners=tuple(pairs))

    def index(self) -> int | None:
        """The camera's number in the rig."""
        return whole(self.xmp.text("Camera:RigCameraIndex", "SensorIndex", "DLS:SensorId"), 0, 99)

    def bits(self) -> int | None:
        """Bits of a count, of the first band."""
        value = self.exif.tags.get(tag.BITS)
        value = max(value, default=None) if isinstance(value, tuple) else value
        found = self.within("number of bits", as_number(value), (1, 64))
        if found is None:
            found = self.number("BitsPerSample", (1, 64))
        return {"uint8": 8, "uint16": 16}.get(self.header.dtype) if found is None else int(found)

    def black_level(self, bits: int | None) -> float | None:
        """The mean of the levels of the four pixels of a pattern."""
        value = self.exif.tags.get(tag.BLACK_LEVEL)
        limits = _counts(bits)
        if value is not None:
            levels = [as_number(v) for v in (value if isinstance(value, tuple) else (value,))]
            known = [level for level in levels if level is not None]
            if known and len(known) == len(levels):
                return self.within("black level", math.fsum(known) / len(known), limits)
            self.ignore("black level", value, "it is not a number")
        for name in ("BlackLevel", "BlackCurrent"):
            if self.xmp.text(name):
                return self.number(name, limits)
        return None

    def exposure(self) -> float | None:
        """Exposure time in s; DJI's XMP has it in us."""
        if self.dji and self.xmp.text("drone-dji:ExposureTime"):
            found = self.number("drone-dji:ExposureTime", (0.1, 60e6))
            return None if found is None else found / 1e6
        found = self.exif.number(tag.EXPOSURE_S)
        early = self.exif.text(tag.MODEL).lower() in _EARLY
        if early and found is not None and abs(found - _WRONG_EXPOSURE) < 1e-6:
            return _RIGHT_EXPOSURE
        return self.within("exposure time", found, _EXPOSURE_S)

    def gain(self) -> float | None:
        """DJI's gain, else ISO / 100."""
        if self.dji:
            return self.number("drone-dji:SensorGain", _GAIN)
        iso = self.exif.number(tag.ISO_SPEED) or self.exif.number(tag.ISO)
        return self.within("gain", None if iso is None else iso / 100, _GAIN)

    def vignetting(self) -> Vignetting | None:
        """The maker's polynomial. DJI's tells what to multiply by, also where it stands under
        Pix4D's name; that of others tells the share of the light.
        """
        if self.xmp.text("Camera:VignettingPolynomial2D"):
            return self._in_columns_and_rows()
        if self.xmp.text("drone-dji:VignettingData"):
            name = "drone-dji:VignettingData"
        else:
            name = "Camera:VignettingPolynomial"
        coefficients = self.numbers(name, 1, _MOST_RADIAL)
        if not coefficients:
            return None
        x, y = (self.xmp.number(f"drone-dji:CalibratedOpticalCenter{axis}") for axis in "XY")
        centre = self.xmp.numbers("Camera:VignettingCenter")
        if self.dji and x is not None and y is not None:
            centre = (x, y)
        if len(centre) != 2 or not all(0 <= c < 1e6 for c in centre):
            self.ignore("vignetting", name.rpartition(":")[2], "it has no centre")
            return None
        return Vignetting(
            coefficients=coefficients, centre=(centre[0], centre[1]), corrects=self.dji
        )

    def _in_columns_and_rows(self) -> Vignetting | None:
        coefficients = self.numbers("Camera:VignettingPolynomial2D", 1, _MOST_TERMS)
        told = self.numbers("Camera:VignettingPolynomial2DName", 2, 2 * _MOST_TERMS)
        if not coefficients or not told:
            return None
        whole = all(n == int(n) and 0 <= n <= _MOST_POWER for n in told)
        if len(told) != 2 * len(coefficients) or not whole:
            self.ignore("VignettingPolynomial2DName", told[:6], "these are no exponents of it")
            return None
        powers = tuple((int(a), int(b)) for a, b in zip(told[::2], told[1::2], strict=True))
        return Vignetting(coefficients=coefficients, powers=powers, corrects=self.dji)

    def irradiance(self) -> tuple[float | None, bool]:
        """What the sun sensor measured, and whether it is in W/m2/nm."""
        if self.xmp.text("IrradianceList"):
            return self._of_sequoia(), False
        if self.dji:
            own = "drone-dji:Irradiance"
            name = own if self.xmp.text(own) else "Camera:Irradiance"
            return self.number(name, (_LEAST, _MOST)), False
        return self._of_micasense()

    def _of_micasense(self) -> tuple[float | None, bool]:
        """In W/m2/nm: of a level surface, else as measured by a sensor that tilts with the drone.

        Where no scale is stated, the former is in uW/cm2/nm (MicaSense), and so is what would be
        more than the sun gives.
        """
        stated = self.number("IrradianceScaleToSIUnits", (1e-6, 1e3))
        level = self.number("HorizontalIrradiance", (_LEAST, _MOST))
        if level is not None and not self._trusted():
            self.ignore("HorizontalIrradiance", level, "this firmware computes it wrongly")
            level = None
        elif level is not None:
            return self._sunlike("HorizontalIrradiance", level, stated or _MICROWATT)
        for name in ("SpectralIrradiance", "Camera:Irradiance"):
            found = self.number(name, (_LEAST, _MOST))
            if found is not None:
                scale = stated if name == "SpectralIrradiance" else None
                return self._sunlike(name, found, scale or (1.0 if found < SUN else _MICROWATT))
        return None, False

    def _sunlike(self, name: str, value: float, scale: float) -> tuple[float | None, bool]:
        found = value * scale
        if found < SUN:
            return found, True
        self.ignore(name.rpartition(":")[2], value, "it is more than the sun gives")
        return None, False

    def _trusted(self) -> bool:
        """Whether the firmware computes the irradiance of a level surface rightly."""
        first = _TRUSTED.get(self.exif.text(tag.MODEL).lower())
        parts = re.findall(r"\d{1,4}", self.exif.text(tag.SOFTWARE))[:3]
        return first is None or not parts or tuple(int(p) for p in parts) >= first

    def _of_sequoia(self) -> float | None:
        """The median of the Sequoia's readings since the capture before, each over its integration
        time and the gain, which the camera's calibration measured.
        """
        text = self.xmp.text("IrradianceList")
        gains = _gains(self.xmp)
        found = []
        for first, index, time_ms in _readings(text):
            if 0 < first < _FULL and 1 <= time_ms <= 10_000 and index in gains:
                found.append(first / time_ms / gains[index])
        if not found:
            self.ignore("IrradianceList", text[:20], "it has no usable reading")
            return None
        return median(found)


def _counts(bits: int | None) -> tuple[float, float]:
    """The least and the greatest count."""
    return 0.0, 2.0 ** (bits or 16) - 1


def _readings(text: str) -> list[tuple[int, int, int]]:
    """Counts of the first channel, index of the gain and integration time in ms of the readings in
    the Sequoia's list, which is in base 64; a torn end is left out.
    """
    clean = re.split(r"[^A-Za-z0-9+/]", text, maxsplit=1)[0]
    clean = clean[:-1] if len(clean) % 4 == 1 else clean
    data = base64.b64decode(clean + "=" * (-len(clean) % 4))
    whole_ones = data[: len(data) // _READING.size * _READING.size]
    return [(r[1], r[3], r[4]) for r in _READING.iter_unpack(whole_ones)]


def _gains(xmp: Xmp) -> dict[int, float]:
    """Gains of the Sequoia's sun sensor by index, over that of the usual one: counts of the first
    channel per ms in the calibration, whose rows are index, ms and the two channels.
    """
    told = xmp.numbers("IrradianceCalibrationMeasurement")
    rows = zip(told[::4], told[1::4], told[2::4], strict=False)
    rates = {int(i): n / ms for i, ms, n in rows if 0 <= i < 4 and ms > 0 and 0 < n < _FULL}
    usual = rates.get(_USUAL_GAIN)
    return {i: r / usual for i, r in rates.items()} if usual else {_USUAL_GAIN: 1.0}
