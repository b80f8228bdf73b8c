"""Thermal frames taken while the camera's shutter was closed, by which it calibrates itself every
few minutes: they show the shutter, evenly warm. Placed by the visual photos beside them, whatever
they show, they would lie on the map as ground of one temperature.
"""

from collections import defaultdict

import numpy as np

from skyquilt.ortho.frame_pattern import Samples

FLAT = 0.2
"""Largest range of a frame that shows nothing, as a share of that of another frame at the same
places. Water is flat in all frames that show it.
"""
MOST = 0.6
"""Share of the frames that show the same ground, beside which it must be so."""
LEAST = 25
"""Fewest points that two frames must share."""


def closed_frames(samples: Samples) -> set[int]:
    """Rows of frames that are flat where the others are not."""
    order = np.lexsort((samples.row, samples.point))
    point, row, value = samples.point[order], samples.row[order], samples.value[order]
    shared = defaultdict[tuple[int, int], list[np.ndarray]](list)
    for lag in range(1, int(np.bincount(point).max(initial=1))):
        same = np.flatnonzero(point[lag:] == point[:-lag])
        both = np.column_stack([row[same], row[same + lag], value[same], value[same + lag]])
        both = both[np.lexsort((both[:, 1], both[:, 0]))]
        cuts = np.flatnonzero((np.diff(both[:, :2], axis=0) != 0).any(1)) + 1
        for part in np.split(both, cuts) if len(both) else ():
            shared[int(part[0, 0]), int(part[0, 1])].append(part[:, 2:])
    flat = defaultdict[int, list[bool]](list)
    for (a, b), parts in shared.items():
        values = np.concatenate(parts)
        if len(values) >= LEAST:
            low, high = np.percentile(values, (10, 90), axis=0)
            of_a, of_b = (high - low).tolist()
            flat[a].append(of_a < FLAT * of_b)
            flat[b].append(of_b < FLAT * of_a)
    return {k for k, told in flat.items() if np.mean(told) >= MOST}
