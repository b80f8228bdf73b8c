"""What all frames of a thermal camera have in common: rings of its own warmth that the lens mirrors
onto the detector (narcissus), a fall towards the corners, warm edges.

Overlapping frames show the same ground at different places of the picture. Where their values
differ by what hangs on these places alone, that is the camera's, not the ground's.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.node_grid import nodes_around, over
from skyquilt.model.camera import Camera

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]
_TINY = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Values of frames at points of the ground."""

    point: Ints
    """(N,) number of the point."""
    row: Ints
    """(N,) number of the frame, in the order of capture."""
    value: Doubles
    """(N,) value, in the frames' unit."""
    place: Doubles
    """(N, 2) column and row in the frame, in shares of its sides: 0 to 1."""


@dataclass(frozen=True, kw_only=True)
class FramePattern:
    """Correction of every place in a camera's picture, from the overlaps of its frames.

    It is taken only where it holds for frames that it was not estimated from: one estimated from
    either half of the flight must explain the differences within the other half.
    """

    nodes: int = 24
    """Nodes along the frame's longer side, between which the pattern is linear."""
    rings: int = 16
    """Radii from the middle to the corners at which the pattern is free, linear between: nothing in
    a straight flight tells of what is the same along it, but rings and falls of light are round.
    """
    bend: float = 0.3
    """Weight of a node's second differences, as a share of the differences that it lies in."""
    apart: float = 0.3
    """The same of its difference from these rings."""
    gain: float = 0.03
    """Share of the differences (median) that it must explain in frames it does not know: where
    there was no pattern, the share was below 0.
    """
    fewest: int = 8
    """Frames, at least: four in either half."""
    rounds: int = 6
    """Rounds of reweighting."""
    version: ClassVar[int] = 1

    def __call__(self, samples: Samples, camera: Camera) -> NDArray[np.float32] | None:
        """Correction (h, w) to be added at nodes from corner to corner of the frame, without a mean
        and a slope, which overlaps of a straight flight do not tell from drift; None where frames
        do not have one in common.
        """
        frames = np.unique(samples.row)
        if len(frames) < self.fewest:
            return None
        shape = _shape(camera, self.nodes)
        pairs = _pairs(samples)
        middle = frames[len(frames) // 2]
        halves = [pairs.within(samples.row < middle), pairs.within(samples.row >= middle)]
        for known, other in (halves, halves[::-1]):
            if not len(known.first) or not len(other.first):
                return None
            found = self._solved(samples, known, shape)
            before = float(np.median(np.abs(other.levelled(samples, None))))
            after = float(np.median(np.abs(other.levelled(samples, found))))
            if after > (1 - self.gain) * before:
                return None
        return self._solved(samples, pairs, shape)

    def _solved(
        self, samples: Samples, pairs: "_Pairs", shape: tuple[int, int]
    ) -> NDArray[np.float32]:
        """The pattern that makes pairs of samples agree, outliers down-weighted (Cauchy)."""
        from scipy import sparse  # imported here, since only thermal runs need it
        from scipy.sparse import linalg as sparse_linalg

        basis = _bilinear(samples.place, shape)
        free = sparse.hstack([sparse.identity(shape[0] * shape[1]), _radial(shape, self.rings)])
        at_nodes = basis[pairs.second] - basis[pairs.first]
        A = (at_nodes @ free).tocsc()
        each = A.shape[0] / at_nodes.shape[1]
        stiff = each * sparse.block_diag(
            [
                self.bend * _second_differences(shape)
                + self.apart * sparse.identity(at_nodes.shape[1]),
                1e-3 * sparse.identity(self.rings),
            ]
        )
        pattern = np.zeros(shape, np.float32)
        for _ in range(self.rounds):
            lacking = pairs.levelled(samples, pattern)
            scale = 2 * 1.4826 * float(np.median(np.abs(lacking))) + _TINY
            weight = 1 / (1 + (lacking / scale) ** 2)
            # what is lacking without the pattern, at the level of each pair of frames with it
            wanted = lacking - at_nodes @ pattern.ravel()
            normal = (A.T @ sparse.diags(weight) @ A + stiff).tocsc()
            solved = sparse_linalg.spsolve(normal, -A.T @ (weight * wanted))
            pattern = _level((free @ solved).reshape(shape))
        return pattern


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pairs:
    """Pairs of samples of one point."""

    first: Ints
    """(E,) rows of samples."""
    second: Ints
    """(E,) of others."""
    frames: Ints
    """(E,) number of the pair of frames."""

    def within(self, wanted: NDArray[np.bool_]) -> "_Pairs":
        """Those of which both samples are wanted."""
        kept = wanted[self.first] & wanted[self.second]
        return _Pairs(first=self.first[kept], second=self.second[kept], frames=self.frames[kept])

    def levelled(self, samples: Samples, pattern: NDArray[np.float32] | None) -> Doubles:
        """(E,) second minus first, with the pattern, less the median of each pair of frames."""
        value = samples.value
        if pattern is not None:
            value = value + _bilinear(samples.place, pattern.shape) @ pattern.ravel()
        difference = value[self.second] - value[self.first]
        return difference - medians(difference, self.frames)


def medians(values: Doubles, group: Ints) -> Doubles:
    """(n,) the median of each value's group."""
    order = np.lexsort((values, group))
    _, start, size = np.unique(group[order], return_index=True, return_counts=True)
    low, high = start + (size - 1) // 2, start + size // 2
    middle = (values[order][low] + values[order][high]) / 2
    found = np.empty(len(values))
    found[order] = np.repeat(middle, size)
    return found


def _pairs(samples: Samples) -> _Pairs:
    order = np.lexsort((samples.row, samples.point))
    point = samples.point[order]
    first, second = [], []
    for lag in range(1, int(np.bincount(point).max(initial=1))):
        same = np.flatnonzero(point[lag:] == point[:-lag])
        first.append(order[same])
        second.append(order[same + lag])
    none = np.zeros(0, np.int64)
    a, b = (np.concatenate([none, *p]) for p in (first, second))
    return _Pairs(
        first=a, second=b, frames=samples.row[a] * (samples.row.max() + 1) + samples.row[b]
    )


def _shape(camera: Camera, nodes: int) -> tuple[int, int]:
    longer = max(camera.width, camera.height)
    return (
        max(3, round(nodes * camera.height / longer)),
        max(3, round(nodes * camera.width / longer)),
    )


def _bilinear(place: Doubles, shape: tuple[int, int]) -> Any:
    """(N, h w) sparse weights of the nodes at places (N, 2) in shares of the sides."""
    from scipy import sparse

    around = nodes_around(place, shape)
    number = np.tile(np.arange(len(place)), len(around))
    nodes, weights = (np.concatenate(parts) for parts in zip(*around, strict=True))
    return sparse.csr_matrix((weights, (number, nodes)), (len(place), shape[0] * shape[1]))


def _radial(shape: tuple[int, int], rings: int) -> Any:
    """(h w, rings) weights of values at equal steps of the radius, for every node."""
    from scipy import sparse

    y, x = np.mgrid[: shape[0], : shape[1]] - np.array(shape)[:, None, None] / 2 + 0.5
    radius = np.hypot(x, y).ravel()
    radius *= (rings - 1) / radius.max()
    inner = np.minimum(np.floor(radius).astype(np.int64), rings - 2)
    number = np.arange(radius.size)
    return sparse.csr_matrix(
        (np.r_[1 - radius + inner, radius - inner], (np.tile(number, 2), np.r_[inner, inner + 1])),
        (radius.size, rings),
    )


def _second_differences(shape: tuple[int, int]) -> Any:
    """(n, n) sum of squared second differences along both axes, of n nodes."""
    from scipy import sparse

    def along(size: int) -> Any:
        return sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], (size - 2, size))

    x = sparse.kron(sparse.identity(shape[0]), along(shape[1]))
    y = sparse.kron(along(shape[0]), sparse.identity(shape[1]))
    return x.T @ x + y.T @ y


def _level(pattern: Doubles) -> NDArray[np.float32]:
    """Without its plane."""
    y, x = np.mgrid[: pattern.shape[0], : pattern.shape[1]]
    plane = np.c_[np.ones(pattern.size), x.ravel(), y.ravel()]
    slope = np.linalg.lstsq(plane, pattern.ravel(), rcond=None)[0]
    flat = pattern - (plane @ slope).reshape(pattern.shape)
    return np.asarray(flat, np.float32)


def sized(pattern: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The pattern at every pixel (h, w) of a frame."""
    height, width = shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return at(pattern, x, y, width, height)


def at(
    pattern: NDArray[np.float32], u: NDArray[Any], v: NDArray[Any], width: int, height: int
) -> NDArray[np.float32]:
    """The pattern at columns u and rows v (h, w) of a frame of this size."""
    return over(pattern, (u + 0.5) / width, (v + 0.5) / height)
