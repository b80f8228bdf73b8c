"""Radiometry of a map: whether the drift of thermal frames is corrected, and how this is
reported.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.imaging.grey import to_grey8
from skyquilt.imaging.nodes import View
from skyquilt.model.photo import Photo
from skyquilt.model.surface import Surface
from skyquilt.ortho.earlier import complete, part_of, with_new
from skyquilt.ortho.exposure import NEUTRAL, Exposure
from skyquilt.ortho.frame_pattern import sized
from skyquilt.ortho.ground import Ground
from skyquilt.settings import PictureSettings

DEPTHS, LIGHTEST = (8, 10, 12, 14, 16), 99.9
"""Bits that cameras use of 16, and the percentile of their values that tells."""
TAG = "DRIFT"
"""Raster tag that states whether measured values are as recorded."""


def balances_drift(settings: PictureSettings, unit: str) -> bool:
    """Whether frames with this unit are brought to a common level.

    Degrees are, unless recorded values are requested. Raw counts are only on request: the
    manufacturer's formula will be applied to them, and our offsets would make its result wrong.
    """
    if not unit:
        return False
    if settings.balance_thermal is not None:
        return settings.balance_thermal
    return settings.balance and unit == "celsius"


class DriftMethod(Protocol):
    """Offsets of thermal frames from their overlaps."""

    def __call__(
        self,
        views: Sequence[View],
        thumbnails: Mapping[int, NDArray[Any]],
        surface: Surface,
        bounds: tuple[float, float, float, float],
    ) -> dict[int, float]:
        """Offset in the values' unit by photo."""
        ...

    def patterns(
        self,
        views: Sequence[View],
        thumbnails: Mapping[int, NDArray[Any]],
        surface: Surface,
        bounds: tuple[float, float, float, float],
    ) -> dict[int, NDArray[np.float32]]:
        """Correction (h, w) at nodes of the frame, common to a camera's frames, by photo."""
        ...


