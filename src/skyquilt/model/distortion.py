"""The orders of distortion that lens models come in: one table for all who fit, fix or name
them.
"""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Order:
    """Which of Brown's terms a lens model has; the others are zero."""

    radial: int
    """Radial coefficients: terms up to r^(2 radial)."""
    tangential: bool
    """Whether it has tangential ones."""

    @property
    def terms(self) -> tuple[bool, bool, bool, bool, bool]:
        """Of k1, k2, k3, p1, p2 those it has."""
        k1, k2, k3 = (self.radial > k for k in range(3))
        return k1, k2, k3, self.tangential, self.tangential


ORDERS = {
    "none": Order(radial=0, tangential=False),
    "2": Order(radial=1, tangential=False),
    "4": Order(radial=2, tangential=False),
    "6": Order(radial=3, tangential=False),
    "6t": Order(radial=3, tangential=True),
}
"""By name: radial terms up to r^0, r^2, r^4, r^6, and r^6 with tangential ones."""


def order_named(name: str) -> Order:
    """The order of a name.

    Raises:
        ValueError: there is none.
    """
    if name not in ORDERS:
        raise ValueError(f"one of {', '.join(ORDERS)} expected, got {name!r}")
    return ORDERS[name]
