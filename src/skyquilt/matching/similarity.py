"""How alike the descriptors of two photos are."""

import numpy as np
from numpy.typing import NDArray

from skyquilt.model.features import Features, Matches


def similarities(a: Features, b: Features) -> NDArray[np.float32]:
    """(len(a), len(b)) dot products of unit descriptors: 1 equal, 0 unrelated.

    Raises:
        ValueError: the descriptors are of different kinds.
    """
    if a.binary != b.binary or a.descriptors.shape[1] != b.descriptors.shape[1]:
        kinds = [f"{'binary' if f.binary else 'real'} of {f.descriptors.shape[1]}" for f in (a, b)]
        raise ValueError(f"descriptors of one kind expected, got {kinds[0]} and {kinds[1]}")
    return np.asarray(a.unit @ b.unit.T)


def no_matches() -> Matches:
    """None at all."""
    return Matches(index_a=np.zeros(0, np.int64), index_b=np.zeros(0, np.int64))
