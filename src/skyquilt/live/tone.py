"""Brightness of the growing map: each new photo is brought to the level of those around it.

The batch map solves for all photos at once. Here a photo gets its correction when it is placed,
from the ground that it shares with its nearest neighbours, and these keep theirs: so the cost does
not grow with the map, and no tile has to be drawn again for its tone. Where shadows of clouds were
found when photos paused, the corrections found for all photos together replace these (`take`).
"""

from collections import OrderedDict
from collections.abc import Callable, Container, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from skyquilt.imaging.grey import shrink
from skyquilt.imaging.nodes import View, project_nodes
from skyquilt.model.surface import Surface
from skyquilt.ortho.exposure import Exposure, image_place

Float = NDArray[np.float32]
Pixels = Callable[[int], NDArray[np.generic]]
"""Pixels (h, w, bands) of a photo by its number."""
LONGEST = 128
"""Longest side in px of the pictures that are compared."""
KEPT = 64
"""Number of such pictures kept in memory."""
NEIGHBOURS = 6
"""Photos that a new one is compared with."""
POINTS = 16
"""Ground points along each side of a photo's outline."""
LEAST = 12
"""Fewest ground points that must be shared."""
TRUST = 0.95
"""Share of the difference that is corrected: errors do not add up along a flight."""
CLIPPED = (8.0, 247.0)
"""Values beyond these are clipped and not compared."""
LARGEST = 1.2
"""Largest correction in log odds."""


class Tone:
    """Corrections of the photos on the map."""

    def __init__(self, pixels: Pixels) -> None:
        self._pixels = pixels
        self._gains: dict[int, Float] = {}
        self._fields: dict[int, Float] = {}
        self._offsets: dict[int, float] = {}
        self._shades: dict[int, Float] = {}
        self._taken: set[int] = set()
        self._small: OrderedDict[int, Float] = OrderedDict()

    @property
    def exposure(self) -> Exposure:
        """The corrections so far."""
        return Exposure(
            gains=self._gains, fields=self._fields, offsets=self._offsets, shades=self._shades
        )

    def forget(self, number: int) -> None:
        """Removes a photo."""
        for held in (self._gains, self._fields, self._offsets, self._shades, self._small):
            held.pop(number, None)
        self._taken.discard(number)

    def take(self, exposure: Exposure, shown: Container[int]) -> list[int]:
        """Takes corrections that were found for photos together, as bright as these were in the
        median; of those that are `shown`, whose numbers are returned.
        """
        own = sorted(i for i in exposure.gains if i in shown and i in self._gains)
        if not own:
            return []
        was, now = (np.array([of[i] for i in own]) for of in (self._gains, exposure.gains))
        level = np.median(was - now, axis=0)
        for i in own:
            self._gains[i] = (exposure.gains[i] + level).astype(np.float32)
            self._fields[i] = exposure.fields[i]
            self._shades.pop(i, None)
            if i in exposure.shades:
                self._shades[i] = exposure.shades[i]
        self._taken.update(own)
        return own

    def settle(
        self, view: View, others: Sequence[View], surface: Surface, *, measured: bool, drift: bool
    ) -> None:
        """Finds the correction of a photo from others that are settled; it keeps one that was found
        together with theirs. `measured`: its values are temperatures, to which an offset is added
        if `drift`; colours get a gain per band.
        """
        if view.photo in self._taken:
            return
        low, high = view.footprint.min(0), view.footprint.max(0)
        x, y = np.meshgrid(*(np.linspace(low[k], high[k], POINTS) for k in (0, 1)))
        z = surface.at(x, y)
        mine, seen = self._values(view, x, y, z, measured=measured)
        near = sorted(others, key=lambda v: float(np.hypot(*(v.pose.map_C - view.pose.map_C)[:2])))
        lacking = []
        for other in near[:NEIGHBOURS]:
            values, also = self._values(other, x, y, z, measured=measured, settled=True)
            if (both := seen & also).sum() >= LEAST:
                lacking.append((values - mine)[both])
        change = np.zeros(mine.shape[-1], np.float32)
        if lacking:
            change = np.float32(TRUST) * np.median(np.concatenate(lacking), axis=0)
        if measured:
            if drift:
                self._offsets[view.photo] = float(change[0])
            return
        self._gains[view.photo] = np.clip(change, -LARGEST, LARGEST).astype(np.float32)
        self._fields[view.photo] = np.zeros(6, np.float32)

    def _values(
        self,
        view: View,
        x: NDArray[np.float64],
        y: NDArray[np.float64],
        z: Float,
        *,
        measured: bool,
        settled: bool = False,
    ) -> tuple[Float, NDArray[np.bool_]]:
        """Log odds of a photo, or measured values, (r, c, bands) at places on the ground, and where
        they count; `settled`: corrected.
        """
        nodes = project_nodes(view, x, y, z)
        small = self._picture(view.photo)
        h, w = small.shape[:2]
        column = np.clip(np.rint((nodes.u + 0.5) * w / view.camera.width - 0.5), 0, w - 1)
        row = np.clip(np.rint((nodes.v + 0.5) * h / view.camera.height - 0.5), 0, h - 1)
        value = small[row.astype(int), column.astype(int)]
        if measured:
            value = value + np.float32(self._offsets.get(view.photo, 0.0) if settled else 0.0)
            return value, nodes.seen & nodes.real & np.isfinite(value).all(-1)
        held = nodes.seen & nodes.real & ((value > CLIPPED[0]) & (value < CLIPPED[1])).all(-1)
        safe = np.clip(value, 1, 254)
        level = np.log(safe / (255 - safe))
        if settled and view.photo in self._gains:
            level += np.log(self.exposure.odds(view.photo, *image_place(view, nodes.u, nodes.v)))
        return level, held

    def _picture(self, number: int) -> Float:
        """A small, smooth picture (h, w, bands) of a photo."""
        found = self._small.pop(number, None)
        if found is None:
            small = shrink(self._pixels(number), LONGEST)[0].astype(np.float32)
            h, w = small.shape[:2]
            found = np.asarray(cv2.blur(small, (3, 3)), np.float32).reshape(h, w, -1)
        self._small[number] = found
        while len(self._small) > KEPT:
            self._small.popitem(last=False)
        return found
