"""Measured values on their way into a map: whether frames' drift is balanced, and what is told
about it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.views import View
from skyquilt.model.photo import Photo
from skyquilt.model.surface import Surface
from skyquilt.ortho.exposure import NEUTRAL, Exposure
from skyquilt.workflows.methods import Methods, MosaicSettings

TAG = "DRIFT"
"""Tag of a raster of measured values: whether they are as recorded."""


def balances_drift(settings: MosaicSettings, unit: str) -> bool:
    """Whether frames of this unit are brought to one level.

    Degrees are unless somebody asks for values as recorded. Counts are only when asked: they are
    what a maker's formula will be applied to, and it knows nothing of our offsets.
    """
    if not unit:
        return False
    if settings.balance_thermal is not None:
        return settings.balance_thermal
    return settings.balance and unit == "celsius"


def drift_of(
    views: Sequence[View],
    thumbnails: Mapping[int, NDArray[Any]],
    surface: Surface,
    bounds: tuple[float, float, float, float],
    unit: str,
    parts: Methods,
    settings: MosaicSettings,
) -> Exposure:
    """What brings frames of measured values to one level; neutral where they are to stay as
    recorded.
    """
    if not balances_drift(settings, unit):
        return NEUTRAL
    return Exposure(gains={}, fields={}, offsets=parts.drift(views, thumbnails, surface, bounds))


def value_tags(unit: str, exposure: Exposure) -> dict[str, str]:
    """What a raster says about its values; nothing for pictures."""
    if not unit:
        return {}
    return {"UNIT": unit, TAG: _drift(balanced=bool(exposure.offsets))}


def recorded_tags(metrics: Mapping[str, Any]) -> dict[str, str]:
    """The same from the figures of a finished map."""
    told = metrics.get("thermal_values")
    return {"UNIT": told["unit"], TAG: _drift(balanced=told["balanced"])} if told else {}


def _drift(*, balanced: bool) -> str:
    return "balanced on overlaps" if balanced else "as recorded"


def value_figures(
    photos: Sequence[Photo], exposure: Exposure, settings: MosaicSettings
) -> dict[str, Any]:
    """What metrics.json says under `thermal_values`; nothing for pictures."""
    unit = photos[0].unit
    if not unit:
        return {}
    offsets = np.array(list(exposure.offsets.values()) or [0.0])
    return {
        "thermal_values": {
            "unit": unit,
            "balanced": bool(exposure.offsets),
            "why": _why(unit, exposure, settings),
            "offset_rms": round(float(np.sqrt((offsets**2).mean())), 4),
            "offset_largest": round(float(np.abs(offsets).max()), 4),
            "offsets": {photos[i].name: round(o, 4) for i, o in sorted(exposure.offsets.items())},
        }
    }


def _why(unit: str, exposure: Exposure, settings: MosaicSettings) -> str:
    if exposure.offsets:
        return (
            "one offset per frame, from overlaps, their median 0; --raw-thermal leaves values as"
            " recorded"
        )
    if balances_drift(settings, unit):
        return (
            "no frames overlap enough to tell their drift; values are as recorded, resampled only"
        )
    if settings.balance_thermal is None and unit == "counts":
        return (
            "counts are kept as recorded, resampled only; --balance-thermal brings frames to one"
            " level"
        )
    return "values are as recorded, resampled only"
