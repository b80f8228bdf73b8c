"""Points that are added where views are lacking, and points that nobody misses."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix


def added(seen: Sequence[NDArray[np.int32]], lack: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which candidates (n,) to take so that no cell lacks views, as far as they can.

    The greedy method for covers with multiplicities, whose number of sets is at most the harmonic
    number of the largest set's size times the least number (Rajagopalan and Vazirani 1998).
    `seen`: cells of each candidate; `lack`: views that each cell lacks.
    """
    chosen = np.zeros(len(seen), bool)
    wanted = np.flatnonzero(lack > 0)
    if not len(wanted) or not len(seen):
        return chosen
    number = np.full(len(lack), -1)
    number[wanted] = np.arange(len(wanted))
    lists = [number[s] for s in seen]
    lists = [s[s >= 0] for s in lists]
    ends = np.cumsum([0, *(len(s) for s in lists)])
    matrix = csr_matrix(
        (np.ones(ends[-1], np.int32), np.concatenate(lists), ends), (len(seen), len(wanted))
    )
    columns = matrix.tocsc()
    left = lack[wanted].copy()
    gain = np.diff(ends).astype(np.int64)
    while True:
        best = int(np.argmax(gain))
        if gain[best] <= 0:
            return chosen
        chosen[best] = True
        gain[best] = -1
        cells = lists[best]
        left[cells] -= 1
        for cell in cells[left[cells] == 0]:
            rows = columns.indices[columns.indptr[cell] : columns.indptr[cell + 1]]
            gain[rows] -= 1


def needless(
    seen: Sequence[NDArray[np.int32]], run: NDArray[np.int64], counts: NDArray[np.int32], views: int
) -> NDArray[np.bool_]:
    """Which points (n,) can go, one after the other, without a cell falling under its views.

    Inside a run of a line none goes, so consecutive photos keep their overlap: only its ends, and
    points added singly (`run` -1).
    """
    gone = np.zeros(len(seen), bool)
    counts = counts.copy()
    members: dict[int, list[int]] = {}
    for k, r in enumerate(run.tolist()):
        members.setdefault(r if r >= 0 else -1 - k, []).append(k)
    again = True
    while again:
        again = False
        ends = [k for m in members.values() if m for k in {m[0], m[-1]}]
        # first those whose cells can spare them most
        spare = {k: float(counts[seen[k]].mean()) for k in ends}
        for k in sorted(ends, key=lambda k: (len(seen[k]), -spare[k])):
            if (counts[seen[k]] > views).all():
                counts[seen[k]] -= 1
                gone[k] = True
                again = True
        for m in members.values():
            while m and gone[m[0]]:
                m.pop(0)
            while m and gone[m[-1]]:
                m.pop()
    return gone
