"""The cameras of a multispectral rig relative to each other: a rotation and a lens for each band.

All cameras of a rig are a few centimetres apart, so that, seen from a drone, the pixels of two
photos of one trigger correspond by a rotation and by both lenses, whatever the relief of the
ground. Both are the same in all photos of a flight. So they are found from patches of many photos,
matched by the directions of edges, which bands have in common although plants are dark in red and
bright in the infrared (`coregistration.orientation`). The lens of the band is fitted with the
rotation: what the lens of the other photos leaves out, it takes up, so that all bands lie on each
other on the map.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from skyquilt.coregistration.agreement import Agree
from skyquilt.coregistration.orientation import Orientation, orientation
from skyquilt.geometry.camera import project, rays
from skyquilt.geometry.frames import rotation_from_vector
from skyquilt.model.camera import Camera
from skyquilt.model.registration import RefusedRegistration

Array = NDArray[np.float64]
_NODE = 16
"""Pixels of a reduced photo between the nodes at which a photo is projected into the other."""
_FREE = ("focal", "cx", "cy", "k1", "aspect", "k2", "k3", "p1", "p2")
_OF_ROUND = (0, 4, 6, len(_FREE))
"""How many of these are fitted in each round: what bends the rim most comes last, when the rim is
matched rightly.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Together:
    """Two photos of one trigger."""

    a: NDArray[np.uint8]
    """(H, W) the photo of the map, grey, reduced or not."""
    camera_a: Camera
    """Its calibration, of its full size."""
    b: NDArray[np.uint8]
    """(h, w) the photo of the band, grey, reduced or not."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BandRig:
    """The camera of a band relative to that of the map's photos."""

    b_R_a: Array
    """(3, 3) takes camera coordinates of the map's photos to those of the band."""
    camera: Camera
    """The calibration of the band's camera."""
    pairs: int
    """Pairs of photos from which it was found."""
    patches: int
    """Patches that agree with it."""
    share: float
    """Their share of all patches that were matched."""
    off_px: float
    """Median distance in px of the band between the patches of every other pair and where a rig
    found from the remaining pairs has them; scatter of the matches included.
    """


@dataclass(frozen=True, kw_only=True, eq=False)
class _Matched:
    """Places that correspond, over all pairs."""

    px_a: Array
    """(n, 2) px of the map's photos at full size."""
    px_b: Array
    """(n, 2) px of the band at full size."""
    pair: NDArray[np.intp]
    """(n,) pair that each was matched in."""
    camera_a: Camera
    """Calibration of the map's photos."""


