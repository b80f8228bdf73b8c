"""Positions that belong to other photos: a logger that is late, photos of the ground before the
flight that a list of positions counts or leaves out, a line that is missing in it or too many; and
positions that are mirrored, since latitude and longitude are exchanged or one of them lost its
sign.

Along a line such positions look right, and where a drone turns they do not; so they bend and shrink
a map that they hold in place. From a missing line on, all that follow are shifted.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from skyquilt.alignment.motion import Speeds
from skyquilt.alignment.same_place import NEAR
from skyquilt.alignment.similarity_graph import fit_similarity
from skyquilt.geometry.frames import angle_difference_deg, angles_from_cam_R_map
from skyquilt.model.poses import Alignment, MapFrame, Prior

MIRRORED = "They were mirrored back."
"""Words of the note by which an alignment tells that positions were mirrored."""
MIRROR, FEWEST_MIRRORED, ONE_MIRROR = 0.3, 6, 0.6
"""Positions are mirrored where their mirror image misfits by less than this share of their own
misfit, of so many photos at least; and of two mirrors one is the right one that misfits by less
than this share of the other's.
"""
LAST_LATITUDE = 85.0
"""Degrees beyond which nobody flies: what is told for a longitude is then no exchanged latitude."""
TURNED_DEG = 30.0
"""Headings tell the mirror where half of them agree with it within this angle."""
FEWEST, FEWEST_PART = 10, 8
"""Photos of a camera with positions that tell whether these are shifted, and of a part of them."""
MOST = 6
"""Positions of a part are sought so many photos before and after at most;"""
WHOLE_SHARE = 0.3
"""those of all photos up to this share of them before and after, and in reversed order; as much of
them may misfit.
"""
WHOLE_LOOKED_AT = 100
"""Photos, spread evenly, that tell whether all are moved: with each of a large survey the time
would grow as the square of their number.
"""
CLEARER = 0.5
"""Shifted, positions of a part misfit by less than this share of what they misfit by before, and of
what the nearest other shifts leave, each with the place, direction and scale that fit best.
"""
CHANGE = 4.0
"""A part with another shift begins where that explains so many positions that nothing else does."""
OUTLIER = 3.0
"""A position that misfits by more than this times the usual misfit is not explained."""

MOVED = "They were moved to the photos that they belong to."
"""Words of the note by which an alignment tells that it did so."""

LAGGED = "They were moved along the flight."
"""The same for positions of another moment than their photos."""
LESS, LIKELIER, ASIDE = 0.7, 20.0, 0.3
"""Positions belong to another moment where they then misfit by less than this share of what they
misfit by, which is likelier by this (twice a logarithm), and what they are displaced by lies
across the flight by less than this share of what it lies along it.
"""
COMPARED = 0.8
"""Share of the positions that are compared, those that fit best."""
MOVES_MS, BARELY_S = 0.5, 0.05
"""Slower photos do not tell a moment; and so few seconds are none: speeds from times that are
wrong, as of two halves whose clock was set back in between.
"""

Complex = NDArray[np.complex128]
Floats = NDArray[np.float64]
Shifts = NDArray[np.int64]


def unshifted(found: Alignment, priors: Sequence[Prior], cameras: Sequence[str]) -> Sequence[Prior]:
    """The priors with positions of each camera's photos moved to photos before or after, in order
    of capture, where they then fit the pictures far better; photos for which none is left have
    none. `cameras`: that of each photo. The very same priors where none is moved.
    """
    out = list(priors)
    for camera in dict.fromkeys(cameras):
        own = _spread(found, [i for i, c in enumerate(cameras) if c == camera])
        for k, late in enumerate(_shifts(found, priors, own).tolist()):
            if late:
                source = priors[own[k + late]] if 0 <= k + late < len(own) else None
                out[own[k]] = _at(priors[own[k]], source)
    return out if any(a is not b for a, b in zip(out, priors, strict=True)) else priors


def _spread(found: Alignment, photos: Sequence[int]) -> list[int]:
    """The photos without most of those of a hover: a map shrunk to nothing would explain theirs."""
    placed = {i: found.poses[i].map_C for i in photos if i in found.poses}
    high = float(np.median([C[2] for C in placed.values()] or [0.0])) - found.ground_m
    if not high > 0:
        return list(photos)
    there, kept = Counter[tuple[float, ...]](), list[int]()
    for i in photos:
        cell = (*np.round(placed[i][:2] / (NEAR * high)),) if i in placed else (i,)
        there[cell] += 1
        kept += [i] if there[cell] <= MOST else []
    return kept


def as_moved(
    found: Alignment, priors: Sequence[Prior], cameras: Sequence[str], speeds: Speeds
) -> Sequence[Prior]:
    """The priors as an alignment took them: mirrored or moved where it says so, to other photos or
    along the flight.
    """
    if any(MIRRORED in note for note in found.notes):
        mirror = mirrored(found, priors)
        priors = priors if mirror is None else mirror.priors
    told = any(MOVED in note for note in found.notes)
    priors = unshifted(found, priors, cameras) if told else priors
    late = any(LAGGED in note for note in found.notes)
    moved = on_time(found, priors, cameras, speeds) if late else None
    return priors if moved is None else moved.priors


def moved_note(before: Sequence[Prior], after: Sequence[Prior]) -> str:
    """What is said of priors whose positions were moved."""
    number = sum(a is not b for a, b in zip(after, before, strict=True))
    return (
        f"The positions of {number} photos belong to photos before or after them, in order of"
        f" capture: the pictures show it. {MOVED} Check the list or the logger that they come from."
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Corrected:
    """Positions that are not as files tell them."""

    priors: tuple[Prior, ...]
    """The priors with these positions."""
    note: str
    """What is said of them."""


def mirrored(found: Alignment, priors: Sequence[Prior]) -> Corrected | None:
    """The priors mirrored back about their middle, where their mirror image fits the pictures far
    better: east for west, north for south, or latitude and longitude exchanged. Headings tell which
    of the three, where the fit does not; where they agree with none, pictures may be mirrored.
    None where positions fit as they are.
    """
    own = [i for i in found.held if np.isfinite(priors[i].map_C[:2]).all()]
    if found.frame.crs is None or len(own) < FEWEST_MIRRORED:
        return None
    told = _plane(np.array([priors[i].map_C for i in own]))
    placed = _plane(np.array([found.poses[i].map_C for i in own]))
    sigma = np.array([priors[i].sigma_C[0] for i in own])
    middle = complex(np.median(told.real), np.median(told.imag))
    wide, high = _exchanged(found.frame, middle)

    def mirror(place: Complex, how: str) -> Complex:
        x, y = (place - middle).real, (place - middle).imag
        if how == EXCHANGED:
            return np.asarray(middle + y * wide + 1j * x * high)
        return np.asarray(middle + (x - 1j * y if how == SOUTH else -x + 1j * y))

    fits = {how: fit_similarity(placed, mirror(told, how), sigma) for how in MIRRORS}
    misfit = fit_similarity(placed, told, sigma)[2]
    best = min(MIRRORS, key=lambda how: fits[how][2])
    if not fits[best][2] < MIRROR * misfit:
        return None
    likely = [how for how in MIRRORS if ONE_MIRROR * fits[how][2] <= fits[best][2]]
    off = {how: _turned_deg(found, priors, own, fits[how][0]) for how in likely}
    how = min(likely, key=lambda how: (off[how], MIRRORS.index(how)))
    headed = any(np.isfinite(priors[i].yaw_deg) for i in own)
    if headed and not off[how] < TURNED_DEG:
        why = "their list has another order, or a program has mirrored the pictures"
    else:
        why = how if headed or len(likely) < 2 else f"{how} or the other way ({UNHEADED})"
    out = list(priors)
    for i, prior in enumerate(priors):
        if np.isfinite(prior.map_C[:2]).all():
            C = mirror(np.array([complex(*prior.map_C[:2])]), how)[0]
            out[i] = replace(prior, map_C=np.array([C.real, C.imag, prior.map_C[2]]))
    return Corrected(
        priors=tuple(out),
        note=f"The reported positions are mirrored against the pictures: {why}. {MIRRORED} So the"
        " map has its size and direction, but it lies where files say, on another place of the"
        " Earth. Correct the positions of the photos, or give right ones in a geo.txt. If the place"
        " is right, their list has the reverse order, or a program has mirrored the pictures, and"
        " the map shows them so.",
    )


EXCHANGED = "latitude and longitude are exchanged"
SOUTH = "north is taken for south, or south for north"
UNHEADED = "no photo tells a heading"
MIRRORS = "east is taken for west, or west for east", SOUTH, EXCHANGED
"""What mirrors positions, the usual one first."""


def _exchanged(frame: MapFrame, middle: complex) -> tuple[float, float]:
    """Metres eastwards per metre northwards as told, where latitude and longitude are exchanged,
    and northwards per metre eastwards.
    """
    back = Transformer.from_crs(frame.crs, "EPSG:4326", always_xy=True)
    lon, lat = back.transform(frame.origin[0] + middle.real, frame.origin[1] + middle.imag)
    if not (np.isfinite([lon, lat]).all() and abs(lon) < LAST_LATITUDE):
        return 1.0, 1.0
    return float(np.cos(np.radians(lon))), float(1 / np.cos(np.radians(lat)))


def _turned_deg(found: Alignment, priors: Sequence[Prior], own: Sequence[int], g: complex) -> float:
    """Median angle in degrees between headings of photos as placed, turned with the block by `g`,
    and as reported; 180 where none is.
    """
    turn = float(np.degrees(np.angle(g)))
    yaw = [angles_from_cam_R_map(found.poses[i].cam_R_map)[0] - turn for i in own]
    off = angle_difference_deg(np.array([priors[i].yaw_deg for i in own]), np.array(yaw))
    known = np.abs(off[np.isfinite(off)])
    return float(np.median(known)) if len(known) else 180.0


def on_time(
    found: Alignment, priors: Sequence[Prior], cameras: Sequence[str], speeds: Speeds
) -> Corrected | None:
    """The priors with positions moved to the moments at which photos were taken, where those of a
    camera's photos are of another moment, the same time before or after: a receiver that is late, a
    clock that is off. None where none are. `cameras`: that of each photo.

    Along lines flown there and back such positions lie behind their photos, to one side and to the
    other: the map is stretched and turned.
    """
    out, said = list(priors), list[str]()
    for camera in dict.fromkeys(cameras):
        own = [i for i, c in enumerate(cameras) if c == camera and i in found.poses]
        own = [i for i in own if np.isfinite(priors[i].map_C[:2]).all()]
        if len(own) < FEWEST:
            continue
        C = np.array([found.poses[i].map_C for i in own])
        v = _plane(speeds(own, C))
        told = _plane(np.array([priors[i].map_C for i in own]))
        if (late := _lag(_plane(C), told, v)) is None:
            continue
        seconds, ahead, fits = late
        shift = float(np.median(np.abs(ahead[np.abs(v) > MOVES_MS])))
        for k, i in enumerate(own):
            there = priors[i].map_C + np.array([ahead[k].real, ahead[k].imag, 0.0])
            out[i] = replace(priors[i], map_C=there) if fits[k] else _at(priors[i], None)
        said.append(
            f"The positions of {len(own)} photos are those of a moment {abs(seconds):.1f} s"
            f" {'before' if seconds > 0 else 'after'} the photos, {shift:.1f} m"
            f" {'behind' if seconds > 0 else 'ahead of'} them: the pictures show it. {LAGGED} Check"
            " the clock or the receiver that they come from."
        )
    return Corrected(priors=tuple(out), note=" ".join(said)) if said else None


def _lag(
    placed: Complex, told: Complex, v: Complex
) -> tuple[float, Complex, NDArray[np.bool_]] | None:
    """By how many seconds positions are late, what they lie behind in m (n,), and which of them fit
    then; None where nothing tells. `v` (n,): velocities in m/s of photos as placed.
    """
    moves = np.abs(v) > MOVES_MS
    if moves.sum() < FEWEST:
        return None
    ones = np.ones_like(placed)
    _, before = _robust_fit((placed[moves], ones[moves]), told[moves])
    x, after = _robust_fit((placed[moves], ones[moves], v[moves]), told[moves])
    late = complex(-x[2] / x[0])
    likelier = 2 * moves.sum() * np.log(max(before, 1e-9) / max(after, 1e-9))
    if not (after < LESS * before and likelier > LIKELIER):
        return None
    if abs(late.imag) > ASIDE * abs(late.real) or abs(late.real) < BARELY_S:
        return None
    ahead = x[0] * late.real * v
    off = np.abs(told + ahead - x[0] * placed - x[1])
    return late.real, ahead, off <= OUTLIER * max(float(np.median(off[moves])), 1e-3)


def _robust_fit(terms: tuple[Complex, ...], told: Complex) -> tuple[Complex, float]:
    """Factors of terms (n,) whose sum is closest to `told`, with weights that gross errors lose;
    and the root mean square of the smaller misfits in m.
    """
    A, w = np.stack(terms, 1), np.ones(len(told))
    for _ in range(15):
        root = np.sqrt(w)
        x = np.linalg.lstsq(A * root[:, None], told * root, rcond=None)[0]
        off = np.abs(told - A @ x)
        w = 1 / (1 + (off / (3 * max(float(np.median(off)), 1e-6))) ** 2)
    some = np.sort(off)[: max(1, round(COMPARED * len(off)))]
    return np.asarray(x, np.complex128), float(np.sqrt((some**2).mean()))


def _plane(places: Floats) -> Complex:
    return np.asarray(places[:, 0] + 1j * places[:, 1], np.complex128)


def _shifts(found: Alignment, priors: Sequence[Prior], own: Sequence[int]) -> Shifts:
    """How many photos after each its position stands, 0 where nothing tells; (n,)."""
    nowhere = complex(np.nan, np.nan)
    placed = np.array(
        [complex(*found.poses[i].map_C[:2]) if i in found.poses else nowhere for i in own]
    )
    told = np.array([complex(*priors[i].map_C[:2]) for i in own])
    sigma = np.array([priors[i].sigma_C[0] for i in own])
    fits = {s: f for s in range(-MOST, MOST + 1) if (f := _fit(placed, told, sigma, s)) is not None}
    if not fits:
        return np.zeros(len(own), np.int64)
    usual = max(min(f[2] for f in fits.values()), 1e-3)
    if (whole := _as_a_whole(placed, told, sigma)) is not None:
        return whole
    best, least = np.zeros(len(own), np.int64), np.inf
    likely = sorted(fits, key=lambda s: (s != 0, fits[s][2]))[:4]  # as they are, and three others
    for g, c, _ in (fits[s] for s in likely):
        off = _misfits(g * placed + c, told)
        path, cost = _path(np.minimum((off / (OUTLIER * usual)) ** 2, 1.0))
        if cost < least:
            best, least = path, cost
    return _clear(best, placed, told, sigma)


def _as_a_whole(placed: Complex, told: Complex, sigma: Floats) -> Shifts | None:
    """How many photos after each its position stands, where all are moved by the same number beyond
    `MOST`, or are in reversed order, and nothing else explains them nearly as well; else None.
    """
    number = len(told)
    reach = int(WHOLE_SHARE * number)
    some = np.linspace(0, number - 1, min(number, WHOLE_LOOKED_AT)).astype(int)
    kept = len(some) * (number - reach) // number
    back, none = number - 1 - 2 * np.arange(number), np.zeros(number, np.int64)
    tried = [
        (np.full(number, s), _moved(told, s), _moved(sigma, s).real)
        for s in range(-reach, reach + 1)
    ]
    tried += [(back, told[::-1], sigma[::-1]), (none, np.conj(told), sigma)]  # and mirrored
    misfits = [_own_misfit(placed[some], t[some], d[some], kept) for _, t, d in tried]
    least = min((m for m in misfits if m is not None), default=0.0)
    likely = [k for k, m in enumerate(misfits) if m is not None and CLEARER * m <= least]
    if len(likely) == 1:
        found = tried[likely[0]][0]
        return found if np.abs(found).max() > MOST else None
    # there and back, reversed is mirrored, or a line late: a warning tells of positions
    undecided = len(tried) - 2 in likely and reach not in likely
    return none if undecided else None


def _fit(
    placed: Complex, told: Complex, sigma: Floats, shift: int
) -> tuple[complex, complex, float] | None:
    """The similarity from photos to the positions `shift` places after them, and its misfit in m;
    None where too few have both.
    """
    moved, deviation = _moved(told, shift), _moved(sigma, shift)
    both = np.isfinite(placed) & np.isfinite(moved)
    if both.sum() < FEWEST:
        return None
    return fit_similarity(placed[both], moved[both], deviation[both].real)


def _misfits(placed: Complex, told: Complex) -> Floats:
    """Distances in m (2 MOST + 1, n) of photos from positions -MOST ... MOST places after them."""
    return np.array([np.abs(_moved(told, s) - placed) for s in range(-MOST, MOST + 1)])


def _moved(values: NDArray[np.inexact], shift: int) -> Complex:
    """Each photo's value is that `shift` places after it; NaN beyond the ends."""
    out = np.full(len(values), complex(np.nan, np.nan))
    if abs(shift) < len(values):
        inside = slice(max(0, -shift), len(values) - max(0, shift))
        out[inside] = values[max(0, shift) : len(values) + min(0, shift)]
    return out


