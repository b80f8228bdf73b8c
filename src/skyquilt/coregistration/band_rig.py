"""The cameras of a rig relative to each other: a rotation, a place and a lens for each band of a
multispectral camera, or for the thermal camera beside the visual one.

All cameras of a rig are a few centimetres apart and see the same ground, so that the pixels of two
photos of one trigger correspond by a rotation, by the place of one camera beside the other and by
both lenses. These are the same in all photos of a flight. So they are found from patches of many
photos, matched by the directions of edges, which bands have in common although plants are dark in
red and bright in the infrared (`coregistration.orientation`). The lens of the band is fitted with
the rotation: what the lens of the other photos leaves out, it takes up, so that all bands lie on
each other on the map. The place shows in how the shift changes with the depth of the ground: on
level ground it does not, and there the rotation takes up all of it.

Sunlight on rough ground lays edges of brightness beside those of materials, all to one side, while
warmth lies where the sun shone before. So where the map's photos have colours and patches of these
confirm the rig, its rotation is theirs (`coregistration.refine_registration` does so for maps).
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import ceil
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from skyquilt.coregistration.agreement import scores, summit
from skyquilt.coregistration.beside import Beside, Together, oriented, padded, seen_by, turned
from skyquilt.coregistration.orientation import Orientation
from skyquilt.geometry.camera import rays
from skyquilt.imaging.grey import full_px
from skyquilt.model.camera import Camera
from skyquilt.model.photo import evenly
from skyquilt.model.registration import RefusedRegistration

Array = NDArray[np.float64]
_ACROSS = 10
"""Patches along the side of a square of a photo's area."""
_FILLED = 0.6
"""Least share of a patch that both photos must cover."""
_FREE = ("focal", "cx", "cy", "k1", "aspect", "k2", "k3", "p1", "p2")
_OF_ROUND = (0, 4, 6, len(_FREE))
"""How many of these are fitted in each round: what bends the rim most comes last, when the rim is
matched rightly.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class BandRig:
    """The camera of a band relative to that of the map's photos."""

    b_R_a: Array
    """(3, 3) takes camera coordinates of the map's photos to those of the band."""
    a_t_b: Array
    """(3,) where the band's camera is, m along the axes of that of the map's photos."""
    camera: Camera
    """The calibration of the band's camera."""
    delay_s: float
    """How much later than the map's photos it is exposed, s; 0 where nothing tells."""
    pairs: int
    """Pairs of photos from which it was found."""
    agreeing: int
    """Those in which enough patches agree with it."""
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
    nearness: Array
    """(n,) 1 over their depth in m."""
    velocity: Array
    """(n, 3) of the map's camera along its own axes, m/s."""
    ahead: Array
    """(n, 3) `Together.ahead`."""
    pair: NDArray[np.intp]
    """(n,) pair that each was matched in."""
    camera_a: Camera
    """Calibration of the map's photos."""

    def only(self, kept: NDArray[np.bool_]) -> "_Matched":
        """These (n,) of them."""
        names = ("px_a", "px_b", "nearness", "velocity", "ahead", "pair")
        return replace(self, **{n: getattr(self, n)[kept] for n in names})