@dataclass(frozen=True, kw_only=True)
class FindBandRig:
    """Matches patches of pairs of photos at rising resolution, and fits a rotation and a lens to
    all of them.
    """

    sides: tuple[int, ...] = (256, 400, 640, 640)
    """Sides of the squares to whose areas photos are reduced, one round each."""
    reach: tuple[int, ...] = (12, 6, 5, 3)
    """Largest shift in px at that resolution that is looked for."""
    scatter_px: float = 0.3
    """Scatter of a match in px of a reduced photo, beyond which its weight falls."""
    agree_px: float = 1.0
    """Largest distance in px of a reduced photo at which a patch agrees with the rig."""
    least_share: float = 0.3
    """Least share of the patches that must agree in the end: a tenth do by chance, and on water no
    more than that.
    """
    minimum: int = 3
    """Fewest pairs of photos."""
    version: ClassVar[int] = 2

    def __call__(
        self, pairs: Sequence[Together], camera_b: Camera, sigma_focal: float
    ) -> BandRig | RefusedRegistration:
        """The rig, or the reason why there is none.

        `camera_b` is what the files tell of the band's camera, `sigma_focal` the relative standard
        deviation of its focal length.
        """
        if len(pairs) < self.minimum:
            return RefusedRegistration(
                reason=f"{len(pairs)} of its photos were taken together with one of the map's, and"
                f" {self.minimum} are needed"
            )
        turn, camera = np.zeros(3), camera_b
        known: dict[tuple[int, int], Orientation] = {}
        for step, (side, reach) in enumerate(zip(self.sides, self.reach, strict=True)):
            found = self._matched(pairs, turn, camera, side, reach, known)
            scale = _scale(camera_b, side)
            if not len(found.px_a):
                return RefusedRegistration(reason="its photos and the map's have nothing in common")
            turn, camera = self._fitted(found, turn, camera, camera_b, step, scale, sigma_focal)
        off = _off(found, turn, camera) / scale
        agree = off < self.agree_px
        if agree.mean() < self.least_share:
            return RefusedRegistration(
                reason=f"{agree.mean():.0%} of the patches of its photos agree on one camera beside"
                " that of the map's photos"
            )
        return BandRig(
            b_R_a=rotation_from_vector(turn),
            camera=camera,
            pairs=len(pairs),
            patches=int(agree.sum()),
            share=float(agree.mean()),
            off_px=self._kept_out(found, turn, camera, camera_b, scale, sigma_focal),
        )

    def _matched(
        self,
        pairs: Sequence[Together],
        turn: Array,
        camera: Camera,
        side: int,
        reach: int,
        known: dict[tuple[int, int], Orientation],
    ) -> _Matched:
        """Patches of all pairs, matched around where the rig so far has them."""
        agree = Agree(across=(10,), reach=reach, near=1)
        R, rows = rotation_from_vector(turn), []
        for k, pair in enumerate(pairs):
            b = known.setdefault((k, side), _oriented(pair.b, side))
            small = _small(camera, b)
            seen, valid = _seen(pair, R, small, b.shape)
            a = orientation(seen, valid, float(np.sqrt(seen.size)), quick=True)
            shifts = agree.shifts(a, b, np.eye(3))
            within = np.abs(shifts.shift).max(1, initial=0) < reach - 0.5
            px_b = _full(shifts.px + shifts.shift, small, camera)[within]
            px_a = _there(shifts.px[within], R, small, pair.camera_a)
            rows.append((px_a, px_b, np.full(len(px_a), k, np.intp)))
        px_a, px_b, pair_ = (np.concatenate([row[n] for row in rows]) for n in range(3))
        return _Matched(px_a=px_a, px_b=px_b, pair=pair_, camera_a=pairs[0].camera_a)

    def _fitted(
        self,
        found: _Matched,
        turn: Array,
        camera: Camera,
        told: Camera,
        step: int,
        scale: float,
        sigma_focal: float,
    ) -> tuple[Array, Camera]:
        """Rotation vector and lens that fit best; `scale`: px of the band for one of the reduced
        photos.
        """
        free = _FREE[: _OF_ROUND[step]]
        sigma = self.scatter_px * scale
        spread = _deviations(told, sigma_focal)
        ray_a = rays(found.camera_a, found.px_a)

        def lens(x: Array) -> Camera:
            changed: dict[str, Any] = dict(zip(free, map(float, x[3:]), strict=True))
            return replace(camera, **changed)

        def misfit(x: Array) -> Array:
            there = project(lens(x), ray_a @ rotation_from_vector(x[:3]).T)
            # what is far off counts like what is three deviations off
            off = np.nan_to_num(there - found.px_b, nan=1e3) / sigma
            length = np.linalg.norm(off, axis=1, keepdims=True)
            weight = np.sqrt(np.log1p((length / 2) ** 2) / np.maximum((length / 2) ** 2, 1e-12))
            prior = [(x[3 + k] - getattr(told, n)) / spread[n] for k, n in enumerate(free)]
            return np.concatenate([(off * weight).ravel(), prior])

        start = np.concatenate([turn, [getattr(camera, n) for n in free]])
        unit = np.array([1e-3, 1e-3, 1e-3, *(spread[n] for n in free)])
        best = least_squares(misfit, start, x_scale=unit, method="trf", max_nfev=60).x
        return np.asarray(best[:3]), lens(best)

    def _kept_out(
        self,
        found: _Matched,
        turn: Array,
        camera: Camera,
        told: Camera,
        scale: float,
        sigma_focal: float,
    ) -> float:
        """Median distance of the patches of each half of the pairs from the rig of the other."""
        off = []
        for half in (0, 1):
            here = found.pair % 2 == half
            part, rest = (
                replace(found, px_a=found.px_a[k], px_b=found.px_b[k], pair=found.pair[k])
                for k in (here, ~here)
            )
            if not len(part.px_a) or not len(rest.px_a):
                continue
            of_rest = self._fitted(rest, turn, camera, told, len(_OF_ROUND) - 1, scale, sigma_focal)
            off.append(_off(part, *of_rest))
        return float(np.median(np.concatenate(off))) if off else float("nan")


