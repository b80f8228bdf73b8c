"""Photos of one place, as of a drone that hovers: pictures tell no heights, and the map has the
size that heights above take-off give it, or there is none.
"""

import math

import cv2
import numpy as np
import pytest
from PIL import Image

from skyquilt.photos.read import read_photo
from tests.end_to_end.conftest import HIGH, WIDE, named, pixels_of, relabel

HEIGHT_M = 60.0


def hovering(folder, drift_m):
    """All photos become the fifth one, swayed by about a degree, with noise of the camera."""
    rng = np.random.default_rng(3)
    files = named(folder)
    first, whole = read_photo(files[4]), files[4].read_bytes()
    picture = pixels_of(files[4])
    f = first.focal.px
    K = np.array([[f, 0, WIDE / 2], [0, f, HIGH / 2], [0, 0, 1]])
    for path in files:
        turn, _ = cv2.Rodrigues(np.radians(rng.normal(0, (0.5, 0.5, 1.0))))
        seen = cv2.warpPerspective(
            picture, K @ turn @ np.linalg.inv(K), (WIDE, HIGH), borderMode=cv2.BORDER_REFLECT
        )
        noisy = np.clip(seen + rng.normal(0, 2, seen.shape), 0, 255).astype(np.uint8)
        path.write_bytes(whole)
        with Image.open(path) as image:
            block, packet = image.info["exif"], image.info["xmp"]
        Image.fromarray(noisy).save(path, "JPEG", quality=92, exif=block, xmp=packet)
        north, east = rng.normal(0, drift_m, 2) / 111_320
        east /= math.cos(math.radians(first.position.latitude_deg))
        relabel(
            path, place=(first.position.latitude_deg + north, first.position.longitude_deg + east)
        )
    return f


@pytest.mark.slow
def test_a_hover_is_mapped_by_heights_and_angles(mosaic, photos):
    """Single points that are left by chance, anywhere before the camera, had been the ground: a
    pixel had 2 mm in place of 15 cm.
    """
    f = hovering(photos, drift_m=0.2)
    told = mosaic(photos, "--gsd", "15").made()
    assert told.metrics["native_gsd_m"] == pytest.approx(HEIGHT_M / f, rel=0.05)
    assert told.metrics["photos_used"] == 9
    assert "taken from one place" in told.notes


@pytest.mark.slow
def test_a_hover_without_a_place_is_no_map(mosaic, photos):
    """Nothing tells where its photos lie against one another but the pictures themselves."""
    hovering(photos, drift_m=0.0)
    mosaic(photos).refused(4, "taken from one place", "--geo")
