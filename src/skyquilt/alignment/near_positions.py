"""Photos taken so near to each other, for the errors of their positions, that these hardly tell how
large the map is and where its north lies: a pair, a hover, a panorama, a handful of photos. Heights
above take-off and reported headings tell it besides.

Receivers whose errors last longer than such a flight tell distances far better than each position.
Which kind a receiver is shows in how well positions lie as the photos do, and in how well they
agree with heights and headings: both kinds are weighed by how likely they make the differences.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.start import common_angle_deg
from skyquilt.geometry.frames import angles_from_cam_R_map
from skyquilt.model.poses import Alignment, Prior

LOOSE_SCALE, LOOSE_DEG = 0.05, 5.0
"""Deviations of the map's scale, as a share, and of its direction; where positions leave them
larger, heights and headings count besides.
"""
EVEN = 0.05
"""Deviation of the height of the place of take-off against level ground, and of the height above it
that is reported, as a share of that height.
"""
MOST_LOOSER = 3.0
"""The ground's scale is taken for so many times less certain than the positions' at most: those of
RTK are not given up for heights above take-off.
"""
CONTRADICTED = 3.5
"""Heights and headings that contradict the positions by more deviations are not used: the place of
take-off lies elsewhere, or files were turned.
"""
GROUND = 0.4
"""Share of the tie points that lie below the ground's height: some lie on what stands there."""
LASTING_M = 0.2
"""Deviation in m of a position to others of the same flight where the receiver's errors last."""
ALIKE_DEG = 30.0
"""Reported headings are off by one angle if most are off by about as much."""


def told_besides(found: Alignment, priors: Sequence[Prior], ground_m: float) -> Alignment:
    """An alignment without control points, enlarged and turned about the middle of its photos by
    what heights above take-off (`ground_m`: its height in the frame; NaN = not known) and headings
    tell of it, where positions hardly do. Each counts by its deviation. The shape, and what the
    pictures show, stay.
    """
    held = [i for i in found.held if np.isfinite(priors[i].map_C[:2]).all()]
    high = [i for i in held if np.isfinite(priors[i].map_C[2])]
    if found.control or found.frame.crs is None or not high:
        return found
    scale = _scale(found, priors, held, high, ground_m)
    heading = _heading(found, priors, held)
    if not scale and not heading:
        return found
    if scale and found.accuracy is not None:
        accuracy = replace(found.accuracy, sigma_m=scale.narrowed * found.accuracy.sigma_m)
        found = replace(found, accuracy=accuracy)
    a = heading.change if heading else 0.0
    turn = np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])
    middle = np.mean([found.poses[i].map_C for i in held], axis=0)
    found = found.carried(turn, 1 + scale.change if scale else 1.0, middle)
    says = [told.note for told in (scale, heading) if told and told.note]
    return replace(found, notes=(*found.notes, *says))


@dataclass(frozen=True)
class _Told:
    """What metadata tell of a map besides its positions."""

    note: str
    """What the user should know; empty where positions tell enough."""
    change: float = 0.0
    """Of the scale, as a share; of the direction, rad clockwise."""
    narrowed: float = 1.0
    """Deviations after the change over those before."""


def _loose(
    found: Alignment, priors: Sequence[Prior], held: Sequence[int], axes: int
) -> NDArray[np.float64]:
    """Deviations of what the positions tell by their first axes: with three of the scale, as a
    share, with two of the direction, in rad; as stated, and where the receiver's errors last.
    """
    C = np.array([found.poses[i].map_C for i in held])
    sigma = np.array([priors[i].sigma_C for i in held])
    sigma[~np.isfinite([priors[i].map_C for i in held])] = np.inf
    reach = C - np.average(C, axis=0, weights=sigma[:, 0] ** -2)
    stated, lasting = (
        float(((reach / by)[:, :axes] ** 2).sum()) for by in (sigma, np.minimum(sigma, LASTING_M))
    )
    return 1 / np.sqrt(np.maximum([stated, lasting], 1e-6))


def _kinds(found: Alignment, priors: Sequence[Prior], held: Sequence[int]) -> NDArray[np.float64]:
    """Log-likelihoods (2,) of how positions lie against the photos, but for a similarity in the
    plane: with their stated deviations, and where the receiver's errors last.
    """
    x = np.array([found.poses[i].map_C[:2] for i in held]) @ (1, 1j)
    y = np.array([priors[i].map_C[:2] for i in held]) @ (1, 1j)
    stated = np.array([priors[i].sigma_C[0] for i in held])
    return np.array([_likely(x, y, by) for by in (stated, np.minimum(stated, LASTING_M))])


def _likely(
    x: NDArray[np.complex128], y: NDArray[np.complex128], sigma: NDArray[np.float64]
) -> float:
    """Log-likelihood of y (n,), of a deviation (n,) per axis, as a similarity of x (n,), but for
    a constant; nothing is told by two.
    """
    w = sigma**-2
    x, y = x - np.average(x, weights=w), y - np.average(y, weights=w)
    off = y - x * (w @ (np.conj(x) * y)) / max(float(w @ np.abs(x) ** 2), 1e-12)
    free = max(len(x) - 2, 0)
    return float(-2 * free * np.log(sigma).mean() - w @ np.abs(off) ** 2 / 2)


