"""The method of conjugate gradients (Hestenes and Stiefel 1952), preconditioned."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Linear = Callable[[Array], Array]
JUDGED = 3
"""Steps after which it is given up where it does not get on fast enough."""


def conjugate_gradients(
    times: Linear, nearly_inverse: Linear, rhs: Array, *, tolerance: float, most: int
) -> Array | None:
    """Solves A x = rhs (k,) for a symmetric positive definite A.

    SciPy's method ends by the plain length of the residual, which means nothing where unknowns are
    in different units. This one ends by r^T M r, for the residual r and the preconditioner M: the
    length of the error in the norm of A, as far as M is the inverse of A.

    Args:
        times: the product with A.
        nearly_inverse: the product with M, symmetric positive definite.
        rhs: right-hand side.
        tolerance: length of the residual at which it ends, relative to that of rhs.
        most: steps at most.

    Returns:
        x, or None where `most` steps are not enough, as its pace so far tells.
    """
    x, residual = np.zeros_like(rhs), rhs.copy()
    near = nearly_inverse(residual)
    way, left = near, float(residual @ near)
    first, enough = left, tolerance**2 * left
    for step in range(most):
        if left <= enough:
            return x
        if step >= JUDGED and left > first * tolerance ** (2 * step / most):
            return None
        image = times(way)
        length = left / float(way @ image)
        x += length * way
        residual -= length * image
        near = nearly_inverse(residual)
        before, left = left, float(residual @ near)
        way = near + left / before * way
    return x if left <= enough else None
