"""The kind of a lens, found in what photos have in common: pinhole or fisheye.

A pinhole shows a ray at the tangent of its angle from the axis, a fisheye at the angle itself.
Metadata rarely tell which one a camera has. Photos of the same ground do: seen through a pinhole
they differ by nearly a homography, and read with the wrong kind of lens they do not.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.camera import rays, undistort
from skyquilt.geometry.transforms import fit, transfer
from skyquilt.matching.sphere_epipolar import agreeing
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link

Px = NDArray[np.float64]

WIDE_RAD = 0.7
"""Angle of a picture's corner from the axis in rad, by the focal length and read as a fisheye's,
from which a lens may be one: below 40 degrees the two kinds differ by no more than a lens's
distortion.
"""
LOOKED_AT = 8
"""Links of a camera that are looked at, spread over the survey."""
FEWEST = 3
"""Links that can tell the kind of a lens."""
SUSPECT = 0.9
"""Residuals from homographies as a fisheye over those as a pinhole, in the median of links, below
which matches are counted; above it a lens is a pinhole's, whose ratios are above 1.
"""
EVIDENT = 0.6
"""The same below which a lens is a fisheye's unless more matches agree closely with a pinhole: 0.2
to 0.5 is usual for fisheyes, and over relief of a seventh of the height 0.6 to 0.8. But the top of
a steep hill bends pictures alike: pinholes of 73 and 84 degrees 100 m above one of 200 and 100 m
have 0.52 and 0.28.
"""
MORE = 1.06
"""So many times as many matches must agree with a fisheye: 1.04 to 1.3 times as many do for
fisheyes of 118 to 153 degrees, at most as many for pinholes.
"""
CERTAIN = 20
"""And at least so many more."""
PLAIN = 2.0
"""The same from which a lens is a pinhole's whatever else."""
STRAIGHT = 1.5
"""So many times as many inliers as their links have must consecutive photos share through a
fisheye, with pictures that are straightened as such, where they are hardly linked.
"""
FOCALS = (1.0, 0.8, 0.65)
"""Multiples of the reported focal length that are tried: a guess may be far off, and 35 mm
equivalents of fisheyes are given by the field of view as well as by the focal length.
"""
ASKED = 300
"""Matches of a pair of which it is asked with which kind of lens they agree closely."""
SIGMA_FOCAL = 0.2
"""Relative deviation of the focal length after that."""
COUNTED_PX = 1.0
"""Tolerance of the matches that are counted, in px of the picture that was searched."""
CLOSE_PX = 0.15
"""The same for matches that agree closely. So many times as many agree with a fisheye: 1.08 to 1.28
for fisheyes of 84 to 118 degrees, over a steep hill too, 0.82 to 0.95 for pinholes over steep hills
or with as much distortion as a fisheye.
"""
TOLERANCE_PX = 2.0
"""Of matches that agree, in px of the picture that was searched for features: lenses that are taken
for those of a kind differ from it.
"""
SIGMA_RADIAL = (0.1, 0.05, 0.02)
"""Deviations of a fisheye's k1, k2, k3: between an orthographic (k1 = -0.17), an equal-area (-0.04)
and a stereographic projection (0.08) lie all lenses in use.
"""


def as_pinhole(lens: Camera, px: NDArray[np.floating]) -> NDArray[np.floating]:
    """Where a pinhole with the same focal length and principal point shows what a fisheye shows at
    px (n, 2); unchanged where the lens is no fisheye.
    """
    return straight(lens, px) if lens.fisheye else px


def straight(lens: Camera, px: NDArray[np.floating]) -> Px:
    """Pixels (n, 2) where a pinhole with the same focal length and principal point shows them."""
    lengths = lens.focal * np.array([1.0, lens.aspect])
    return np.asarray(undistort(lens, np.asarray(px, np.float64)) * lengths + (lens.cx, lens.cy))


def unit_rays(lens: Camera, px: Px) -> Px:
    """Directions (N, 3) of unit length in camera coordinates of pixels (N, 2)."""
    found = rays(lens, px)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def as_fisheye(lens: Camera, multiple: float = 1.0) -> Camera:
    """A fisheye whose focal length is that of a lens times a factor, as far as no more is known."""
    focal, wide = lens.focal * multiple, max(lens.width, lens.height)
    ideal = Camera.ideal(width=lens.width, height=lens.height, focal=focal)
    lengths = (SIGMA_FOCAL * focal, 0.01 * wide, 0.01 * wide)
    return replace(ideal, fisheye=1.0, sigmas=(*lengths, *SIGMA_RADIAL, 2e-3, 2e-3, 3e-3, 0.0))


def may_be_fisheye(lens: Camera) -> bool:
    """Whether nothing tells the kind of a lens, and it is wide enough for the question."""
    corner = np.hypot(lens.width, lens.height) / 2
    told = bool(lens.vector[3:8].any() or lens.fisheye)
    return not told and corner > WIDE_RAD * lens.focal


def fisheye_note(camera: str) -> str:
    """What a user should know of a camera that proved to have a fisheye."""
    return (
        f"The lens of {camera} bends pictures as a fisheye's does, as they show where they"
        " overlap; it is adjusted as one."
    )


Matched = Callable[[int, int], tuple[Px, Px]]
"""Places (n, 2) in px of the matches of two photos (numbers), in each."""


Shared = Callable[[int, int, Camera], int]
"""Inliers of two photos (numbers) whose pictures are straightened as those of such a fisheye."""