def _path(cost: Floats) -> tuple[Shifts, float]:
    """The shift of each photo, of which the sum of costs and of `CHANGE` for each change, and for
    not beginning with none, is least (Viterbi). `cost` (2 MOST + 1, n); unknown ones are 1.
    """
    cost = np.nan_to_num(cost, nan=1.0)
    total = cost[:, 0] + CHANGE * (np.arange(len(cost)) != MOST)
    came = np.zeros(cost.shape, np.int64)
    for k in range(1, cost.shape[1]):
        cheapest = int(np.argmin(total))
        jump = total > total[cheapest] + CHANGE
        came[:, k] = np.where(jump, cheapest, np.arange(len(cost)))
        total = np.where(jump, total[cheapest] + CHANGE, total) + cost[:, k]
    at = int(np.argmin(total))
    path = np.zeros(cost.shape[1], np.int64)
    for k in range(cost.shape[1] - 1, -1, -1):
        path[k] = at - MOST
        at = int(came[at, k])
    return path, float(total.min())


def _clear(path: Shifts, placed: Complex, told: Complex, sigma: Floats) -> Shifts:
    """The path without shifts of parts that another place, direction and scale of the part, or the
    next shift, explains nearly as well: positions along one straight line or a circle tell none.
    """
    out = path.copy()
    for part in np.split(np.arange(len(path)), np.flatnonzero(np.diff(path)) + 1):
        shift = int(path[part[0]])
        if not shift:
            continue
        now, *others = (
            _own_misfit(placed[part], _moved(told, s)[part], sigma[part])
            for s in (shift, 0, shift - 1, shift + 1)
        )
        if now is None or any(m is not None and not now < CLEARER * m for m in others):
            out[part] = 0
    return out


def _own_misfit(
    placed: Complex, told: Complex, sigma: Floats, kept: int | None = None
) -> float | None:
    """Mean distance in m of a part's photos, brought to positions by a similarity of their own,
    from these, of so many that fit best (three quarters of those that have both); None where too
    few have both.
    """
    both = np.isfinite(placed) & np.isfinite(told)
    if both.sum() < (kept or FEWEST_PART):
        return None
    placed, told = placed[both], told[both]
    g, c, _ = fit_similarity(placed, told, sigma[both])
    off = np.sort(np.abs(g * placed + c - told))
    return float(off[: kept or -(-3 * len(off) // 4)].mean())


def _at(prior: Prior, other: Prior | None) -> Prior:
    """A prior with the position of another one, or without any."""
    if other is None:
        return replace(prior, map_C=np.full(3, np.nan))
    return replace(prior, map_C=other.map_C, sigma_C=other.sigma_C)
