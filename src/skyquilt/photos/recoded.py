"""Files that another program wrote, told by how they are coded."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from skyquilt.model.photo import Photo

UNNAMED = "a program that its metadata do not name"
LEAST = 3
"""Photos of a camera that must be coded alike to tell how it codes."""


def with_editors(photos: Sequence[Photo]) -> tuple[Photo, ...]:
    """The photos; those coded otherwise than most of their camera have an unnamed editor, unless
    they name one. A camera codes all its photos alike, but for their quality.
    """
    groups: dict[str, Counter[str]] = {}
    for photo in photos:
        groups.setdefault(photo.camera_key, Counter())[photo.coding] += 1
    usual = {}
    for key, codings in groups.items():
        coding, number = codings.most_common(1)[0]
        if number >= LEAST and 2 * number > codings.total():
            usual[key] = coding
    return tuple(
        replace(p, editor=UNNAMED)
        if p.editor is None and p.coding != usual.get(p.camera_key, p.coding)
        else p
        for p in photos
    )
