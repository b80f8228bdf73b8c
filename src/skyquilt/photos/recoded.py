"""Files that another program wrote, told by how they are coded."""

from collections import Counter
from collections.abc import Sequence

UNNAMED = "a program that its metadata do not name"
"""The editor of such files."""
LEAST = 3
"""Files of a camera that must be coded alike to tell how it codes."""


def recoded(cameras: Sequence[str], codings: Sequence[str]) -> list[bool]:
    """Which files, of these cameras, are coded otherwise than most files of their camera: a camera
    codes all alike, but for their quality.
    """
    groups: dict[str, Counter[str]] = {}
    for camera, coding in zip(cameras, codings, strict=True):
        groups.setdefault(camera, Counter())[coding] += 1
    usual = {}
    for camera, group in groups.items():
        coding, number = group.most_common(1)[0]
        if number >= LEAST and 2 * number > group.total():
            usual[camera] = coding
    return [
        coding != usual.get(camera, coding) for camera, coding in zip(cameras, codings, strict=True)
    ]
