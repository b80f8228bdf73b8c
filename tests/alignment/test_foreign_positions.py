"""Positions of a few photos of another place do not stand for a block that has none."""

from dataclasses import replace

import numpy as np
import pytest

from skyquilt.alignment.aligners import Auto, ByLinks, by_pose
from skyquilt.alignment.crowded_positions import unplaced, without_places
from skyquilt.alignment.far_sites import site_notes, with_site_notes
from skyquilt.alignment.foreign_positions import without_foreign
from skyquilt.model.photo import ControlPoint
from skyquilt.model.poses import Pose
from tests.alignment.surveys import alignment
from tests.alignment.test_crowded_positions import inputs
from tests.alignment.test_oblique_start import Slanting

PLACES = [(x, y, 45.0, 20.0, 0.0) for y in (-20, 0) for x in (-36, -18, 0, 18, 36)]
ASIDE = [(x, 60.0, 45.0, 20.0, 0.0) for x in (-60, -42, -24, -6)]


def two_places(*, told, beside=ASIDE, seed=0):
    """Ten photos and a few of another flight, not linked; `told` have positions."""
    survey = Slanting([*PLACES, *beside], seed=seed)
    n = len(PLACES)
    links = [k for k in survey.links if (k.a < n) == (k.b < n)]
    priors = [
        p if i in told else replace(p, map_C=np.r_[np.nan, np.nan, p.map_C[2:]])
        for i, p in enumerate(survey.priors)
    ]
    return replace(inputs(survey, priors), links=links)


def aligned(given):
    return Auto(bundle=ByLinks(), pose=by_pose(None, repair=True))(given)


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_the_largest_block_is_not_placed_by_a_few_photos_of_another_place(seed):
    given = two_places(told=range(10, 14), seed=seed)
    found = aligned(given)
    assert found.frame.crs is None and "not georeferenced" in found.why
    assert set(found.poses) == set(range(10)) and "its place is not known" in found.rejected[12]
    assert sum("10.jpg, 11.jpg" in note for note in found.notes) == 1


def test_a_second_place_is_told_as_such_where_no_photo_has_metadata():
    """It is not sought among the tie points of the largest block, with which it has none in
    common."""
    given = two_places(told=[])
    bare = [replace(p, yaw_deg=np.nan, sigma_tilt_deg=6.0) for p in without_places(given.priors)]
    found = aligned(replace(given, priors=bare, frame=unplaced(given.frame)))
    assert set(found.poses) == set(range(10))
    assert found.rejected.keys() == set(range(10, 14))
    assert all("not with the 10 of the largest block" in w for w in found.rejected.values())
    # photos that are hung on others later look for the blocks of all that show a tie point
    assert set(found.ties.photo.tolist()) == set(range(10))


def test_one_photo_without_links_places_no_block():
    found = aligned(two_places(told=[10], beside=ASIDE[:1]))
    assert found.frame.crs is None and set(found.poses) == set(range(10))


@pytest.mark.slow
def test_as_many_photos_of_another_place_are_the_map():
    """And the block whose place nothing tells is left out: it would lie anywhere."""
    beside = [(x, y, 45.0, 20.0, 0.0) for y in (60, 78) for x in (-60, -42, -24, -6, 12)]
    given = two_places(told=range(10, 20), beside=beside)
    assert without_foreign(given) == (given, ())
    found = aligned(given)
    assert found.frame.crs and set(found.poses) == set(range(10, 20))
    assert "not with the 10 of those that positions place" in found.rejected[0]


def test_positions_of_the_largest_block_and_control_points_place_the_map():
    one = two_places(told=[3, *range(10, 14)])
    assert without_foreign(one) == (one, ())
    point = ControlPoint(name="a", x=0.0, y=0.0, z=0.0, crs="EPSG:32630", observations=())
    surveyed = replace(two_places(told=range(10, 14)), control=(point,))
    assert without_foreign(surveyed) == (surveyed, ())
    bare = two_places(told=[])
    assert without_foreign(bare) == (bare, ())


def apart(*east_m):
    """Blocks of four photos, 15 m apart, that many m further east each."""
    found = alignment(4 * len(east_m))
    poses = {
        i: Pose(cam_R_map=p.cam_R_map, map_C=np.array([east_m[i // 4], 15.0 * (i % 4), 60.0]))
        for i, p in found.poses.items()
    }
    blocks = tuple(tuple(range(i, i + 4)) for i in range(0, len(poses), 4))
    return replace(found, poses=poses, blocks=blocks), [f"{i}.jpg" for i in range(len(poses))]


def test_several_places_far_from_one_another_are_told():
    found, names = apart(0.0, 80.0, 3000.0)
    (note,) = site_notes(found, names)
    assert "at 2 places up to 3.0 km" in note and "besides the 8 photos" in note
    assert "4 photos (8.jpg, 9.jpg, 10.jpg, 11.jpg)" in note
    assert with_site_notes(found, names).notes == (*found.notes, note)


def test_flights_side_by_side_are_one_place():
    for found, names in (apart(0.0, 250.0, 500.0), apart(0.0)):
        assert with_site_notes(found, names) is found
    found, names = apart(0.0, 3000.0)
    nowhere = replace(found, frame=replace(found.frame, crs=None))
    assert not site_notes(nowhere, names)
