"""Pictures of a panel of known reflectance on the ground, which tell how bright the light was: more
truly than a sun sensor, and where there is none.

MicaSense's cameras recognise their panel, and write its reflectance and its place into the files.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.model.event import Note
from skyquilt.model.photo import Photo
from skyquilt.multispectral.captures import THERMAL, BandFiles
from skyquilt.multispectral.draw import PlacedBand
from skyquilt.multispectral.reflectance import Reflectance
from skyquilt.photos.band_tags import BandTags, Panel
from skyquilt.photos.pixels import read_color
from skyquilt.photos.together import clocks

_INNER = 0.8
"""Share of a panel's sides that is measured: its rim may lie beside it."""
_LEAST_PX = 25
"""Pixels of a panel that are enough."""
_UNEVEN = 0.15
"""Standard deviation of a panel's pixels, as a share of their mean, from which something lies on
it, or it lies elsewhere."""
_DIFFERS = 1.5
"""Factor between panel and sun sensor, or between pictures of a panel, from which it is told."""
_TOGETHER_S = 60.0
"""Pictures of a panel within so many seconds show it in one light."""


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """What one file with a panel tells."""

    name: str
    """Its name."""
    time_s: float
    """When it was taken; NaN: not known."""
    light: float
    """Irradiance in which the panel has its reflectance."""
    sensor: float | None
    """That of the sun sensor, in its own unit."""

    @property
    def over_sensor(self) -> float:
        """The light over what the sun sensor measured; the light where there is no sensor."""
        return self.light / (self.sensor or 1.0)


def by_panels(
    placed: Sequence[PlacedBand], shot: Sequence[BandFiles]
) -> tuple[list[PlacedBand], Note | None]:
    """The bands as reflectances, where pictures of a panel tell the light of each of them, and
    what to tell of it. `shot`: all files of all bands, those that are not drawn too.

    Where files have readings of a sun sensor, these are multiplied by what panels measure over them
    (median); else the light of a file is that between the panels before and after it. Of pictures
    taken within a minute the brightest counts: who stands beside a panel darkens some.
    """
    light = [b.files.name for b in placed if b.files.name != THERMAL]
    with_panel = [b for b in shot if any(t.panel for t in b.tags)]
    if not light or not with_panel:
        return list(placed), None
    seen: dict[str, list[_Seen]] = {}
    reasons: dict[str, str] = {}
    for band in with_panel:
        times = clocks(band.photos).tolist()
        for item in zip(band.photos, band.tags, band.converts, times, strict=True):
            said = _look(*item)
            if isinstance(said, _Seen):
                seen.setdefault(band.name, []).append(said)
            elif said:
                reasons.setdefault(band.name, said)
    lacking = [name for name in light if name not in seen]
    if lacking:
        why = reasons.get(lacking[0], "no file of it shows one")
        return list(placed), Note(
            text=f"The pictures of a panel are not used: the band {lacking[0]} has none that can"
            f" be ({why}), and values of bands must be comparable.",
            warning=True,
        )
    bands: list[PlacedBand] = []
    factors: list[float] = []
    for one in placed:
        if one.files.name == THERMAL:
            bands.append(one)
            continue
        converts, factor = _lit(one.files, _brightest(seen[one.files.name]))
        bands.append(replace(one, files=replace(one.files, converts=converts)))
        factors += [factor] if factor else []
    return bands, _note([seen[name] for name in light], factors)


def _note(seen: Sequence[Sequence[_Seen]], factors: Sequence[float]) -> Note:
    """What is told; `seen`: by band, `factors`: panel over sun sensor, by band, where that measures
    irradiances.
    """
    pictures = max(map(len, seen))
    many = f"{pictures} pictures" if pictures > 1 else "a picture"
    told = f"Values are reflectances by {many} of a panel"
    low, high = min(factors, default=1.0), max(factors, default=1.0)
    if factors:
        told += f" and the sun sensor, whose readings are multiplied by {low:.2f} to {high:.2f}"
    ordered = [sorted(own, key=lambda s: s.over_sensor) for own in seen]
    dark, bright = max(((o[0], o[-1]) for o in ordered), key=lambda e: _times(*e))
    if (times := _times(dark, bright)) > _DIFFERS:
        return Note(
            text=f"{told}. By {bright.name} there was {times:.1f} times as much light as by"
            f" {dark.name}: there was a cloud, or a shadow on the panel or the sensor. Take away"
            " pictures of a panel in a shadow.",
            warning=True,
        )
    if low > 1 / _DIFFERS and high < _DIFFERS:
        return Note(text=f"{told}.")
    return Note(
        text=f"{told}: one of both is far off. Look whether the panel lay in the sun, without a"
        " shadow on it or on the sensor; without these pictures the sensor alone counts.",
        warning=True,
    )


