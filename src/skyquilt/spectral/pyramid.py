"""Both pictures at several resolutions."""

from collections.abc import Sequence

from skyquilt.model.registration import Matrix
from skyquilt.spectral.orientation import Orientation, between, full_size, orientation
from skyquilt.spectral.usable import Usable


class Pyramid:
    """Orientation fields of two pictures, each resolution made when first asked for."""

    def __init__(self, *, a: Usable, b: Usable, sides: Sequence[float]) -> None:
        """`sides`: px of the squares whose areas the pictures are shrunken to."""
        self._pictures, self._sides = (a, b), tuple(sides)
        self._levels: dict[int, tuple[Orientation, Orientation]] = {}

    def finest(self, side: float) -> tuple[Orientation, Orientation] | None:
        """a and b at a side beyond the last level; None where one of them is not that large."""
        if any(one.grey.size < side**2 for one in self._pictures):
            return None
        a, b = (orientation(p.grey, p.valid, side) for p in self._pictures)
        return a, b

    @property
    def last(self) -> int:
        """The finest level."""
        return len(self._sides) - 1

    def at(self, level: int) -> tuple[Orientation, Orientation]:
        """a and b at a level."""
        if level not in self._levels:
            a, b = (orientation(p.grey, p.valid, self._sides[level]) for p in self._pictures)
            self._levels[level] = a, b
        return self._levels[level]

    def moved(self, small: Matrix, source: int, target: int) -> Matrix:
        """A transform in px of one level in those of another."""
        return self.small(self.full(small, source), target)

    def small(self, full: Matrix, level: int) -> Matrix:
        """A transform in px of the pictures in those of a level."""
        return between(*self.at(level), full)

    def full(self, small: Matrix, level: int) -> Matrix:
        """A transform in px of a level in those of the pictures."""
        return full_size(*self.at(level), small)