class BalanceMethod(Protocol):
    """Exposure of photos from their overlaps, in levels of 255."""

    def under(self, white: float) -> "BalanceMethod":
        """The same for a response of the cameras that is known, see `Exposure.white`."""
        ...

    def __call__(
        self,
        views: Sequence[View],
        thumbnails: Mapping[int, NDArray[Any]],
        surface: Surface,
        bounds: tuple[float, float, float, float],
        keep: Keep = MADE_NOW,
    ) -> Exposure:
        """The corrections that bring photos to a common brightness; `keep` keeps parts of them."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Levelling:
    """How placed photos of one kind are brought to a common level."""

    unit: str
    """Unit of the pixels; empty for pictures."""
    dtype: str
    """Type of the pixels."""
    thumbnails: Mapping[int, NDArray[Any]]
    """Small pictures by photo (index)."""
    balance: BalanceMethod
    """Finds the exposure of pictures."""
    drift: DriftMethod
    """Finds the offsets of measured values."""
    settings: PictureSettings
    """What is wanted."""
    keep: Keep = MADE_NOW
    """Keeps what takes long of large surveys."""
    mixed: bool = False
    """Whether some photos are grey and others in colours: then all bands of a photo are corrected
    alike, so that neither are tinted.
    """
    measured: bool = False
    """Whether values of 16 bits are measured, though they have no unit: they stay as recorded."""

    def __call__(self, ground: Ground) -> Exposure:
        """The photos' exposure, or the drift of measured values; neutral where neither is wanted.

        In a map that continues an earlier one, photos that were there keep their corrections, and
        new ones are brought to their level.
        """
        if (grows := ground.growth) is None:
            return self._alone(ground)
        exposure = grows.earlier.exposure
        for area in grows.areas:
            near = grows.near(ground.views, area)
            there = replace(ground, views=tuple(near), grid=part_of(ground.grid, area), growth=None)
            known = self.balance.under(exposure.white)
            part = replace(self, balance=known, keep=self.keep.within(f"{area}"))
            exposure = with_new(exposure, part._alone(there))
        return complete(exposure, ground.views)

    def _alone(self, ground: Ground) -> Exposure:
        views, surface, bounds = ground.views, ground.surface, ground.grid.bounds
        if self.unit:
            return drift_of(
                views, self.thumbnails, surface, bounds, self.unit, self.drift, self.settings
            )
        if not self.settings.balance or self.dtype not in ("uint8", "uint16") or self.measured:
            return NEUTRAL
        small, level = self.thumbnails, 1.0
        if self.dtype == "uint16":
            level = _level([small[v.photo] for v in views])
            small = _Levels(small, level)
        small = InGrey(small) if self.mixed else small
        return replace(self.balance(views, small, surface, bounds, self.keep), level=level)


def _level(pictures: Sequence[NDArray[Any]]) -> float:
    """Values that make one of 255 levels in pictures of 16 bits, of which cameras often use 10, 12
    or 14: the fewest that the lightest values need.
    """
    lightest = max((float(np.percentile(p, LIGHTEST)) for p in pictures), default=0.0)
    bits = next(b for b in DEPTHS if lightest < 2**b or b == DEPTHS[-1])
    return float(2**bits - 1) / 255


class _Pictures(Mapping[int, NDArray[Any]]):
    """Small pictures, of which each is changed when it is asked for."""

    def __init__(self, pictures: Mapping[int, NDArray[Any]]) -> None:
        self._pictures = pictures

    def __len__(self) -> int:
        return len(self._pictures)

    def __contains__(self, photo: object) -> bool:
        return photo in self._pictures

    def __iter__(self) -> Iterator[int]:
        return iter(self._pictures)


class InGrey(_Pictures):
    """Pictures in three equal bands."""

    def __getitem__(self, photo: int) -> NDArray[Any]:
        picture = self._pictures[photo]
        grey = to_grey8(picture) if picture.dtype == np.uint8 else picture.mean(-1)
        return np.repeat(grey[..., None], 3, axis=2)


class _Levels(_Pictures):
    """Pictures of 16 bits in levels of 0 to 255, with fractions."""

    def __init__(self, pictures: Mapping[int, NDArray[Any]], level: float) -> None:
        super().__init__(pictures)
        self._level = np.float32(level)

    def __getitem__(self, photo: int) -> NDArray[Any]:
        return np.asarray(self._pictures[photo].astype(np.float32) / self._level)


def drift_of(
    views: Sequence[View],
    thumbnails: Mapping[int, NDArray[Any]],
    surface: Surface,
    bounds: tuple[float, float, float, float],
    unit: str,
    drift: DriftMethod,
    settings: PictureSettings,
) -> Exposure:
    """The offsets that bring frames of measured values to a common level; neutral if they are kept
    as recorded.
    """
    if not balances_drift(settings, unit):
        return NEUTRAL
    patterns = drift.patterns(views, thumbnails, surface, bounds)
    even = {
        i: t + sized(patterns[i], t.shape).reshape(*t.shape[:2], *[1] * (t.ndim - 2))
        if i in patterns
        else t
        for i, t in thumbnails.items()
    }
    offsets = drift(views, even, surface, bounds)
    return Exposure(
        gains={},
        fields={},
        offsets=offsets,
        patterns={i: p for i, p in patterns.items() if i in offsets},
    )


def value_tags(unit: str, exposure: Exposure) -> dict[str, str]:
    """Raster tags about the values; empty for colour images."""
    if not unit:
        return {}
    return {"UNIT": unit, TAG: _drift(balanced=bool(exposure.offsets))}


def recorded_tags(metrics: Mapping[str, Any]) -> dict[str, str]:
    """The same tags from the metrics of a finished map."""
    told = metrics.get("thermal_values")
    return {"UNIT": told["unit"], TAG: _drift(balanced=told["balanced"])} if told else {}


def _drift(*, balanced: bool) -> str:
    return "balanced on overlaps" if balanced else "as recorded"


def value_figures(
    photos: Sequence[Photo], exposure: Exposure, settings: PictureSettings
) -> dict[str, Any]:
    """The entry `thermal_values` of metrics.json; empty for colour images."""
    unit = photos[0].unit
    if not unit:
        return {}
    offsets = np.array(list(exposure.offsets.values()) or [0.0])
    patterns = list(exposure.patterns.values())
    return {
        "thermal_values": {
            "unit": unit,
            "balanced": bool(exposure.offsets),
            "why": _why(unit, exposure, settings),
            "offset_rms": round(float(np.sqrt((offsets**2).mean())), 4),
            "offset_largest": round(float(np.abs(offsets).max()), 4),
            "offsets": {photos[i].name: round(o, 4) for i, o in sorted(exposure.offsets.items())},
            "pattern_rms": round(max((float(p.std()) for p in patterns), default=0.0), 4),
            "pattern_largest": round(max((float(np.ptp(p)) for p in patterns), default=0.0), 4),
        }
    }


def _why(unit: str, exposure: Exposure, settings: PictureSettings) -> str:
    if exposure.offsets:
        shared = ", and what all frames show at one place of the picture"
        return (
            "one offset per frame, from overlaps, their median 0"
            f"{shared if exposure.patterns else ''}; --raw-thermal leaves values as recorded"
        )
    if balances_drift(settings, unit):
        return "too little overlap to estimate the drift; values are as recorded, resampled only"
    if settings.balance_thermal is None and unit == "counts":
        return (
            "counts are kept as recorded, resampled only; --balance-thermal brings frames to one"
            " level"
        )
    return "values are as recorded, resampled only"
