"""Heights from two photos of a painted level ground."""

import numpy as np
import pytest

from skyquilt.imaging.grey import shrink
from skyquilt.ortho.pair_matching import matched_points, pair_of
from tests.ortho.scenes import photograph, view

HEIGHT = 40.0


def heights(longest, *places, above=0.0, yaw=0.0):
    """Heights (n,) in m found between two photos at places (x, y), searched around a plane `above`
    the ground.
    """
    a, b = (view(k, x, y, z=HEIGHT, yaw=yaw) for k, (x, y) in enumerate(places))
    small = [shrink(np.clip(photograph(v), 0, 255).astype(np.uint8), longest)[0] for v in (a, b)]
    pair = pair_of(a, b, above, HEIGHT / 350 * 400 / longest)
    assert pair is not None
    return matched_points(pair, *small, -4.0 - above, 4.0 - above, 5)[:, 2] + pair.origin[2]


@pytest.mark.parametrize("yaw", [0.0, 90.0], ids=["across", "along"])
@pytest.mark.parametrize("longest", [250, 330])
def test_rounded_sides_of_reduced_pictures_do_not_lift_the_ground(longest, yaw):
    """Of 300 rows a picture of 250 px has 188, not 187.5: as many thousandths of the flying height
    were added where the photos lie behind one another in their own frame.
    """
    z = heights(longest, (-5.0, 0.0), (5.0, 0.0), yaw=yaw)
    assert len(z) > 3000 and abs(np.median(z)) < 0.03


@pytest.mark.parametrize("above", [-0.9, -0.35, 0.2, 0.6])
def test_parts_of_a_pixel_are_not_pulled_to_whole_ones(above):
    """The matcher alone is off by up to a seventh of a pixel, 0.11 m; a pixel is 0.73 m."""
    z = heights(250, (-5.0, 1.0), (5.0, -1.0), above=above)
    assert abs(np.median(z)) < 0.02
    assert np.percentile(np.abs(z), 90) < 0.1