@dataclass(frozen=True, kw_only=True)
class FindBandRig:
    """Matches patches of pairs of photos at rising resolution, and fits a rotation, a place and a
    lens to all of them.
    """

    sides: tuple[int, ...] = (256, 400, 640, 640)
    """Sides of the squares to whose areas photos are reduced, one round each."""
    reach: tuple[int, ...] = (12, 6, 5, 3)
    """Largest shift in px at that resolution that is looked for."""
    apart: tuple[float, ...] = (1.0, 1.0, 1.0, 0.7)
    """Sides of a patch between neighbours, at most."""
    share: tuple[float, ...] = (0.5, 0.5, 0.5, 1.0)
    """Share of the pairs that are matched: what a round finds, the next ones improve."""
    bends: tuple[float, ...] = (0.0, -0.2, -0.4)
    """What k1 of the lens may be beside what is known of it, for a first round: what a lens bends
    by more than the reach at the rim is not matched there, and is not missed.
    """
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
    sure_px: float = 0.08
    """Median distance in px of a reduced photo of all patches from the rig up to which nothing
    better is looked for."""
    sigma_m: float = 0.05
    """Standard deviation of the distance in m between two cameras along either axis."""
    sigma_s: float = 0.5
    """Standard deviation of the delay in s between two cameras."""
    other_way: float = 0.3
    """Share of the largest velocity by which that of a pair must differ from the mean of all along
    the axes of the camera for a delay to be told from a rotation.
    """
    colours_off: float = 2.0
    """Times the median distance of patches of brightness from the rig that those of colours may lie
    off for these to count. Light lies beside materials by more on rougher ground: where brightness
    is all of one mind, as that of a single camera's bands is, it is not the light's.
    """
    version: ClassVar[int] = 8

    def __call__(
        self,
        pairs: Sequence[Together],
        camera_b: Camera,
        sigma_focal: float,
        start: Beside | None = None,
    ) -> BandRig | RefusedRegistration:
        """The rig, or the reason why there is none.

        `camera_b` is what the files tell of the band's camera, `sigma_focal` the relative standard
        deviation of its focal length; `start`: where it is nearly, if that is known.
        """
        if len(pairs) < self.minimum:
            return RefusedRegistration(
                reason=f"{len(pairs)} of its photos were taken together with one of the map's, and"
                f" {self.minimum} are needed"
            )
        straight = Beside(turn=np.zeros(3), place=np.zeros(2), camera=camera_b)
        fields = cache(lambda k, side: oriented(pairs[k].b, side))
        best = self._from(start or straight, camera_b, pairs, fields, sigma_focal)
        if start is None and (best is None or np.median(best[2]) > self.sure_px):
            other = self._from(turned(pairs, straight), camera_b, pairs, fields, sigma_focal)
            if other is not None and (best is None or self._agree(other[2]) > self._agree(best[2])):
                best = other
        if best is None:
            return RefusedRegistration(reason="its photos and the map's have nothing in common")
        there, found, off = best
        agree = off < self.agree_px
        if agree.mean() < self.least_share:
            return RefusedRegistration(
                reason=f"{agree.mean():.0%} of the patches of its photos agree on one camera beside"
                " that of the map's photos"
            )
        exact = self._by_colours(best, pairs, camera_b, fields, sigma_focal)
        return BandRig(
            b_R_a=exact.R,
            a_t_b=np.array([*exact.place, 0.0]),
            camera=exact.camera,
            delay_s=exact.delay_s,
            pairs=len(pairs),
            agreeing=sum(
                bool(agree[found.pair == k].mean() >= self.least_share)
                for k in np.unique(found.pair)
            ),
            patches=int(agree.sum()),
            share=float(agree.mean()),
            off_px=self._kept_out(found, there, camera_b, sigma_focal),
        )

    def _round(self, step: int) -> tuple[tuple[str, ...], int]:
        """What of the lens a round fits, and the side that photos are reduced to in it."""
        return _FREE[: _OF_ROUND[step]], self.sides[step]

    def _ways_differ(self, pairs: Sequence[Together]) -> bool:
        """Whether the map's camera was flown in several ways along its own axes (it does not turn
        with the lines), so that a delay is not the same as a rotation.
        """
        v = np.array([pair.velocity for pair in pairs])
        apart = np.linalg.norm(v - v.mean(0), axis=1)
        return bool(apart.max() > self.other_way * np.linalg.norm(v, axis=1).max())

    def _from(
        self,
        there: Beside,
        told: Camera,
        pairs: Sequence[Together],
        fields: Callable[[int, int], Orientation],
        sigma_focal: float,
    ) -> tuple[Beside, _Matched, Array] | None:
        """The camera that is found from a first one, the patches of the last round, and how far
        they are off in px of a reduced photo; None where none were matched. `fields`: those of the
        band's photo of a pair, reduced to a side.
        """
        late, starts = self._ways_differ(pairs), [_bent(there, k1) for k1 in self.bends]
        for step, (side, reach, apart) in enumerate(
            zip(self.sides, self.reach, self.apart, strict=True)
        ):
            share = 1.0 if late else self.share[step]  # of all ways that are flown
            few = evenly(len(pairs), max(self.minimum, ceil(share * len(pairs))))
            seen = [(k, pairs[k], fields(k, side)) for k in few]
            best: tuple[Beside, _Matched, Array] | None = None
            for start in starts:
                found = self._matched(seen, start, reach, apart)
                if len(found.px_a):
                    fits = self._fitted(found, start, told, self._round(step), sigma_focal, late)
                    off = np.nan_to_num(_off(found, fits) / _scale(told, side), nan=np.inf)
                    if best is None or self._agree(off) > self._agree(best[2]):
                        best = fits, found, off
            if best is None:
                return None
            starts = [best[0]]
        return best

    def _by_colours(
        self,
        best: tuple[Beside, _Matched, Array],
        pairs: Sequence[Together],
        told: Camera,
        fields: Callable[[int, int], Orientation],
        sigma_focal: float,
    ) -> Beside:
        """The camera turned to where colours have it; as brightness has it (`best`) where patches
        do not confirm that, or agree on it far less closely than those of brightness do.
        """
        there, _, by_light = best
        side = self.sides[-1]
        seen = [(k, p, fields(k, side)) for k, p in enumerate(pairs) if p.colours is not None]
        if len(seen) < self.minimum:
            return there
        found = self._matched(seen, there, self.reach[-1], self.apart[-1], coloured=True)
        if not len(found.px_a):
            return there
        late = there.delay_s != 0
        turned_ = self._fitted(found, there, told, ((), side), sigma_focal, late)
        off = _off(found, turned_) / _scale(told, side)
        close = np.median(off) < self.colours_off * np.median(by_light)
        return turned_ if close and (off < self.agree_px).mean() >= self.least_share else there

    def _agree(self, off: Array) -> int:
        """How many patches, off by px (n,) of a reduced photo, agree with a rig."""
        return int((off < self.agree_px).sum())

    def _matched(
        self,
        pairs: Sequence[tuple[int, Together, Orientation]],
        there: Beside,
        reach: int,
        apart: float,
        *,
        coloured: bool = False,
    ) -> _Matched:
        """Patches of pairs (with their index, and the fields of the band's photo), matched around
        where the camera so far has them; `coloured`: by the colours of the map's photos.
        """
        rows = []
        for k, pair, b in pairs:
            small = there.reduced(b.shape)
            a = seen_by(pair, there, b.shape, coloured=coloured)
            px, shift = shifts(a, b, reach, apart)
            full = there.camera.height, there.camera.width
            px_b = full_px(px + shift, b.shape, full)
            px_a, near = there.in_photo(px, small, pair)
            velocity = np.broadcast_to(pair.velocity, (len(px_a), 3))
            ahead = np.broadcast_to(pair.ahead, (len(px_a), 3))
            rows.append((px_a, px_b, near, velocity, ahead, np.full(len(px_a), k, np.intp)))
        px_a, px_b, near, velocity, ahead, pair_ = (
            np.concatenate([row[n] for row in rows]) for n in range(6)
        )
        return _Matched(
            px_a=px_a,
            px_b=px_b,
            nearness=near,
            velocity=velocity,
            ahead=ahead,
            pair=pair_,
            camera_a=pairs[0][1].camera_a,
        )

    def _fitted(
        self,
        found: _Matched,
        start: Beside,
        told: Camera,
        round_: tuple[tuple[str, ...], int],
        sigma_focal: float,
        late: bool,
    ) -> Beside:
        """The camera that fits best in a round (what of its lens is fitted, and the side that
        photos are reduced to); `late`: and its delay.
        """
        free, side = round_
        sigma = self.scatter_px * _scale(told, side)
        spread = _deviations(told, sigma_focal)
        ray_a = rays(found.camera_a, found.px_a)

        def camera(x: Array) -> Beside:
            changed: dict[str, Any] = dict(zip(free, map(float, x[6:]), strict=True))
            lens = replace(start.camera, **changed)
            delay = float(x[5]) if late else start.delay_s
            return Beside(turn=x[:3], place=x[3:5], camera=lens, delay_s=delay)

        def misfit(x: Array) -> Array:
            # what is far off counts like what is three deviations off
            px_b = camera(x).sees(ray_a, found.nearness, found.velocity, found.ahead)
            off = np.nan_to_num(px_b - found.px_b, nan=1e3) / sigma
            length = np.linalg.norm(off, axis=1, keepdims=True)
            weight = np.sqrt(np.log1p((length / 2) ** 2) / np.maximum((length / 2) ** 2, 1e-12))
            prior = [(x[6 + k] - getattr(told, n)) / spread[n] for k, n in enumerate(free)]
            beside = [*x[3:5] / self.sigma_m, x[5] / self.sigma_s]
            return np.concatenate([(off * weight).ravel(), beside, prior])

        lens = [getattr(start.camera, n) for n in free]
        first = [*start.turn, *start.place, start.delay_s, *lens]
        unit = [1e-3] * 3 + [self.sigma_m] * 2 + [self.sigma_s] + [spread[n] for n in free]
        best = least_squares(misfit, np.array(first), x_scale=unit, method="trf", max_nfev=60).x
        return camera(np.asarray(best))

    def _kept_out(self, found: _Matched, there: Beside, told: Camera, sigma_focal: float) -> float:
        """Median distance of the patches of each half of the pairs from the rig of the other."""
        off = []
        for half in (0, 1):
            part, rest = (found.only(k) for k in (found.pair % 2 == half, found.pair % 2 != half))
            if len(part.px_a) and len(rest.px_a):
                last, late = self._round(len(_OF_ROUND) - 1), there.delay_s != 0
                off.append(_off(part, self._fitted(rest, there, told, last, sigma_focal, late)))
        return float(np.median(np.concatenate(off))) if off else float("nan")


