"""The kind of the lenses of a growing survey: pinhole or fisheye."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from skyquilt.live.members import Members
from skyquilt.matching.lens_kind import fisheyes, may_be_fisheye
from skyquilt.model.features import Features, Link
from skyquilt.model.photo import Photo

FEWEST, MOST = 4, 64
"""Links of a camera from which, and up to which, it is asked whenever there are twice as many."""


class LiveLenses:
    """Finds out whether cameras have a fisheye. What was found once stays. After a restart a camera
    is asked again.
    """

    def __init__(self, members: Members, features: Callable[[int], Features]) -> None:
        """`features` of a photo by its number."""
        self.members, self.features = members, features
        self._asked = dict[str, int]()

    def asks(self, photo: Photo) -> bool:
        """Whether it is time to ask for the kind of the lens of a photo's camera."""
        camera, asked = photo.camera_key, self._asked.get(photo.camera_key, 0)
        if asked > MOST or photo.band != "visible" or not may_be_fisheye(photo.lens):
            return False
        own = (m for m in self.members.by_id.values() if m.photo.camera_key == camera)
        count = sum(len(m.links) for m in own) // 2
        if count < max(FEWEST, 2 * asked):
            return False
        self._asked[camera] = count
        return True

    def bent(self, camera: str, links: Sequence[Link]) -> bool:
        """Whether the links of a camera's photos show that it has a fisheye; its photos have that
        lens then. `Members.save_fisheye` stores it.
        """
        ids = {i for i, m in self.members.by_id.items() if m.photo.camera_key == camera}
        told = self.members.by_id[min(ids)].photo.lens
        matches = {(k.a, k.b): k for k in links}

        def matched(a: int, b: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            link = matches[a, b]
            return self.features(a).px[link.index_a], self.features(b).px[link.index_b]

        cameras, asked = dict.fromkeys(ids, camera), {camera: told}
        lens = fisheyes(cameras, asked, self.features, links, list(matches), matched).get(camera)
        if lens is not None:
            self.members.bend(camera, lens.focal / told.focal)
        return lens is not None
