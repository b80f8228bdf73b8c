"""Features of the photos of fisheyes, found in their straightened pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from skyquilt.engine.pixel_cache import PixelCache
from skyquilt.engine.store import Store, digest
from skyquilt.matching.straightened import straightened_features
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features
from skyquilt.model.photo import Photo
from skyquilt.workflows.methods import Detector
from skyquilt.workflows.photo_features import KEPT_BYTES, PICTURE, GreyPictures, features_recipe


@dataclass(kw_only=True, eq=False)
class Straightened:
    """Features found in grey images that are straightened (`matching.straightened`), from the
    store.
    """

    photos: Sequence[Photo]
    """The photos of a survey."""
    grey: GreyPictures
    """Their grey images."""
    detector: Detector
    """Finds features."""
    store: Store
    """Keeps them."""
    _lenses: dict[int, Camera] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Those used last are kept in memory."""
        self._kept = PixelCache(read=self._found, budget_bytes=KEPT_BYTES)

    def __call__(self, photo: int, lens: Camera) -> Features:
        """Features of a photo (index) with a fisheye."""
        if self._lenses.get(photo) != lens:
            self._kept.drop(photo)
            self._lenses[photo] = lens
        return self._kept(photo)

    def _found(self, photo: int) -> Features:
        own, lens = self.photos[photo], self._lenses[photo]

        def found() -> Features:
            def of(pixels: NDArray[Any]) -> Features:
                return self.detector.of_shrunken(pixels, pixels.shape[:2])

            longest, full = self.detector.longest, (own.height, own.width)
            return straightened_features(lens, self.grey(photo, PICTURE), full, longest, of)

        recipe = features_recipe(self.detector)
        key = digest(own.pixels_key, "straight", lens, recipe)
        return self.store.get_or("features", key, found)