def _bent(there: Beside, k1: float) -> Beside:
    """The camera with another k1 by so much."""
    return replace(there, camera=replace(there.camera, k1=there.camera.k1 + k1))


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


def shifts(a: Orientation, b: Orientation, reach: int, apart: float) -> tuple[Array, Array]:
    """Centres (n, 2) in px of patches that a and b (h, w) cover, from edge to edge, and the shift
    (n, 2) at which b's content lies where a has it; without those shifted by `reach`.
    """
    height, width = b.shape
    side = int(np.sqrt(height * width) / _ACROSS)
    tops, lefts = (
        np.linspace(0, n - side, 1 + ceil((n - side) / (apart * side))).astype(int)
        for n in (height, width)
    )
    fields = padded(a.fields, reach)
    both, found = a.valid * b.valid, []
    for top, left in itertools.product(tops, lefts):
        part = (slice(top, top + side), slice(left, left + side))
        if both[part].mean() < _FILLED:
            continue
        around = fields[top : top + side + 2 * reach, left : left + side + 2 * reach]
        x, y = summit(scores(around, b.fields[part] * both[part][..., None]))
        if max(abs(reach - x), abs(reach - y)) < reach - 0.5:
            found.append((left + (side - 1) / 2, top + (side - 1) / 2, reach - x, reach - y))
    table = np.array(found, np.float64).reshape(-1, 4)
    return table[:, :2], table[:, 2:]


def _off(found: _Matched, there: Beside) -> Array:
    """(n,) distance in px of the band between places and where a camera has them."""
    ray_a = rays(found.camera_a, found.px_a)
    px = there.sees(ray_a, found.nearness, found.velocity, found.ahead)
    return np.asarray(np.linalg.norm(px - found.px_b, axis=1))
