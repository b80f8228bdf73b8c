"""Exposure: brings overlapping photos to a common brightness, from the ground that they share.

Per camera a radial fall of light (vignetting, in even powers of the radius, as Goldman 2010 and
others), per photo a gain for each band and a smooth field over the image (the sun's hot spot), and
where clouds move their shadows (`cloud_shadows`). Gains act on the odds x / (1 - x) of a pixel
value x in (0, 1), not on the value: black stays black and white stays white, so nothing clips or
turns purple, and two gains in a row are one gain. Where a survey's overlaps show that its values
follow the light in proportion (as those of linear sensors), they act on x / (3 - x), which nearly
is a factor on x.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.engine.kept import MADE_NOW, Keep
from skyquilt.imaging.nodes import View, even_places, project_nodes
from skyquilt.model.surface import Surface
from skyquilt.ortho import cloud_shadows
from skyquilt.ortho.differences import (
    CORRELATED,
    SETTLED,
    SIGMA_LEVEL,
    Pairs,
    robust_differences,
    within_points,
)

Float = NDArray[np.float32]

WHITES = (255.0, 765.0, 2550.0)
"""Values at which a camera's response may end: gains act on the odds x / (white - x)."""
BETTER, CLOSELY_BETTER = 0.05, 0.02
"""A larger one, or closer weights, are taken if they make photos differ less by this share; a
larger one under closer weights by the other.
"""
POINTS, SAMPLES = 60, 200
"""Ground points a photo, at most, that are sampled of large surveys; samples where points lie
in many photos.
"""
ROUNDS = 8
"""Rounds in which photos' gains and cameras' radial terms are solved for in turn, at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposure:
    """Correction of each photo to a common brightness: log odds + gain[band] + field . (x, y, x^2,
    y^2, x y, r^4).
    """

    gains: Mapping[int, Float]
    """Photo -> (bands,) in log odds."""
    fields: Mapping[int, Float]
    """Photo -> (6,) in log odds, for x, y and r from the image's centre, 1 in its corners."""
    offsets: Mapping[int, float] = field(default_factory=dict)
    """Photo -> offset added to measured values, in their unit."""
    patterns: Mapping[int, Float] = field(default_factory=dict)
    """Photo -> (h, w) correction of measured values at nodes of the frame (`frame_pattern`)."""
    shades: Mapping[int, Float] = field(default_factory=dict)
    """Photo -> (n, n) in log odds at nodes of the picture (`cloud_shadows`), beside its field."""
    white: float = WHITES[0]
    """Value at which the response ends: gains act on the odds x / (white - x)."""
    level: float = 1.0
    """Values of the photos that make one of the 255 levels of x: 1 for 8 bits."""

    def uneven(self, photo: int) -> bool:
        """Whether the photo needs more than one gain per band."""
        return photo in self.shades or bool(np.abs(self.fields[photo]).max() > 0)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the report tells of it."""
        if not self.shades:
            return ()
        return (
            f"{len(self.shades)} photos show parts of the ground in other light than their"
            " neighbours: shadows of clouds that moved, a sun that moved on, thin smoke, or plants"
            " seen from the sun's side and from the other. That is evened out where photos differ;"
            " what all photos of a place, or its only one, show in shadow stays so.",
        )

    def odds(self, photo: int, x: Float, y: Float) -> Float:
        """Factors (h, w, bands) on the odds at image positions x, y (h, w), see `image_place`."""
        field = np.exp(self._light(photo, x, y))
        return np.asarray(field[..., None] * np.exp(self.gains[photo]), np.float32)

    def grey(self, view: View, value: NDArray[Any], u: NDArray[Any], v: NDArray[Any]) -> Float:
        """Corrected grey values (h, w) of a photo's pixels at columns u and rows v (h, w); of more
        than 8 bits as they are, since grey pictures of these are stretched one by one.
        """
        photo = view.photo
        if photo not in self.gains or self.level > 1:
            return np.asarray(value, np.float32)
        field = self._light(photo, *image_place(view, u, v))
        return np.asarray(
            self.brightened(value, np.exp(field + self.gains[photo].mean())), np.float32
        )

    def _light(self, photo: int, x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
        """(h, w) what is added to log odds at image positions x, y (h, w), but for the gains."""
        even = _field(x, y, self.fields[photo])
        if photo not in self.shades:
            return even
        return np.asarray(even + cloud_shadows.over(self.shades[photo], x, y))

    def brightened(self, value: NDArray[Any], odds: NDArray[Any]) -> NDArray[Any]:
        """Values with their odds multiplied."""
        white = self.white * self.level
        found: NDArray[Any] = white * odds * value / (white + (odds - 1) * value)
        return found if self.white <= WHITES[0] else np.minimum(found, WHITES[0] * self.level)

    def table(self, photo: int) -> NDArray[np.uint8] | None:
        """Lookup table (1, 256, bands) of a photo with gains only; None if nothing changes."""
        if photo not in self._tables:
            gains = self.gains[photo]
            none = float(np.abs(gains).max()) < 0.005
            self._tables[photo] = None if none else odds_table(gains, self.white)
        return self._tables[photo]

    @cached_property
    def _tables(self) -> dict[int, NDArray[np.uint8] | None]:
        """Tables made so far."""
        return {}


def with_odds(
    pixels: NDArray[np.uint8], odds: Float, white: float = WHITES[0]
) -> NDArray[np.uint8]:
    """Pixels (h, w, bands) with their odds multiplied by odds (h, w, bands)."""
    brighter = cv2.multiply(pixels, odds, dtype=cv2.CV_32F)
    # white - pixels, without OpenCV's addition of scalars, which takes four times as long as all
    # the rest
    rest: Any = cv2.add(brighter, cv2.bitwise_not(pixels), dtype=cv2.CV_32F)
    if white > WHITES[0]:
        rest += np.float32(white - WHITES[0])
    return np.asarray(cv2.divide(brighter, rest, scale=white, dtype=cv2.CV_8U), np.uint8).reshape(
        pixels.shape
    )


def _basis(x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
    """(..., 6) terms of the field."""
    return np.stack([x, y, x * x, y * y, x * y, (x * x + y * y) ** 2], -1)


def _field(x: NDArray[Any], y: NDArray[Any], terms: NDArray[Any]) -> NDArray[Any]:
    """(...,) the field, `_basis(x, y) @ terms`, in single precision and without an array of all
    terms.
    """
    a, b, c, d, e, f = terms.tolist()
    x, y = np.asarray(x, np.float32), np.asarray(y, np.float32)
    xx, yy = x * x, y * y
    return np.asarray(a * x + b * y + c * xx + d * yy + e * (x * y) + f * (xx + yy) ** 2)


def odds_table(gains: Float, white: float = WHITES[0]) -> NDArray[np.uint8]:
    """Lookup table (1, 256, bands) of gains in log odds."""
    x = np.arange(256)[None, :, None] / white
    g = np.exp(gains.astype(np.float64))
    return np.minimum(np.rint(white * g * x / (1 + (g - 1) * x)), 255).astype(np.uint8)


NEUTRAL = Exposure(gains={}, fields={})
"""No change."""


@dataclass(frozen=True, kw_only=True)
class Balance:
    """Robust least squares of log-odds differences at ground points seen by several photos."""

    points: int = 2500
    """Number of ground points sampled; more for surveys of many photos."""
    sigma_gain: float = 0.5
    """Prior deviation of a gain in log odds."""
    sigma_field: float = 0.15
    """Prior deviation of a term of the field in log odds."""
    sigma_radial: float = 1.0
    """Prior deviation of a term of a camera's radial fall of light."""
    even: float = 0.08
    """Fields smaller than this everywhere, in log odds (5 of 255 levels on middle grey), are not
    applied, to save time.
    """
    gained: float = 0.1
    """Least share of the differences between photos that fields must explain to be applied."""
    whites: tuple[float, ...] = WHITES
    """Values at which the cameras' response may end; the survey's overlaps decide."""
    version: ClassVar[int] = 11

    def under(self, white: float) -> "Balance":
        """The same for a response that is known."""
        return replace(self, whites=(white,))

    def __call__(
        self,
        views: Sequence[View],
        thumbnails: Mapping[int, NDArray[np.uint8]],
        surface: Surface,
        bounds: tuple[float, float, float, float],
        keep: Keep = MADE_NOW,
    ) -> Exposure:
        """Estimates the exposure from thumbnails (h, w[, bands]) of the photos."""
        usable = [v for v in views if v.photo in thumbnails]
        if len(usable) < 2:
            return NEUTRAL
        samples = self.samples(usable, thumbnails, surface, bounds, keep)
        if not len(samples.point):
            return NEUTRAL
        best = self._found(samples, usable, keep)
        few = samples.unmarked(usable).under(best.white)
        if not _clouded(few, few.level(best, usable), len(usable), cloud_shadows.EXPLAINED).any():
            return best
        each = min(cloud_shadows.DENSE, cloud_shadows.MOST // len(usable))
        wanted = int(samples.sought * each * len(usable) / len(samples.point))
        dense = replace(self, points=max(wanted, int(samples.sought)))
        s = dense.samples(usable, thumbnails, surface, bounds, keep).unmarked(usable)
        s = s.under(best.white)
        level = s.level(best, usable)
        free = _clouded(s, level, len(usable), cloud_shadows.SURELY)
        if not free.any():
            return best
        found = cloud_shadows.shades(s.point, s.row, s.place, level, free)
        return replace(best, shades={usable[k].photo: found[k] for k in np.flatnonzero(free)})

    def _found(self, samples: "Samples", views: Sequence[View], keep: Keep) -> Exposure:
        """Gains and fields, with the weights and the response that fit."""
        where = np.array([v.footprint.mean(0) for v in views])
        pairs = Pairs.of(samples.row, samples.point, where)
        wide, apart = self._best(samples, views, pairs, keep, closely=False)
        fields = np.stack([wide.fields[v.photo] for v in views])
        s = samples.under(wide.white)
        tried = keep("tried", lambda: self._with_gains(s, views, pairs, fields, closely=True))
        if samples.apart(tried, views) > (1 - BETTER / 2) * apart:  # saves the rest of the work
            return wide
        close, less = self._best(samples, views, pairs, keep, closely=True, least=wide.white)
        return close if less < (1 - BETTER) * apart else wide

    def _best(
        self,
        samples: "Samples",
        views: Sequence[View],
        pairs: Pairs,
        keep: Keep,
        *,
        closely: bool,
        least: float = 0.0,
    ) -> tuple[Exposure, float]:
        """The exposure under the response that fits, of those that end at `least` or beyond, and
        how far corrected samples differ.
        """
        best, apart, better = NEUTRAL, np.inf, CLOSELY_BETTER if closely else BETTER
        for white in self.whites:
            if white < least:
                continue
            found = self._kept(samples.under(white), views, pairs, keep, closely=closely)
            less = samples.apart(found, views)
            if less >= (1 - better) * apart:
                break
            best, apart = found, less
        return best, apart

    def _kept(
        self, s: "Samples", views: Sequence[View], pairs: Pairs, keep: Keep, *, closely: bool
    ) -> Exposure:
        name = f"{s.white:g}{' closely' if closely else ''}"
        return keep(name, lambda: self._solve(s, views, pairs, closely=closely))

    def _solve(
        self, s: "Samples", views: Sequence[View], pairs: Pairs, *, closely: bool
    ) -> Exposure:
        """Condition: log odds + gain + radial + field is the same in all photos of a ground point,
        so differences from the point's mean are zero.
        """
        N = len(s.point)
        radial = self._radial(s, views, pairs, closely=closely)
        grey = s.log.mean(1) + s.field(radial)
        terms = np.concatenate(
            [np.ones((N, 1), np.float32), _basis(s.place[:, 0], s.place[:, 1])[:, :5]], 1
        )
        ridge = s.prior / np.array([self.sigma_gain] + 5 * [self.sigma_field]) ** 2
        x = robust_differences(terms, pairs, grey[:, None], ridge, closely=closely)[..., 0]
        del terms
        fields = radial.copy()
        fields[:, :5] += x[:, 1:]
        largest = [
            np.abs(_basis(*_corners(v)) @ field).max()
            for v, field in zip(views, fields, strict=True)
        ]
        fields *= (np.array(largest) > self.even)[:, None]
        even = s.log.mean(1) + s.field(fields)
        bare = _apart(s.log.mean(1), pairs, ridge[:1], closely=closely)
        if _apart(even, pairs, ridge[:1], closely=closely) > (1 - self.gained) * bare:
            fields = np.zeros_like(fields)
        return self._with_gains(s, views, pairs, fields, closely=closely)

    def _with_gains(
        self,
        s: "Samples",
        views: Sequence[View],
        pairs: Pairs,
        fields: NDArray[Any],
        *,
        closely: bool,
    ) -> Exposure:
        """The gains of photos with these fields (n, 6)."""
        even = s.log + s.field(fields)[:, None]
        ridge = np.array([s.prior / self.sigma_gain**2])
        ones = np.ones((len(s.point), 1), np.float32)
        gains = robust_differences(ones, pairs, even, ridge, closely=closely)[:, 0]
        gains = (gains - np.median(gains, axis=0)).astype(np.float32)
        photos = [v.photo for v in views]
        return Exposure(
            gains=dict(zip(photos, gains, strict=True)),
            fields=dict(zip(photos, fields.astype(np.float32), strict=True)),
            white=s.white,
        )

    def _radial(
        self, s: "Samples", views: Sequence[View], pairs: Pairs, *, closely: bool
    ) -> NDArray[np.float64]:
        """(n, 6) the radial fall of light of each view's camera, as a field; photos' gains and
        cameras' terms are solved for in turn.
        """
        names = {c: k for k, c in enumerate(dict.fromkeys(v.camera for v in views))}
        camera = np.array([names[v.camera] for v in views])[s.row]
        r2 = (s.place**2).sum(1)
        apart = np.zeros((len(r2), len(names), 2), np.float32)
        apart[np.arange(len(r2)), camera] = np.stack([r2, r2 * r2], 1)
        columns = apart.reshape(len(r2), -1)
        grey = s.log.mean(1)
        found: NDArray[np.float64] = np.zeros(columns.shape[1])
        ones = np.ones((len(r2), 1), np.float32)
        ridge = np.array([s.prior / self.sigma_gain**2])
        pull = np.eye(len(found)) * s.prior * SIGMA_LEVEL**2 * CORRELATED / self.sigma_radial**2
        for _ in range(ROUNDS):
            level = (grey + columns @ found.astype(np.float32))[:, None]
            gain = robust_differences(ones, pairs, level, ridge, closely=closely)[:, 0, 0]
            before, found = (
                found,
                within_points(
                    columns,
                    grey + gain.astype(np.float32)[s.row],
                    pairs.point,
                    pull,
                    closely=closely,
                ),
            )
            if np.abs(found - before).max() < SETTLED:
                break
        fields = np.zeros((len(views), 6))
        mine = found.reshape(-1, 2)[[names[v.camera] for v in views]]
        fields[:, 2] = fields[:, 3] = mine[:, 0]
        fields[:, 5] = mine[:, 1]
        return fields

    def samples(
        self,
        views: Sequence[View],
        thumbnails: Mapping[int, NDArray[np.uint8]],
        surface: Surface,
        bounds: tuple[float, float, float, float],
        keep: Keep = MADE_NOW,
    ) -> "Samples":
        """Brightness of ground points, about `points` of them, in photos that show them; bounds in
        m.
        """
        west, south, east, north = bounds
        area, each = (east - west) * (north - south), POINTS * len(views)
        seen_by = sum(cv2.contourArea(v.footprint.astype(np.float32)) for v in views) / area
        few = min(each, SAMPLES * len(views) / max(seen_by, 1e-9))
        number = max(self.points, few)
        x, y, z = even_places(surface, bounds, number)
        point, row, place, value = [], [], [], []
        for index, view in enumerate(views):
            keep.tell(f"brightness {index + 1} of {len(views)}")
            part = _around(view, x[0], y[:, 0])
            if 0 in x[part].shape:  # it shows none of a small area
                continue
            nodes = project_nodes(view, x[part], y[part], z[part])
            r, c = np.nonzero(nodes.seen)
            if not len(r):
                continue
            u, v, seen = nodes.u[r, c], nodes.v[r, c], (r + part[0].start) * x.shape[1]
            seen += c + part[1].start
            point.append(seen.astype(np.int32))
            row.append(np.full(len(seen), index, np.int32))
            place.append(np.stack(image_place(view, u, v), -1).astype(np.float32))
            value.append(
                _sampled(thumbnails[view.photo], u, v, view.camera.width, view.camera.height)
            )
        if not point:
            return Samples(
                point=np.zeros(0, int),
                row=np.zeros(0, int),
                place=np.zeros((0, 2), np.float32),
                value=np.zeros((0, 3), np.float32),
            )
        levels = np.concatenate(value)
        good = ((levels > 8) & (levels < 247)).all(1)
        shown = np.unique(np.concatenate(point)[good], return_inverse=True)[1]
        return Samples(
            point=shown.astype(np.int32),
            row=np.concatenate(row)[good],
            place=np.concatenate(place)[good],
            value=levels[good],
            prior=min(1.0, number / each),
            sought=number,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Brightness of ground points in photos. Of large surveys they fill the memory: they are in
    single precision, sums of them in double.
    """

    point: NDArray[np.int32]
    """(N,) ground point, numbered without gaps."""
    row: NDArray[np.int32]
    """(N,) view."""
    place: Float
    """(N, 2) x and y in the photo, see `image_place`."""
    value: Float
    """(N, bands) brightness."""
    white: float = WHITES[0]
    """Value at which the response is taken to end."""
    prior: float = 1.0
    """Weight of the priors: less where points lie further apart than usual, since their errors are
    less correlated then.
    """
    sought: float = 0.0
    """Ground points that were looked at, also those that no photo shows."""

    @cached_property
    def log(self) -> Float:
        """(N, bands) log odds of the brightness."""
        odds = self.value / (np.float32(self.white) - self.value)
        return np.asarray(np.log(odds, out=odds))

    def under(self, white: float) -> "Samples":
        """The same, of another response."""
        return replace(self, white=white)

    def unmarked(self, views: Sequence[View]) -> "Samples":
        """Those that are not in parts of photos that show marks, smoke or the like."""
        kept = np.ones(len(self.row), bool)
        ends = np.searchsorted(self.row, np.arange(len(views) + 1))  # samples lie photo by photo
        for k, view in enumerate(views):
            if (mark := view.limits.mark) is not None:
                own = slice(ends[k], ends[k + 1])
                kept[own] = mark.at(*image_pixels(view, *self.place[own].T)) > 0
        if kept.all():
            return self
        return replace(
            self,
            point=self.point[kept],
            row=self.row[kept],
            place=self.place[kept],
            value=self.value[kept],
        )

    def field(self, terms: NDArray[Any]) -> Float:
        """(N,) the field of each sample's photo at its place, from terms (n, 6) of the photos."""
        out = np.zeros(len(self.row), np.float32)
        for k, basis in enumerate(_basis(self.place[:, 0], self.place[:, 1]).T):
            out += basis * terms[:, k].astype(np.float32)[self.row]
        return out

    def level(self, exposure: Exposure, views: Sequence[View]) -> Float:
        """(N,) log odds of the grey values, corrected."""
        gains = np.stack([exposure.gains[v.photo] for v in views]).mean(1)
        fields = np.stack([exposure.fields[v.photo] for v in views])
        return np.asarray(self.log.mean(1) + self.field(fields) + gains[self.row])

    def apart(self, exposure: Exposure, views: Sequence[View]) -> float:
        """Median difference from the mean of their point, in levels, of corrected samples: the mean
        of all bands, since white balance changes bands of a photo apart.
        """
        photos = [v.photo for v in views]
        gains = np.stack([exposure.gains[i] for i in photos])
        fields = np.stack([exposure.fields[i] for i in photos])
        field = self.field(fields)
        bands = [
            exposure.brightened(value, np.exp(gains[self.row, k] + field))
            for k, value in enumerate(self.value.T)
        ]
        return float(np.mean([cloud_shadows.apart(self.point, levels) for levels in bands]))


def _clouded(s: Samples, level: Float, photos: int, least: float) -> NDArray[np.bool_]:
    """(photos,) which show moving shadows of clouds: smooth shades explain at least this share of
    what is left between them and others, of samples with these levels (N,).
    """
    shaded = cloud_shadows.explained(s.point, s.row, s.place, level, photos) > least
    return np.asarray(shaded & (shaded.sum() >= cloud_shadows.TOGETHER))


def _around(view: View, x: NDArray[Any], y: NDArray[Any]) -> tuple[slice, slice]:
    """Rows and columns of a grid, x and y ascending in m, that a view may see."""
    low, high = view.footprint.min(0), view.footprint.max(0)
    margin = 0.2 * float((high - low).max())
    rows, columns = (
        slice(*np.searchsorted(along, [low[k] - margin, high[k] + margin]).tolist())
        for k, along in ((1, y), (0, x))
    )
    return rows, columns


def image_place(view: View, u: NDArray[Any], v: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """x and y of photo pixels from the image's centre, in half diagonals of the image."""
    w, h = view.camera.width - 1.0, view.camera.height - 1.0
    half = np.hypot(w, h) / 2
    x, y = (
        np.clip((p - n / 2) / half, -0.55 * n / half, 0.55 * n / half) for p, n in ((u, w), (v, h))
    )
    return x, y


def image_pixels(view: View, x: NDArray[Any], y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Photo columns and rows of places x, y of `image_place`."""
    w, h = view.camera.width - 1.0, view.camera.height - 1.0
    half = np.hypot(w, h) / 2
    return x * half + w / 2, y * half + h / 2


def _corners(view: View) -> tuple[NDArray[Any], NDArray[Any]]:
    """x and y (3, 3) of the image's corners, the middles of its sides and its centre."""
    w, h = view.camera.width - 1.0, view.camera.height - 1.0
    return image_place(view, *np.meshgrid([0, w / 2, w], [0, h / 2, h]))


def _sampled(
    thumbnail: NDArray[np.uint8], u: NDArray[Any], v: NDArray[Any], width: int, height: int
) -> Float:
    """Smoothed thumbnail values (n, bands) at photo pixels."""
    h, w = thumbnail.shape[:2]
    smooth = cv2.GaussianBlur(thumbnail.astype(np.float32), (0, 0), 1.5).reshape(h, w, -1)
    column = np.clip(np.rint((u + 0.5) * w / width - 0.5), 0, w - 1).astype(int)
    row = np.clip(np.rint((v + 0.5) * h / height - 0.5), 0, h - 1).astype(int)
    return np.asarray(smooth[row, column])


def _apart(y: NDArray[Any], pairs: Pairs, ridge: NDArray[Any], *, closely: bool) -> float:
    """Median difference from the mean of their point, in log odds, of samples (N,) after one gain
    for each photo.
    """
    point, ones = pairs.point, np.ones((len(y), 1), np.float32)
    found = robust_differences(ones, pairs, y[:, None], ridge, closely=closely)
    level = y + found[:, 0, 0].astype(y.dtype)[pairs.row]
    return cloud_shadows.apart(point, level)
