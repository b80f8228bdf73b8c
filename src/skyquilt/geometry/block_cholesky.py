"""Cholesky factors of large sparse matrices whose unknowns come in blocks that lie in a plane.

A photo's block of unknowns is coupled only with those of photos that show the same ground. *Nested
dissection* (George 1973) eliminates the blocks on both sides of a line first and those along it
last, again and again; the *multifrontal* method (Duff and Reid 1983) does so in small dense
matrices. For a survey of n photos the cost grows as n^1.5 and the memory as n log n, instead of n^3
and n^2. Unknowns that are coupled with all others, the *border* (cameras), are eliminated last.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from tempfile import TemporaryFile
from typing import IO

import numpy as np
from numpy.typing import NDArray

from skyquilt.geometry.set_aside import SetAside, folder_on_disk

Array = NDArray[np.float64]
Index = NDArray[np.int64]
LEAF = 40
"""Blocks that are eliminated together without another division."""
WORTHWHILE = 0.35
"""A division is taken when its line holds at most this share of the blocks."""
DIRECTIONS = [np.array([np.cos(a), np.sin(a)]) for a in np.arange(8) * np.pi / 8]
"""Directions in which the blocks are divided. Photos lie in lines of any direction, and a division
along or across them passes fewer photos than one aslant.
"""
STRIP = 256
"""Rows of a front that are added or taken at a time."""
HELD = 128 * 2**20
"""Bytes of a factor that are held in memory; larger ones lie in a temporary file."""
WAITING = 4 * 2**20
"""Bytes of what a front leaves that wait in memory; more lies in a temporary file too."""
SMALL = 500
"""Largest system that NumPy solves. SciPy's triangular solver takes less time, but loading it takes
longer than it saves on small systems.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Front:
    """Blocks eliminated together, and what they are coupled with after all before them are gone."""

    own: Index
    """The blocks."""
    unknowns: Index
    """Rows of the whole matrix: first the blocks' own, then the coupled ones."""
    eliminated: int
    """How many of them are the blocks' own."""
    parent: int
    """The front that takes what is left; -1 for the last."""
    pairs: Index
    """Coupled pairs of blocks of which the first eliminated block is one of `own`."""
    rows: Index
    """(len(pairs), p) rows of each pair's first block in the front."""
    columns: Index
    """(len(pairs), p) rows of its second block."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pattern:
    """Which blocks are coupled, and the order in which they are eliminated."""

    count: int
    """Blocks."""
    size: int
    """Unknowns p of a block."""
    border: int
    """Unknowns coupled with all blocks, at the end of the matrix."""
    first: Index
    """(E,) first block of each coupled pair, itself included, ..."""
    second: Index
    """(E,) ... and the second, never less; sorted by both."""
    key: Index
    """(E,) ascending numbers of the pairs, first times `count` plus second."""
    fronts: tuple[Front, ...]
    """In order of elimination."""

    def find(self, a: Index, b: Index) -> Index:
        """Pairs a <= b, by their place; -1 where they are not coupled."""
        wanted = a * self.count + b
        at = np.minimum(np.searchsorted(self.key, wanted), len(self.key) - 1)
        return np.where(self.key[at] == wanted, at, -1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Matrix:
    """A symmetric matrix of blocks."""

    pattern: Pattern
    """Which blocks it has."""
    blocks: Array
    """(E, p, p) block of each coupled pair."""
    beside: Array
    """(n, p, b) blocks with the border."""
    corner: Array
    """(b, b) the border with itself."""

    def times(self) -> Callable[[Array], Array]:
        """The product of the matrix with a vector (total,)."""
        from scipy.sparse import bsr_matrix

        pat = self.pattern
        n, p = pat.count, pat.size
        starts = np.searchsorted(pat.first, np.arange(n + 1))
        upper = bsr_matrix((self.blocks, pat.second, starts), shape=(n * p, n * p))
        lower = upper.T  # once: it is copied
        own = self.blocks[pat.find(np.arange(n), np.arange(n))]
        beside = self.beside.reshape(n * p, pat.border)

        def product(x: Array) -> Array:
            blocks, border = x[: n * p], x[n * p :]
            twice = (own @ blocks.reshape(n, p, 1)).ravel()
            within = upper @ blocks + lower @ blocks - twice
            return np.concatenate(
                [within + beside @ border, beside.T @ blocks + self.corner @ border]
            )

        return product


def pattern(place: Array, size: int, border: int, a: Index, b: Index) -> Pattern:
    """The order of elimination.

    Args:
        place: (n, 2) where the blocks lie in the plane; only the cost depends on it.
        size: unknowns of a block.
        border: unknowns coupled with all blocks.
        a: coupled blocks, ...
        b: ... and those they are coupled with, in any order; repeated pairs do no harm.
    """
    n = len(place)
    key = distinct(
        np.concatenate([np.minimum(a, b) * n + np.maximum(a, b), np.arange(n) * (n + 1)])
    )
    first, second = key // n, key % n
    apart = first != second
    groups = list(_dissected(np.arange(n), first[apart], second[apart], place))
    return Pattern(
        count=n,
        size=size,
        border=border,
        first=first,
        second=second,
        key=key,
        fronts=_fronts(n, size, border, first, second, groups),
    )


def distinct(numbers: Index) -> Index:
    """The different ones of some numbers (n,) from 0, ascending. The table that `numpy.unique`
    makes of them is slower than sorting, the more there are: 2 to 25 times at a million.
    """
    rising = np.sort(numbers)
    return rising[np.diff(rising, prepend=-1) > 0]


def _dissected(nodes: Index, a: Index, b: Index, place: Array) -> Iterator[tuple[Index, int]]:
    """(blocks, number of groups below) of each group in order of elimination; a, b: pairs among the
    nodes.
    """
    cut = _cut(nodes, a, b, place) if len(nodes) > LEAF else None
    if cut is None:
        yield nodes, 0
        return
    side, below = cut, 0
    for number in (0, 1):
        part = nodes[side[nodes] == number]
        if not len(part):
            continue
        inside = (side[a] == number) & (side[b] == number)
        for group in _dissected(part, a[inside], b[inside], place):
            below += 1
            yield group
    yield nodes[side[nodes] == 2], below


def _cut(nodes: Index, a: Index, b: Index, place: Array) -> NDArray[np.int8] | None:
    """The side of each block, 0 or 1, or 2 on the line between; None if no line is worth it."""
    best, least = None, int(WORTHWHILE * len(nodes))
    for along in DIRECTIONS:
        order = nodes[np.argsort(place[nodes] @ along, kind="stable")]
        side = np.zeros(len(place), np.int8)
        side[order[len(order) // 2 :]] = 1
        across = side[a] != side[b]
        for number in (0, 1):
            line = np.unique(np.where(side[a[across]] == number, a[across], b[across]))
            if len(line) <= least:
                best, least = side.copy(), len(line)
                best[line] = 2
    return best


def _fronts(
    n: int, size: int, border: int, first: Index, second: Index, groups: list[tuple[Index, int]]
) -> tuple[Front, ...]:
    """The groups with what they are coupled with."""
    order = np.concatenate([own for own, _ in groups])
    group_of, rank = np.empty(n, np.int64), np.empty(n, np.int64)
    group_of[order] = np.repeat(np.arange(len(groups)), [len(own) for own, _ in groups])
    rank[order] = np.arange(n)
    parents = _parents([below for _, below in groups])
    earlier = np.minimum(group_of[first], group_of[second])
    by_group = np.argsort(earlier, kind="stable")
    cuts = np.searchsorted(earlier[by_group], np.arange(len(groups) + 1))
    steps, last = np.arange(size), n * size + np.arange(border)
    coupled = [list[Index]() for _ in groups]
    at, fronts = np.empty(n, np.int64), list[Front]()
    for k, (own, _) in enumerate(groups):
        pairs = by_group[cuts[k] : cuts[k + 1]]
        ends = np.concatenate([first[pairs], second[pairs], *coupled[k]])
        beyond = np.unique(ends[group_of[ends] > k])
        beyond = beyond[np.argsort(rank[beyond], kind="stable")]
        if parents[k] >= 0:
            coupled[parents[k]].append(beyond)
        members = np.concatenate([own, beyond])
        at[members] = np.arange(len(members))
        fronts.append(
            Front(
                own=own,
                unknowns=np.concatenate([(members[:, None] * size + steps).ravel(), last]),
                eliminated=len(own) * size + (border if parents[k] < 0 else 0),
                parent=parents[k],
                pairs=pairs,
                rows=at[first[pairs]][:, None] * size + steps,
                columns=at[second[pairs]][:, None] * size + steps,
            )
        )
    return tuple(fronts)


def _parents(below: list[int]) -> list[int]:
    """The front that takes what each leaves, from the number of fronts below each; -1 for the
    last.
    """
    parents, waiting = [-1] * len(below), list[int]()
    for k, number in enumerate(below):
        while waiting and waiting[-1] >= k - number:
            parents[waiting.pop()] = k
        waiting.append(k)
    return parents


class _Parts:
    """Of each front of a factor: L (e, e) of the eliminated rows, and M (c, e) below it, S = L M^T;
    in a file beside the memory where they are large and there is a disk for them.
    """

    def __init__(self, fronts: Sequence[Front]) -> None:
        self._shapes = [(f.eliminated, len(f.unknowns) - f.eliminated) for f in fronts]
        sizes = [8 * e * (e + c) for e, c in self._shapes]
        self._starts = np.cumsum([0, *sizes]).tolist()
        self._held = list[tuple[Array, Array]]()
        self._file: IO[bytes] | None = None
        self._read = np.empty(0)
        if self._starts[-1] > HELD:
            with suppress(OSError):  # no folder for it that may be written
                self._file = TemporaryFile(dir=folder_on_disk())  # noqa: SIM115 - closed with this
                self._read = np.empty(max(sizes) // 8)
        self._added = 0

    def add(self, L: Array, M: Array) -> None:
        """Keeps those of the next front, laid out as they are read from a file: products of other
        layouts differ in their last bits.
        """
        L, M = np.asfortranarray(L), np.ascontiguousarray(M)
        if self._file is not None:
            try:
                self._file.writelines(part.data for part in (L.T, M))
                self._file.flush()
            except OSError:  # a full disk
                self._held, self._file = [self._copied(k) for k in range(self._added)], None
        if self._file is None:
            self._held.append((L, M))
        self._added += 1

    def _copied(self, k: int) -> tuple[Array, Array]:
        L, M = self[k]
        return L.copy(order="F"), M.copy()

    def __getitem__(self, k: int) -> tuple[Array, Array]:
        """Those of one front, which hold until another one is asked for."""
        if self._file is None:
            return self._held[k]
        e, c = self._shapes[k]
        both = self._read[: e * (e + c)]
        # not through the file's own buffer: what a full disk refused is in it still
        with open(self._file.fileno(), "rb", closefd=False) as file:
            file.seek(self._starts[k])
            file.readinto(both.data)
        return both[: e * e].reshape(e, e).T, both[e * e :].reshape(c, e)


class Factor:
    """The Cholesky factor of a matrix.

    Raises:
        LinAlgError: the matrix is not positive definite.
    """

    def __init__(self, matrix: Matrix) -> None:
        self.pattern = matrix.pattern
        self.total = matrix.pattern.count * matrix.pattern.size + matrix.pattern.border
        self._plain = self.total <= SMALL
        self._parts = _Parts(self.pattern.fronts)
        left = dict[int, list[tuple[Index, SetAside[Array]]]]()
        for k, front in enumerate(self.pattern.fronts):
            rest = self._eliminated(matrix, front, left.pop(k, []))
            if front.parent >= 0:
                left.setdefault(front.parent, []).append((front.unknowns[front.eliminated :], rest))

    def _eliminated(
        self, matrix: Matrix, front: Front, waiting: list[tuple[Index, SetAside[Array]]]
    ) -> SetAside[Array]:
        """Adds the next front's part of the factor, and gives what it leaves to its parent.
        `waiting`: what others left to it.
        """
        whole = _assembled(matrix, front)
        while waiting:
            unknowns, aside = waiting.pop(0)
            at, rest = _places(front.unknowns, unknowns, self.total), aside.get()
            for some in _strips(len(at)):
                whole[at[some, None], at] += rest[some]
            del aside, rest
        e = front.eliminated
        L = self._cholesky(whole[:e, :e])
        M = self._forward(L, whole[:e, e:]).T if e < len(whole) else np.zeros((0, e))
        self._parts.add(L, M)
        del L
        left = M @ M.T
        np.subtract(whole[e:, e:], left, out=left)
        return _aside(left)

    def solve(self, rhs: Array) -> Array:
        """The matrix's inverse times rhs (total,) or (total, k)."""
        x = np.array(rhs, float)
        for k, front in enumerate(self.pattern.fronts):
            e, (L, M) = front.eliminated, self._parts[k]
            x[front.unknowns[:e]] = half = self._forward(L, x[front.unknowns[:e]])
            x[front.unknowns[e:]] -= M @ half
        for k, front in reversed(list(enumerate(self.pattern.fronts))):
            e, (L, M) = front.eliminated, self._parts[k]
            rest = x[front.unknowns[:e]] - M.T @ x[front.unknowns[e:]]
            x[front.unknowns[:e]] = self._backward(L, rest)
        return x

    def selected_inverse(self) -> Matrix:
        """The inverse where the matrix has blocks (Erisman and Tinney 1975), from the last front to
        the first.
        """
        pattern, p = self.pattern, self.pattern.size
        blocks = np.empty((len(pattern.first), p, p))
        beside = np.empty((pattern.count, p, pattern.border))
        corner = np.zeros((pattern.border, pattern.border))
        above = np.array([f.parent for f in pattern.fronts])
        known = dict[int, SetAside[Array]]()
        for k in range(len(pattern.fronts) - 1, -1, -1):
            front = pattern.fronts[k]
            Z = self._inverse_of(k, known.pop(k, None))
            own = len(front.own) * p
            border = slice(len(Z) - pattern.border, len(Z))
            blocks[front.pairs] = Z[front.rows[:, :, None], front.columns[:, None, :]]
            beside[front.own] = Z[:own, border].reshape(len(front.own), p, pattern.border)
            if front.parent < 0:
                corner = Z[border, border].copy()
            for below in np.flatnonzero(above[:k] == k).tolist():
                of = pattern.fronts[below]
                at = _places(front.unknowns, of.unknowns[of.eliminated :], self.total)
                known[below] = _aside(Z[at[:, None], at])
            del Z
        return Matrix(pattern=pattern, blocks=blocks, beside=beside, corner=corner)

    def _inverse_of(self, k: int, beyond: SetAside[Array] | None) -> Array:
        """The inverse of the whole matrix at the unknowns of a front; `beyond`: the same at those
        that are eliminated later.
        """
        (L, M), size = self._parts[k], len(self.pattern.fronts[k].unknowns)
        e = len(L)
        inverse_L = self._forward(L, np.eye(e))
        if beyond is None:
            return np.asarray(inverse_L.T @ inverse_L)
        Z = np.empty((size, size))
        Z[e:, e:] = beyond.get()
        down = M @ inverse_L
        Z[e:, :e] = -Z[e:, e:] @ down
        Z[:e, e:] = Z[e:, :e].T
        Z[:e, :e] = inverse_L.T @ inverse_L - down.T @ Z[e:, :e]
        return Z

    def _cholesky(self, A: Array) -> Array:
        if self._plain:
            return np.asarray(np.linalg.cholesky(A), np.float64)
        from scipy import linalg

        return np.asarray(linalg.cholesky(A, lower=True, check_finite=False))

    def _forward(self, L: Array, rhs: Array) -> Array:
        """L^-1 rhs."""
        if self._plain or not L.size:
            return np.asarray(np.linalg.solve(L, rhs))
        from scipy import linalg

        return np.asarray(linalg.solve_triangular(L, rhs, lower=True, check_finite=False))

    def _backward(self, L: Array, rhs: Array) -> Array:
        """L^-T rhs."""
        if self._plain or not L.size:
            return np.asarray(np.linalg.solve(L.T, rhs))
        from scipy import linalg

        return np.asarray(
            linalg.solve_triangular(L, rhs, lower=True, trans="T", check_finite=False)
        )