def fisheyes(
    cameras: Mapping[int, str],
    asked: Mapping[str, Camera],
    features: Callable[[int], Features],
    links: Sequence[Link],
    tried: Sequence[tuple[int, int]],
    matched: Matched,
    shared: Shared | None = None,
) -> dict[str, Camera]:
    """The lenses of cameras that prove to have a fisheye, among those `asked`, with their reported
    lenses. `cameras`: of each photo by its number, as `features` are; `links`: as found with
    pinholes; `tried`: all pairs that were compared, by which a camera is judged that has hardly
    a link. With `shared`, it is asked of cameras with fewer links than photos, too.
    """
    found = {}
    for key, lens in asked.items():
        own = {i for i, camera in cameras.items() if camera == key}
        linked = [k for k in links if k.a in own and k.b in own]
        some = [linked[n] for n in _spread(len(linked))]
        pairs, straighter, multiple = [(k.a, k.b) for k in some], EVIDENT, 1.0
        if len(some) < FEWEST:
            inside = [pair for pair in tried if pair[0] in own and pair[1] in own]
            pairs = [inside[n] for n in _spread(len(inside))]
        else:
            straighter, multiple = _straighter(lens, features, some)
        fisheye = None
        if straighter < SUSPECT:
            px, scale = [matched(*pair) for pair in pairs], features(min(own)).scale
            fisheye = (
                _unless_closer(lens, multiple, px, scale)
                if straighter < EVIDENT
                else _judged(lens, px, scale)
            )
        unsure = fisheye is None and straighter < PLAIN and len(linked) < len(own)
        if unsure and shared is not None:
            fisheye = _shown_straight(lens, sorted(own), linked, shared)
        if fisheye is not None:
            found[key] = fisheye
    return found


def _shown_straight(
    lens: Camera, own: Sequence[int], links: Sequence[Link], shared: Shared
) -> Camera | None:
    """The fisheye through which consecutive photos share most, if clearly more than their links."""
    pairs = [(own[n], own[n + 1]) for n in _spread(len(own) - 1)]
    linked = sum(len(k) for k in links if (k.a, k.b) in pairs)
    bent = [as_fisheye(lens, m) for m in FOCALS]
    counts = [sum(shared(*pair, c) for pair in pairs) for c in bent]
    best = int(np.argmax(counts))
    return bent[best] if counts[best] >= max(STRAIGHT * linked, linked + CERTAIN) else None


def _spread(count: int, most: int = LOOKED_AT) -> list[int]:
    """At most so many of `count` numbers, evenly."""
    where = np.linspace(0, count - 1, min(count, most)).astype(int)
    return [int(n) for n in np.unique(where)]


def _straighter(
    lens: Camera, features: Callable[[int], Features], links: Iterable[Link]
) -> tuple[float, float]:
    """Residuals of matches from a homography when read as a fisheye's, over those as a pinhole's,
    in the median of links; and the multiple of the focal length for which they are least.
    """
    bent = [as_fisheye(lens, m) for m in FOCALS]
    ratios = []
    for link in links:
        a, b = features(link.a).px[link.index_a], features(link.b).px[link.index_b]
        plain = max(_residual(a, b), 1e-9)
        ratios.append(
            [_residual(straight(c, a), straight(c, b)) / _stretch(c, b) / plain for c in bent]
        )
    least = np.median(ratios, axis=0)
    return float(least.min()), FOCALS[int(least.argmin())]


def _residual(a: Px, b: Px) -> float:
    """Median distance in px of matches (n, 2) from their homography."""
    H = fit("homography", a, b)
    if H is None:
        return np.inf
    return float(np.median(np.linalg.norm(transfer(H, a) - b, axis=1)))


def _stretch(camera: Camera, px: Px) -> float:
    """By how much places px (n, 2) of a fisheye are drawn apart where a pinhole shows them: the
    root of the change of areas, in the median.
    """
    angle = np.linalg.norm(px - (camera.cx, camera.cy), axis=1) / camera.focal
    angle = np.clip(angle, 1e-6, 1.4)
    return float(np.median(np.sqrt(np.tan(angle) / angle) / np.cos(angle)))


def _agreeing(lens: Camera, pairs: Sequence[tuple[Px, Px]], px: float) -> tuple[list[int], int]:
    """How many matches of pairs agree within px with a fisheye, for each of the focal lengths, and
    with a pinhole of the one that most agree with.
    """

    def count(kind: Camera) -> int:
        agree = (
            agreeing(unit_rays(kind, a), unit_rays(kind, b), px / kind.focal) for a, b in pairs
        )
        return sum(int(mask.sum()) for mask in agree)

    bent = [as_fisheye(lens, m) for m in FOCALS]
    return [count(c) for c in bent], max(count(replace(c, fisheye=0.0)) for c in bent)


def _unless_closer(
    lens: Camera, multiple: float, pairs: Sequence[tuple[Px, Px]], scale: float
) -> Camera | None:
    """The fisheye of a multiple of the focal length, unless more matches of pairs agree closely
    with a pinhole.
    """
    few = [(a[some], b[some]) for a, b in pairs for some in [_spread(len(a), ASKED)]]
    counts, pinhole = _agreeing(lens, few, CLOSE_PX * scale)
    return as_fisheye(lens, multiple) if max(counts) >= pinhole else None


def _judged(lens: Camera, pairs: Sequence[tuple[Px, Px]], scale: float) -> Camera | None:
    """The fisheye with which most matches of pairs agree, if clearly more than with a pinhole of
    any of the same focal lengths.
    """
    counts, pinhole = _agreeing(lens, pairs, COUNTED_PX * scale)
    best = int(np.argmax(counts))
    if counts[best] < max(MORE * pinhole, pinhole + CERTAIN):
        return None
    return as_fisheye(lens, FOCALS[best])