def _times(dark: _Seen, bright: _Seen) -> float:
    """How many times as much light the latter tells as the former."""
    return bright.over_sensor / dark.over_sensor


def _brightest(seen: Sequence[_Seen]) -> list[_Seen]:
    """Of pictures taken within a minute the one that tells most light, in order of time; those of
    unknown time are one such group.
    """
    groups: list[list[_Seen]] = []
    for one in sorted(seen, key=lambda s: (math.isnan(s.time_s), s.time_s)):
        since = one.time_s - groups[-1][0].time_s if groups else math.inf
        untimed = bool(groups) and math.isnan(one.time_s) and math.isnan(groups[-1][0].time_s)
        if since <= _TOGETHER_S or untimed:
            groups[-1].append(one)
        else:
            groups.append([one])
    return [max(group, key=lambda s: s.over_sensor) for group in groups]


def _lit(files: BandFiles, seen: Sequence[_Seen]) -> tuple[tuple[Reflectance, ...], float | None]:
    """How a band's counts become reflectances, and the factor of the sun sensor's readings, None
    where there is no sensor that measures irradiances.
    """
    both = [s.over_sensor for s in seen if s.sensor]
    # of two in the middle the larger one: a shadow makes it too small
    factor = float(np.quantile(both, 0.5, method="higher")) if both else None
    times, light = np.array([(s.time_s, s.light) for s in seen]).T
    timed = np.isfinite(times)
    order = np.flatnonzero(timed)[np.argsort(times[timed], kind="stable")]
    found, read = [], False
    for convert, at in zip(files.converts, clocks(files.photos), strict=True):
        if convert.kind == "counts":
            found.append(convert)
            continue
        if factor is not None and convert.irradiance is not None:
            own = factor * convert.irradiance
            read = read or convert.best == "reflectance"
        elif len(order) and np.isfinite(at):
            own = float(np.interp(at, times[order], light[order]))
        else:
            own = float(light.mean())
        found.append(replace(convert, kind="reflectance", best="reflectance", irradiance=own))
    return tuple(found), factor if read else None


def _look(photo: Photo, tags: BandTags, convert: Reflectance, time_s: float) -> _Seen | str:
    """What a file with a panel tells, taken at `time_s`, else why it tells nothing; empty where it
    shows none.
    """
    if tags.panel is None or convert.kind == "counts":
        return "the files do not say how their counts came about" if tags.panel else ""
    try:
        counts = read_color(photo)
    except Exception:  # whatever it is, it concerns this file alone; told when it is looked at
        return f"{photo.name} cannot be read"
    inside = _inside(tags.panel, counts.shape[:2])
    if inside.sum() < _LEAST_PX:
        return f"that in {photo.name} lies outside the picture"
    values = convert.as_kind("radiance")(counts.reshape(counts.shape[:2]))[inside]
    if not np.isfinite(values).all():
        return f"that in {photo.name} is overexposed"
    mean = float(values.mean())
    if not mean > 0 or values.std() > _UNEVEN * mean:
        return f"that in {photo.name} is not evenly bright"
    light = math.pi * mean / tags.panel.reflectance
    return _Seen(name=photo.name, time_s=time_s, light=light, sensor=convert.irradiance)


def _inside(panel: Panel, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Pixels (h, w) of a panel, without its rim."""
    corners = np.array(panel.corners)
    inner = corners.mean(0) + _INNER * (corners - corners.mean(0))
    drawn = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(drawn, cv2.convexHull(np.rint(inner).astype(np.int32)), 1)
    return drawn > 0