def _assembled(matrix: Matrix, front: Front) -> Array:
    """The rows of a front in the matrix itself."""
    b, p = matrix.pattern.border, matrix.pattern.size
    whole = np.zeros((len(front.unknowns),) * 2)
    own, size = len(front.own) * p, len(whole)
    blocks = matrix.blocks[front.pairs]
    whole[front.rows[:, :, None], front.columns[:, None, :]] = blocks
    whole[front.columns[:, :, None], front.rows[:, None, :]] = np.swapaxes(blocks, 1, 2)
    beside = matrix.beside[front.own].reshape(own, b)
    whole[:own, size - b :] = beside
    whole[size - b :, :own] = beside.T
    if front.parent < 0:
        whole[size - b :, size - b :] = matrix.corner
    return whole


def _aside(values: Array) -> SetAside[Array]:
    """In memory, or beside it where they are large."""
    return SetAside(values, large=values.nbytes > WAITING)


def _strips(count: int) -> Iterator[slice]:
    """Rows of a square matrix, few at a time: the large ones of a survey take 300 MB each."""
    for low in range(0, count, STRIP):
        yield slice(low, low + STRIP)


def _places(among: Index, wanted: Index, total: int) -> Index:
    """Where each of the wanted unknowns stands among others."""
    at = np.empty(total, np.int64)
    at[among] = np.arange(len(among))
    return at[wanted]
