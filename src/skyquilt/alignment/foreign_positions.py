"""Positions of photos that no link connects with the largest block, which has none itself: a few
photos of another place or day, or of a phone, among those of a camera without a receiver.

They would give the map a coordinate system, and the largest block no place in it.
"""

from dataclasses import replace

import numpy as np

from skyquilt.alignment.crowded_positions import unplaced, without_crowded, without_places
from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.alignment.tracks import blocks_of
from skyquilt.photos.side_rows import sentence_of


def usable_positions(inputs: AlignmentInputs) -> tuple[AlignmentInputs, tuple[str, ...]]:
    """The inputs without positions that crowd, and without those of other places than the largest
    block's, and sentences on both; the very same inputs where there are none.
    """
    inputs, said = without_foreign(inputs)
    left, more = without_crowded(inputs)
    return left, (*said, *more)


def without_foreign(inputs: AlignmentInputs) -> tuple[AlignmentInputs, tuple[str, ...]]:
    """The inputs without positions where only photos report any that are not linked with the
    largest block, and fewer, with those linked with them, than it has; and a sentence on these. The
    very same inputs otherwise.
    """
    if not inputs.links or inputs.frame.crs is None or inputs.former is not None:
        return inputs, ()
    if any(not point.check for point in inputs.control):
        return inputs, ()
    block = blocks_of(len(inputs.photos), inputs.links)
    told = np.array([bool(np.isfinite(p.map_C[:2]).all()) for p in inputs.priors])
    first = block == np.bincount(block).argmax()
    others = np.isin(block, block[told])
    if told[first].any() or not 0 < others.sum() < first.sum():
        return inputs, ()
    names = sentence_of([inputs.photos[i].name for i in np.flatnonzero(told).tolist()])
    note = (
        f"The positions of {names} were not used: no link connects these photos with the"
        f" {first.sum()} of the largest block, which have none. The map shows the largest block,"
        " and is not georeferenced. Give its positions in a geo.txt, or control points, or map the"
        " others by themselves."
    )
    bare = without_places(inputs.priors)
    return replace(inputs, priors=bare, frame=unplaced(inputs.frame)), (note,)
