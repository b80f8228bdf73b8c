"""Counts of a multispectral camera to reflectance, by what its files tell."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyquilt.model.bands import canonical
from skyquilt.photos.band_tags import SUN, BandTags, Vignetting

Kind = Literal["counts", "radiance", "by-band", "relative", "reflectance"]
"""What values are, the weakest first: as recorded; proportional to the light that came from the
ground; proportional to reflectance, with a factor of each band's own; proportional to reflectance,
with one factor for all bands; reflectance.
"""
KINDS: tuple[Kind, ...] = get_args(Kind)
_SATURATED = 10
"""A count is saturated in the last 2^-10 of the range: detectors of 10 bits (Sequoia) and 12 bits
(MicaSense), whose counts are stored as 16 bits, end at 65472 and 65520."""
_FALL_OFF = (0.1, 10.0)
"""Factors between which a fall-off of light and a gradient of rows may lie anywhere in a frame."""
_MIDDLE = (0.25, 0.75)
"""Share of the frame in which the centre of the fall-off lies; else the frame is a part, or a
reduced copy, of another one."""
_NODES = 33
"""Columns and rows at which factors are checked."""


@dataclass(frozen=True, kw_only=True)
class Reflectance:
    """Converts counts of the photos of one band, of one exposure.

    MicaSense ("RedEdge Camera Radiometric Calibration Model"): radiance
    L = V a1 / g (p - b) / (t + a2 y - a3 t y) in W/m2/sr/nm, with counts p and black level b as
    shares of 2^bits, the gain g, the exposure time t, the row y, and the fall-off V = 1 / (1 + k0 r
    + ... + k5 r^6); reflectance is pi L / E, with the irradiance E of the sun sensor.

    DJI ("P4 Multispectral Image Processing Guide", "Mavic 3M Image Processing Guide"): the same
    with a1 = 1 and without a2, a3; the fall-off is given as the factor 1 + k[0] r + ... + k[5] r^6;
    times `SensorGainAdjustment` over `Irradiance` it is proportional to reflectance, with one
    factor for all bands.

    Parrot's Sequoia (SEQ-AN-01): f^2 (p - b) / (A t ISO + C), with the counts p, over what its sun
    sensor counts for its gain and its integration time. Parrot states no factor between the two and
    lets it be measured with a panel, so it is each band's own; the same holds for any camera whose
    sensitivity the file does not tell.
    """

    kind: Kind
    """What the values are."""
    best: Kind = "counts"
    """What they are with an irradiance."""
    black_level: float = 0.0
    """Count without light, which is taken off."""
    scale: float = 1.0
    """By what the rest is multiplied, save for fall-off, gradient and irradiance."""
    saturated: float = math.inf
    """Counts from here on are no measurements."""
    full: float = math.inf
    """Counts that the range has."""
    vignetting: Vignetting | None = None
    """The fall-off of light."""
    gradient: float = 0.0
    """Share by which the exposure of a row differs from that of the row before it."""
    irradiance: float | None = None
    """Of the sun sensor; None where it is not divided by."""
    width: int = 0
    """Width in px of the frame."""
    height: int = 0
    """Its height in px."""
    notes: tuple[str, ...] = ()
    """Sentences on what of the file was not used."""

    @staticmethod
    def of(tags: BandTags, width: int, height: int) -> "Reflectance":
        """By what a file of width x height px tells.

        Where gain, exposure time or black level are not told, or the band is a thermal one, values
        stay as they are.
        """
        scale = _scale(tags)
        thermal = canonical(tags.name, tags.wavelength_nm) == "lwir"
        black = tags.sensor_model[1] if tags.sensor_model else tags.black_level
        if scale is None or black is None or thermal or tags.normalised:
            return Reflectance(kind="counts", width=width, height=height)
        bits = tags.bits or 16
        notes = []
        vignetting = tags.vignetting
        if vignetting is not None and (why := _no_fall_off(vignetting, width, height)):
            notes.append(f"The fall-off of light was not corrected: {why}.")
            vignetting = None
        gradient = _gradient(tags)
        if not _FALL_OFF[0] < 1 + gradient * height < _FALL_OFF[1]:
            notes.append(f"A gradient of rows of {gradient:.3g} is not possible; it was ignored.")
            gradient = 0.0
        found = Reflectance(
            kind="radiance",
            best=_best_kind(tags),
            black_level=black,
            scale=scale,
            saturated=_saturated(bits),
            full=2.0**bits,
            vignetting=vignetting,
            gradient=gradient,
            notes=tuple(notes),
            width=width,
            height=height,
        )
        return found.with_irradiance(tags.irradiance)

    def with_irradiance(self, value: float | None) -> "Reflectance":
        """The same with another irradiance, in the unit of the file's. Without one, or with one
        that no working sensor measures (none of the sun, more than the sun gives), the values are
        radiances. A sensor that always measures the same cannot be told here: it divides all photos
        of a band alike.
        """
        most = SUN if self.best == "reflectance" else math.inf
        if KINDS.index(self.best) <= KINDS.index("radiance"):
            return self
        if value is None or not 0 < value < most:
            return replace(self, kind="radiance", irradiance=None)
        return replace(self, kind=self.best, irradiance=float(value))

    def with_bits(self, bits: int) -> "Reflectance":
        """The same of counts that have so many bits, fewer than those of the file."""
        if self.kind == "counts":
            return self
        scale = self.scale * self.full / 2.0**bits
        return replace(self, scale=scale, saturated=_saturated(bits), full=2.0**bits)

    def as_kind(self, kind: Kind) -> "Reflectance":
        """The same as values of a weaker kind, to compare bands of which not all have the better
        one.

        Raises:
            ValueError: it is a better kind than this one.
        """
        if KINDS.index(kind) > KINDS.index(self.kind):
            raise ValueError(f"{self.kind} cannot become {kind}")
        divided = KINDS.index(kind) > KINDS.index("radiance")
        irradiance = self.irradiance if divided else None
        return replace(self, kind=kind, best=kind, irradiance=irradiance)

    def __call__(
        self, counts: NDArray[Any], row0: int = 0, column0: int = 0
    ) -> NDArray[np.float32]:
        """Values (h, w) float32 of counts (h, w), a part of the frame whose first pixel is at that
        row and column.

        A saturated pixel is NaN: of its reflectance only a lower bound is known, and mixed with
        others it would make the map too dark. Counts below the black level are noise around no
        light, and are 0, so that indices stay within their range. As `counts` nothing is changed.
        """
        values = np.array(counts, dtype=np.float32)
        if self.kind == "counts":
            return values
        full = values >= self.saturated
        np.maximum(values - np.float32(self.black_level), 0, out=values)  # NaN stays NaN
        factor = self.scale / (self.irradiance or 1.0)
        values *= np.float32(math.pi * factor if self.kind == "reflectance" else factor)
        rows, columns = np.arange(values.shape[0]) + row0, np.arange(values.shape[1]) + column0
        if self.vignetting is not None:
            fall_off = _fall_off(self.vignetting, rows, columns, self.width, self.height)
            (np.multiply if self.vignetting.corrects else np.divide)(values, fall_off, out=values)
        if self.gradient:
            values /= (1 + self.gradient * rows).astype(np.float32)[:, None]
        values[full] = np.nan
        return values


def _saturated(bits: int) -> float:
    """The count of so many bits from which one is saturated."""
    return 2.0**bits - max(2.0 ** (bits - _SATURATED), 1.0)


def common_kind(bands: Sequence[Reflectance]) -> Kind:
    """The kind as which all bands of a rig can be compared: the weakest of theirs."""
    return min((b.kind for b in bands), key=KINDS.index, default="counts")


def _scale(tags: BandTags) -> float | None:
    """What a count is multiplied by, without irradiance; None where it is not told."""
    if tags.exposure_s is None or tags.gain is None:
        return None
    if tags.sensor_model is not None:
        a, _, c = tags.sensor_model
        per_light = a * tags.exposure_s * 100 * tags.gain + c
        return tags.f_number**2 / per_light if tags.f_number and per_light > 0 else None
    exposed = tags.exposure_s * tags.gain * 2.0 ** (tags.bits or 16)
    return (tags.radiometric[0] if tags.radiometric else tags.gain_adjustment or 1.0) / exposed


def _best_kind(tags: BandTags) -> Kind:
    """What values are with a good irradiance."""
    if tags.radiometric and (tags.irradiance_si or tags.irradiance is None):
        return "reflectance"
    return "relative" if tags.gain_adjustment and not tags.irradiance_si else "by-band"


def _gradient(tags: BandTags) -> float:
    """The share by which the exposure of a row differs from that of the one before it."""
    if not tags.radiometric or not tags.exposure_s:
        return 0.0
    return tags.radiometric[1] / tags.exposure_s - tags.radiometric[2]


def _no_fall_off(vignetting: Vignetting, width: int, height: int) -> str:
    """Why a polynomial cannot be that of a frame of this size; empty where it can."""
    low, high = _MIDDLE
    if vignetting.centre is not None:
        x, y = vignetting.centre
        if not (low * width < x < high * width and low * height < y < high * height):
            return f"its centre ({x:.0f}, {y:.0f}) is not in the middle of {width} x {height} px"
    rows, columns = (np.linspace(0, n - 1, _NODES) for n in (height, width))
    with np.errstate(over="ignore", invalid="ignore"):
        found = _fall_off(vignetting, rows, columns, width, height)
    if not (found.min() > _FALL_OFF[0] and found.max() < _FALL_OFF[1]):  # False of NaN, too
        return f"it would be between {found.min():.3g} and {found.max():.3g}"
    return ""


def _fall_off(
    vignetting: Vignetting, rows: NDArray[Any], columns: NDArray[Any], width: int, height: int
) -> NDArray[np.float32]:
    """The polynomial (h, w) at rows (h,) and columns (w,) of a frame."""
    if vignetting.centre is None:
        shares = columns / width, rows / height
        orders = [max(p[k] for p in vignetting.powers) + 1 for k in (0, 1)]
        terms = np.zeros(orders)
        for power, coefficient in zip(vignetting.powers, vignetting.coefficients, strict=True):
            terms[power] += coefficient
        x, y = (np.power.outer(s, np.arange(n)) for s, n in zip(shares, orders, strict=True))
        return np.asarray(y @ terms.T @ x.T, np.float32)
    across, down = ((n - c) ** 2 for n, c in zip((columns, rows), vignetting.centre, strict=True))
    r = np.sqrt(across.astype(np.float32)[None, :] + down.astype(np.float32)[:, None])
    found = np.zeros_like(r)
    for coefficient in reversed(vignetting.coefficients):
        found += np.float32(coefficient)
        found *= r
    return np.asarray(found + 1, np.float32)


WINDOW = 11
"""Captures whose readings of the sun sensor are looked at together."""
REACH_S = 60.0
"""Largest time in s between a capture and those whose readings serve for it."""
_NEAR = 3.0
"""A reading is near the median of those around it up to so many deviations of the jitter."""
_SAME = 1e-9
"""Relative difference up to which readings are the same."""
_SIGMA_PER_MEDIAN = 1.4826
"""Standard deviation of normal deviates over the median of their sizes."""


def smoothed_irradiance(times_s: ArrayLike, values: ArrayLike) -> NDArray[np.float64]:
    """Readings (n,) of a sun sensor, in any unit, without their jitter: a drone that tilts changes
    them by some percent from capture to capture.

    Each is the mean of those of the captures around it that are near their median, by the jitter of
    the whole flight. So what changes for at least half of these `WINDOW` captures stays, as a cloud
    does, and shorter changes are taken for faults. `times_s`: (n,) times in s, in any order; a
    capture without a time (NaN) keeps its own reading. What is not greater than 0 counts as no
    reading; the result is NaN where there is none nearby.

    Raises:
        ValueError: times and values are not of one length.
    """
    times, read = np.asarray(times_s, np.float64), np.array(values, np.float64)
    if times.shape != read.shape or times.ndim != 1:
        raise ValueError(f"{times.shape} times for {read.shape} readings")
    read[~(np.isfinite(read) & (read > 0))] = np.nan
    found = read.copy()
    timed = np.flatnonzero(np.isfinite(times))
    order = timed[np.argsort(times[timed], kind="stable")]
    logs = np.log(read)
    half = WINDOW // 2
    looked: list[tuple[int, NDArray[np.intp], float]] = []
    for k, at in enumerate(order):
        around = order[max(k - half, 0) : k + half + 1]
        around = around[(np.abs(times[around] - times[at]) <= REACH_S) & np.isfinite(read[around])]
        if around.size:
            looked.append((at, around, float(np.median(logs[around]))))
    off = [abs(logs[at] - median) for at, _, median in looked if np.isfinite(read[at])]
    near = _NEAR * _SIGMA_PER_MEDIAN * np.median(off) if off else 0.0
    for at, around, median in looked:
        away = np.abs(logs[around] - median)
        # of an even number of readings none may be as near as that, but two alike
        found[at] = read[around[away <= max(near, away.min()) + _SAME]].mean()
    return found