def _loose_ground(found: Alignment, held: Sequence[int]) -> float:
    """Deviation of the scale of the ground, as a share, as that of its points tells: lines of
    sight that meet at small angles leave it less certain than the positions.
    """
    if found.accuracy is None:
        return 0.0
    middle = np.mean([found.poses[i].map_C[:2] for i in held], axis=0)
    far = np.linalg.norm(found.accuracy.xyz[:, :2] - middle, axis=1)
    outer = far >= np.median(far)
    off = np.linalg.norm(found.accuracy.sigma_m[:, :2], axis=1) / np.sqrt(2)
    return float(np.median(off[outer] / np.maximum(far[outer], 1e-6)))


class Weighed(NamedTuple):
    """What positions tell, weighed against something besides."""

    change: float
    """Of what positions tell."""
    narrowed: float
    """Deviation after the change over that stated."""
    loose: float
    """Deviation of what positions tell alone, as both kinds of receivers are likely."""


def weighed(
    apart: float, loose: NDArray[np.float64], told: float, kinds: NDArray[np.float64]
) -> Weighed | None:
    """What positions tell, with the deviations `loose` (2: as stated, and where their errors last,
    of the log-likelihoods `kinds`), weighed against what lies `apart` and has the deviation `told`;
    None where they contradict each other.
    """
    whole = loose**2 + told**2
    if abs(apart) > CONTRADICTED * np.sqrt(whole[0]):
        return None
    likely = kinds - apart**2 / (2 * whole) - np.log(whole) / 2
    likely = np.exp(likely - likely.max())
    likely /= likely.sum()
    share = loose**2 / whole
    change = apart * float(likely @ share)
    left = likely @ (share * told**2 + (apart * share - change) ** 2)
    return Weighed(
        change=change,
        narrowed=float(np.sqrt(left) / loose[0]),
        loose=float(np.sqrt(likely @ loose**2)),
    )


def _scale(
    found: Alignment,
    priors: Sequence[Prior],
    held: Sequence[int],
    told_high: Sequence[int],
    ground_m: float,
) -> _Told | None:
    """`held`: photos with positions, of which `told_high` tell heights as well."""
    xyz, told = found.ties.xyz, _loose(found, priors, held, 3)
    loose = told * float(np.clip(_loose_ground(found, held) / told[0], 1, MOST_LOOSER))
    above = float(np.median([priors[i].map_C[2] for i in told_high])) - ground_m
    if not len(xyz) or not above > 1 or not loose[0] > LOOSE_SCALE:
        return None
    low, ground, top = np.quantile(xyz[:, 2], [0.16, GROUND, 0.84])
    high = float(np.median([found.poses[i].map_C[2] for i in told_high]) - ground)
    if not high > 0:
        return None
    uneven = float(np.hypot(EVEN, (top - low) / (2 * high)))
    kinds = _kinds(found, priors, held)
    to = weighed(above / high - 1, loose, uneven * above / high, kinds)
    if to is None:
        return _Told(
            f"Positions near to each other tell that the photos were taken {high:.0f} m above the"
            f" ground, but they report {above:.0f} m above take-off: the place of take-off lies"
            " higher or lower, or the map is too large or small. Control points would tell."
        )
    return _Told(
        f"{_known(found, held, 'scale', f'{min(100 * to.loose, 100):.0f} %')}. So it rests on"
        " heights above take-off, too, which tell it where the ground is as high as the place of"
        " take-off. Control points would settle it."
        if to.loose > LOOSE_SCALE
        else "",
        to.change,
        to.narrowed,
    )


def _heading(found: Alignment, priors: Sequence[Prior], held: Sequence[int]) -> _Told | None:
    told = [i for i in held if np.isfinite(priors[i].yaw_deg)]
    loose = np.degrees(_loose(found, priors, held, 2))
    if not loose[0] > LOOSE_DEG or 2 * len(told) < len(held) or not told:
        return None
    grid = [angles_from_cam_R_map(found.poses[i].cam_R_map)[0] for i in told]
    off = np.array([priors[i].yaw_deg for i in told]) - grid
    by = common_angle_deg(off, ALIKE_DEG)  # files that were turned have another one
    if by is None:
        return None
    sigma = float(np.median([priors[i].sigma_yaw_deg for i in told]))
    kinds = _kinds(found, priors, held)
    to = weighed(by, loose, sigma, kinds)
    if to is None:
        return None  # told for each photo (`alignment.conflicts`)
    return _Told(
        f"{_known(found, held, 'direction', f'{min(to.loose, 180):.0f} degrees')}. So it rests on"
        " their headings, too."
        if to.loose > LOOSE_DEG
        else "",
        float(np.radians(to.change)),
    )


def _known(found: Alignment, held: Sequence[int], what: str, to: str) -> str:
    """How well positions tell something of the map, and why; `held`: the photos that have one."""
    if len(held) == 1:
        return f"Only one photo of the map has a position, which tells nothing of its {what}"
    all_of = len(held) == len(found.held)
    whose = "The photos" if all_of else f"The {len(held)} photos that have a position"
    return (
        f"{whose} were taken so near to each other that their positions tell the map's {what} to"
        f" {to} only"
    )
