"""How much two pictures tell about each other, whatever grey or colour each gives to a thing."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def mutual_information(
    a: NDArray[Any], b: NDArray[Any], mask: NDArray[np.bool_] | None = None, *, bins: int = 32
) -> float:
    """Normalised mutual information (H(a) + H(b)) / H(a, b) - 1 in [0, 1] (Studholme et al. 1999)
    where `mask` holds.

    0 independent, 1 each determines the other. Grey values of each (H, W) are put into `bins`
    between their 1st and 99th percentile; a value counts in two neighbouring bins by its nearness,
    so that the result is smooth.
    """
    x, y = (np.asarray(p, np.float64)[... if mask is None else mask].ravel() for p in (a, b))
    if x.size < bins:
        return 0.0
    joint = np.zeros((bins + 1, bins + 1))
    (i, s), (j, t) = _binned(x, bins), _binned(y, bins)
    for di, wi in ((0, 1 - s), (1, s)):
        for dj, wj in ((0, 1 - t), (1, t)):
            joint += np.bincount((i + di) * (bins + 1) + j + dj, wi * wj, joint.size).reshape(
                joint.shape
            )
    joint /= joint.sum()
    both = _entropy(joint)
    return (_entropy(joint.sum(0)) + _entropy(joint.sum(1))) / both - 1 if both > 1e-12 else 0.0


def _binned(
    values: NDArray[np.float64], bins: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Lower bin and nearness to the next."""
    low, high = np.percentile(values, [1, 99])
    place = np.clip((values - low) / max(high - low, 1e-12), 0, 1) * (bins - 1)
    lower = place.astype(np.int64)
    return lower, place - lower


def _entropy(p: NDArray[np.float64]) -> float:
    positive = p[p > 0]
    return float(-(positive * np.log(positive)).sum())