def _deviations(told: Camera, sigma_focal: float) -> dict[str, float]:
    """Standard deviations of what the lens of a band differs by from what files tell. They are
    wide: the lens takes up errors of the map's own lens, too.
    """
    return {
        "focal": max(sigma_focal, 0.02) * told.focal,
        "cx": 0.02 * told.width,
        "cy": 0.02 * told.width,
        "k1": 0.1,
        "k2": 0.1,
        "k3": 0.03,
        "p1": 0.001,
        "p2": 0.001,
        "aspect": 0.01,
    }


def _scale(camera: Camera, side: int) -> float:
    """Pixels of a photo for one of it reduced to the area of a square of a side."""
    return max(1.0, float(np.sqrt(camera.width * camera.height)) / side)


def _oriented(grey: NDArray[np.uint8], side: int) -> Orientation:
    return orientation(grey.astype(np.float32), np.ones(grey.shape, np.bool_), side, quick=True)


def _small(camera: Camera, reduced: Orientation) -> Camera:
    """The lens on a reduced photo."""
    height, width = reduced.shape
    return camera.rescaled(width, height)


def _full(px: Array, small: Camera, full: Camera) -> Array:
    """Places (n, 2) of a reduced photo in px of the full one."""
    scale = max(full.width, full.height) / max(small.width, small.height)
    return np.asarray((px + 0.5) * scale - 0.5)


def _there(px: Array, R: Array, small: Camera, camera_a: Camera) -> Array:
    """Places (n, 2) of a reduced band in px of the full photo of the map; NaN where it does not see
    them.
    """
    return np.asarray(project(camera_a, rays(small, px) @ R))


def _seen(
    pair: Together, R: Array, small: Camera, shape: tuple[int, int]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """The photo of the map as the reduced band (h, w) sees it, and where it shows anything."""
    h, w = shape
    rows, columns = (np.arange(0, n + _NODE, _NODE, dtype=np.float64) for n in (h, w))
    x, y = np.meshgrid(columns, rows)
    there = _there(np.c_[x.ravel(), y.ravel()], R, small, pair.camera_a).reshape(*x.shape, 2)
    scale = max(pair.a.shape) / max(pair.camera_a.width, pair.camera_a.height)
    there = ((there + 0.5) * scale - 0.5).astype(np.float32)
    # nodes of an enlarged image, whose corners lie at the first and the last node
    map_x, map_y = np.meshgrid(
        np.arange(w, dtype=np.float32) / _NODE, np.arange(h, dtype=np.float32) / _NODE
    )
    u, v = (
        cv2.remap(np.ascontiguousarray(there[..., k]), map_x, map_y, cv2.INTER_LINEAR)
        for k in (0, 1)
    )
    source: NDArray[Any] = pair.a
    finer = max(pair.a.shape) / max(h, w) / 1.1
    if finer > 1.5:  # as fine as the band, or fine structure would be aliased
        source = cv2.GaussianBlur(pair.a, (0, 0), 0.4 * finer)
    seen = cv2.remap(source, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    height, width = pair.a.shape
    valid = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    return seen.astype(np.float32), valid


def _off(found: _Matched, turn: Array, camera: Camera) -> Array:
    """(n,) distance in px of the band between places and where a rig has them."""
    R = rotation_from_vector(turn)
    there = project(camera, rays(found.camera_a, found.px_a) @ R.T)
    return np.asarray(np.linalg.norm(there - found.px_b, axis=1))
