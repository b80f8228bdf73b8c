"""The order in which photos are joined: by time, by name, or from a file."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from skyquilt.errors import SideFileError
from skyquilt.photos.side_rows import PhotoNames, read_lines, sentence_of


def sequence_of(names: Sequence[str], how: str) -> list[int]:
    """Indices of photos (names in order of capture) in the order of `how`: `time`, `name`, or a
    file's path.

    A file has one photo name per line; photos that are not in it are left out.

    Raises:
        SideFileError: the file cannot be read, names no photo or an unknown one, or one twice.
    """
    if how == "time":
        return list(range(len(names)))
    if how == "name":
        return sorted(range(len(names)), key=lambda i: _natural(names[i]))
    path = Path(how)
    wanted = [line for _, line in read_lines(path)]
    known, index = PhotoNames(names), {name: i for i, name in enumerate(names)}
    found = [known.find(w) for w in wanted]
    strangers = [w for w, f in zip(wanted, found, strict=True) if f is None]
    if strangers or not wanted:
        what = (
            f"names {sentence_of(strangers)}, which are no photos of the survey"
            if strangers
            else "is empty"
        )
        raise SideFileError(f"{path.name} {what}; expected one photo name per line.")
    order = [index[f] for f in found if f is not None]
    if len(set(order)) < len(order):
        twice = sorted(names[i] for i, n in Counter(order).items() if n > 1)
        raise SideFileError(
            f"{path.name} names {sentence_of(twice)} more than once. Remove one of the lines."
        )
    return order


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key for the natural order of names: 2 before 10."""
    parts = re.split(r"([0-9]+)", name.lower())
    # leading zeros do not count, and numbers may be too long for an integer
    return [
        (0, len(n := p.lstrip("0")), n) if "0" <= p[0] <= "9" else (1, 0, p) for p in parts if p
    ]
