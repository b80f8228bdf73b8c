"""Two ways to maximise the objective of `hybrid` inside a photo's error range: annealing, and
correlation surfaces.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.papers.hybrid_objective import LEAST_OVERLAP, Level, Objective

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Best:
    """Maximum of the objective."""

    move: Array
    """(3,) east m, north m, clockwise degrees, relative to the placement by metadata."""
    quality: float
    """lambda there, on the finest level."""
    evaluations: int
    """Number of evaluations of the objective."""


class Optimiser(Protocol):
    """Interface: maximises an objective within a largest shift in m and rotation in degrees."""

    def __call__(self, objective: Objective, reach_m: float, turn_deg: float, seed: int) -> Best:
        """The best move."""
        ...


@dataclass(frozen=True, kw_only=True)
class Anneal:
    """Simulated annealing (Kirkpatrick et al. 1983) over an image pyramid, as in the thesis (Y
    4.1.2).

    The coarsest level searches the whole range; each finer level searches within the resolution of
    the coarser one.
    """

    tries: tuple[int, ...] = (120, 160, 500)
    """Evaluations on each level, finest first."""
    hot: float = 0.03
    """First temperature in units of lambda."""
    cold: float = 0.0005
    """Last temperature in units of lambda."""
    version: ClassVar[int] = 1

    def __call__(self, objective: Objective, reach_m: float, turn_deg: float, seed: int) -> Best:
        """The best of all moves tried; equal seeds give equal moves."""
        rng = np.random.default_rng(seed)
        move, spent = np.zeros(3), 0
        size = max(objective.levels[0].patch.shape)
        for level in reversed(range(len(objective.levels))):
            scale = objective.levels[level]
            coarsest = level == len(objective.levels) - 1
            turn = np.degrees(8 * scale.gsd / (size * objective.levels[0].gsd))
            slack = np.array([4 * scale.gsd, 4 * scale.gsd, turn])
            spread = np.array([reach_m, reach_m, turn_deg]) if coarsest else slack
            floor = np.array([scale.gsd / 2, scale.gsd / 2, slack[2] / 8])
            heat = self.hot if coarsest else self.hot / 10
            move = self._level(
                objective, level, move, spread, floor, (reach_m, turn_deg), heat, rng
            )
            spent += self.tries[level]
        return Best(move=move, quality=objective(move, 0), evaluations=spent)

    def _level(
        self,
        objective: Objective,
        level: int,
        move: Array,
        spread: Array,
        floor: Array,
        limits: tuple[float, float],
        heat: float,
        rng: np.random.Generator,
    ) -> Array:
        """One level: steps and temperature decrease geometrically."""
        tries = self.tries[level]
        value = objective(move, level)
        best, best_value = move, value
        for k in range(tries):
            t = k / tries
            step = np.maximum(spread * 0.5 * (0.03**t), floor)
            tried = move + rng.normal(size=3) * step
            if np.hypot(*tried[:2]) > limits[0] or abs(tried[2]) > limits[1]:
                continue
            found = objective(tried, level)
            temperature = heat * (self.cold / self.hot) ** t
            if found > value or rng.random() < np.exp((found - value) / temperature):
                move, value = tried, found
                if value > best_value:
                    best, best_value = move, value
        return best


@dataclass(frozen=True, kw_only=True)
class Surfaces:
    """Correlation surfaces: all shifts of the coarsest level at once for each of a set of
    rotations, followed by a local search.

    Masked normalised correlation by Fourier transforms (Padfield 2012) gives lambda of all shifts;
    the best of them are refined on finer levels by a pattern search, whose last steps are 0.15 px
    of each level.
    """

    turn_step_deg: float = 2.0
    """Step between the rotations tried in degrees."""
    keep: int = 3
    """Number of peaks refined on the next level."""
    version: ClassVar[int] = 1

    def __call__(
        self, objective: Objective, reach_m: float, turn_deg: float, seed: int = 0
    ) -> Best:
        """The best move; the search is deterministic."""
        coarse = len(objective.levels) - 1
        turns = np.linspace(
            -turn_deg, turn_deg, 2 * int(np.ceil(turn_deg / self.turn_step_deg)) + 1
        )
        peaks = [self._peak(objective, coarse, float(t), reach_m) for t in turns]
        spent = len(peaks)
        moves = [m for _, m in sorted(peaks, key=lambda found: -found[0])[: self.keep]]
        size = max(objective.levels[0].patch.shape) * objective.levels[0].gsd
        climbed: list[tuple[float, Array]] = []
        for level in reversed(range(len(objective.levels))):
            gsd = objective.levels[level].gsd
            step = np.array([gsd, gsd, np.degrees(2 * gsd / size)])
            climbed = []
            for move in moves:
                found, value, n = _climb(objective, level, move, step, (reach_m, turn_deg))
                climbed.append((value, found))
                spent += n
            climbed.sort(key=lambda c: -c[0])
            moves = [m for _, m in climbed[: max(1, self.keep - (coarse - level) - 1)]]
        value, best = climbed[0]
        return Best(move=best, quality=value, evaluations=spent)

    def _peak(
        self, objective: Objective, level: int, turn: float, reach_m: float
    ) -> tuple[float, Array]:
        """The best shift for one rotation on the coarsest level: (lambda, move)."""
        here = objective.levels[level]
        cc, columns, rows = masked_correlation(here, turn, reach_m)
        east, north = np.meshgrid(columns * here.gsd, -rows * here.gsd)
        spat = objective.distances.quality(objective.nadir + np.stack([east, north], -1))
        looks = np.where(np.isfinite(cc), (1 + cc) / 2, 0.0)
        value = objective.alpha * spat + (1 - objective.alpha) * looks
        value[np.hypot(east, north) > reach_m] = -1
        k = int(np.argmax(value))
        return float(value.flat[k]), np.array([east.flat[k], north.flat[k], turn])


def _climb(
    objective: Objective, level: int, move: Array, step: Array, limits: tuple[float, float]
) -> tuple[Array, float, int]:
    """Pattern search with steps of 1, 0.4 and 0.15 px: the move, lambda, evaluations."""
    value, spent = objective(move, level), 1
    for scale in (1.0, 0.4, 0.15):
        for _ in range(12):
            near = [m for m in _around(move, step * scale) if _within(m, limits)]
            tried = [(objective(m, level), k, m) for k, m in enumerate(near)]
            spent += len(tried)
            best = max(tried, default=None, key=lambda t: t[:2])
            if best is None or best[0] <= value:
                break
            value, _, move = best
    return move, value, spent


def _around(move: Array, step: Array) -> list[Array]:
    """Both neighbours along every axis."""
    return [move + sign * step[axis] * np.eye(3)[axis] for axis in range(3) for sign in (-1, 1)]


def _within(move: Array, limits: tuple[float, float]) -> bool:
    return bool(np.hypot(*move[:2]) <= limits[0] and abs(move[2]) <= limits[1])


def masked_correlation(level: Level, turn_deg: float, reach_m: float) -> tuple[Array, Array, Array]:
    """CC of photo and map in their overlap for all whole-pixel shifts within reach, NaN where they
    hardly overlap.

    The surface (rows, columns), shifts along columns and along rows in px from the placement by
    metadata (Padfield 2012).
    """
    place = level._placement(np.array([0.0, 0.0, turn_deg]))
    h, w = level.window.shape
    patch = cv2.warpAffine(level.patch, place, (w, h), flags=cv2.INTER_LINEAR)
    seen = (cv2.warpAffine(level.shown, place, (w, h), flags=cv2.INTER_LINEAR) > 0.99).astype(
        np.float32
    )
    reach = int(np.floor(reach_m / level.gsd))
    size = cv2.getOptimalDFTSize(h + reach + 1), cv2.getOptimalDFTSize(w + reach + 1)

    def transform(image: NDArray[Any]) -> NDArray[Any]:
        return np.fft.rfft2(image, size)

    middle = float(patch[seen > 0].mean()) if seen.any() else 0.0
    a, b = (patch - middle) * seen, (level.window - middle) * level.filled
    A, A2, MA = np.conj(transform(a)), np.conj(transform(a * a)), np.conj(transform(seen))
    B, B2, MB = transform(b), transform(b * b), transform(level.filled)
    shifts = np.arange(-reach, reach + 1)

    def all_shifts(product: NDArray[Any]) -> NDArray[Any]:
        full = np.fft.irfft2(product, size)
        return np.asarray(full[np.ix_(shifts % size[0], shifts % size[1])])

    n = np.maximum(all_shifts(MA * MB), 1.0)
    sa, sb = all_shifts(A * MB), all_shifts(MA * B)
    saa, sbb = all_shifts(A2 * MB), all_shifts(MA * B2)
    power = np.maximum(saa - sa**2 / n, 0) * np.maximum(sbb - sb**2 / n, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        cc = (all_shifts(A * B) - sa * sb / n) / np.sqrt(power)
    cc[(n < LEAST_OVERLAP * level.patch.size) | (power <= 1e-6 * power.max())] = np.nan
    return np.clip(cc, -1, 1), shifts.astype(float), shifts.astype(float)
