"""Common frame of estimators that search by random samples and then refine: checks, search,
refusals, record.
"""

from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike, NDArray

from skyquilt.geometry.transforms import symmetric_transfer_errors
from skyquilt.matching.estimate import (
    Doubles,
    Estimate,
    NoEstimate,
    matched,
    polished,
    too_few,
    weak,
)
from skyquilt.matching.search import Found

Search = Callable[[Doubles, Doubles], Found | None]
"""Finds the best model from random samples of matches a, b (N, 2) px; None if no sample determines
one.
"""
Finalise = Callable[[NDArray[Any], Doubles, Doubles], tuple[Doubles, float] | NoEstimate]
"""b_H_a of a search -> the one to refine, and the largest symmetric transfer error of an inlier in
px^2.
"""


def estimated(
    name: str,
    model: str,
    a: ArrayLike,
    b: ArrayLike,
    *,
    minimum: int,
    find: Search,
    finalise: Finalise,
) -> Estimate | NoEstimate:
    """b_H_a from matches a, b (N, 2) px by the loss of `find` and `finalise`, or the reason why
    there is none.
    """
    a, b = matched(a, b)
    if (few := too_few(model, len(a), minimum)) is not None:
        return few
    found = find(a, b)
    if found is None:
        return NoEstimate(reason=f"no {model} fits the matches")
    final = finalise(found.b_H_a, a, b)
    if isinstance(final, NoEstimate):
        return final
    H, inliers = polished(model, final[0], a, b, final[1])
    if (feeble := weak(model, int(inliers.sum()), len(a), minimum)) is not None:
        return feeble
    return Estimate(
        model=model,
        b_H_a=H,
        inliers=inliers,
        iterations=found.iterations,
        capped=found.capped,
        ste_per_inlier=float(symmetric_transfer_errors(H, a[inliers], b[inliers]).mean()),
        method=name,
    )
