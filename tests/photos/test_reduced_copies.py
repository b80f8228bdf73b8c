"""Smaller copies of photos are left out, and nothing else is."""

from dataclasses import replace
from datetime import datetime

import pytest

from skyquilt.model.photo import GeoPosition
from skyquilt.photos.left_out import without_maps, without_panoramas, without_reduced
from tests.alignment.surveys import photo


def taken(name, k, *, width=4000, focal=3000.0, height=None, **more):
    place = GeoPosition(
        latitude_deg=50.8 + 1e-4 * k, longitude_deg=-0.14, altitude_m=60.0, datum="takeoff"
    )
    told = {"position": place, "time": datetime(2024, 5, 1, 12, 0, k), **more}
    made = photo(name, focal=focal)
    return replace(made, width=width, height=height or width * 3 // 4, **told)


FULL = [taken(f"DJI_{k:04d}.JPG", k) for k in range(4)]


def left_out(*more):
    kept, out = without_reduced([*FULL, *more])
    assert len(kept) + len(out) == len(FULL) + len(more)
    return {r.name for r in out}


@pytest.mark.parametrize("name", ["thumbs/DJI_0001.jpg", "small one.jpg"])
def test_a_smaller_copy_with_its_metadata(name):
    assert left_out(taken(name, 1, width=1000, focal=750.0)) == {name}


def test_a_thumbnail_without_metadata_or_with_a_focal_length_in_other_pixels():
    bare = taken("thumbs/DJI_0001.jpg", 1, width=240, time=None, position=None)
    assert left_out(bare) == {bare.name}
    assert left_out(taken("thumbs/DJI_0002.jpg", 2, width=240)) == {"thumbs/DJI_0002.jpg"}


@pytest.mark.parametrize("name", ["DJI_0001_preview.jpg", "small-dji_0001.jpg", "0001.jpg"])
def test_a_smaller_copy_whose_focal_length_counts_pixels_of_the_full_size(name):
    """Pixels per mm of the sensor, which resizing does not change."""
    assert left_out(taken(name, 1, width=2000, focal=3000.0)) == {name}


def test_a_smaller_copy_whose_focal_length_nothing_tells():
    copy = taken("DJI_0001_small.jpg", 1, width=2000, focal=1700.0)
    assert left_out(copy) == set()
    assert left_out(replace(copy, focal=replace(copy.focal, source="guess"))) == {copy.name}


@pytest.mark.parametrize("east", [-4e-6, 4e-6])
@pytest.mark.parametrize("north", [-4e-6, 4e-6])
def test_a_smaller_copy_whose_place_is_rounded(north, east):
    """Seconds of arc with two decimals are up to 3e-6 degrees away."""
    place = FULL[1].position
    moved = replace(
        place, latitude_deg=place.latitude_deg + north, longitude_deg=place.longitude_deg + east
    )
    assert left_out(taken("small.jpg", 1, width=1000, focal=750.0, position=moved)) == {"small.jpg"}


@pytest.mark.parametrize(
    "other",
    [
        taken("zoom.jpg", 1, width=2000, focal=6000.0),  # another lens of the same drone
        taken("DJI_0001_T.JPG", 1, width=2000, focal=6000.0),
        taken("DJI_0001_W.JPG", 1, width=3000, focal=1200.0),
        taken("wide.jpg", 1, width=2000, height=2000),
        taken("thermal/DJI_0001.jpg", 1, width=640, band="thermal"),
        taken("101MEDIA/DJI_0001.JPG", 9, width=2000, focal=1500.0),  # another flight
        taken("edited/DJI_0001.JPG", 1),  # as large
        taken("chat.jpg", 1, width=1600, time=None, position=None),
    ],
    ids=lambda p: p.name,
)
def test_other_photos_stay(other):
    assert left_out(other) == set()


@pytest.mark.parametrize(
    "name",
    [
        "DJI_0001_edited.JPG",
        "edits/DJI_0001-Bearbeitet.jpg",
        "DJI_0001 (1).jpg",
        "DJI_0001 copy.jpg",
    ]
    + ["DJI_0001-Edit-2.tif", "DJI_0001_HDR.jpg", "dji_0001 - Kopie.JPG", "DJI_0001-modifié.jpg"],
)
def test_an_edited_copy_beside_its_original(name):
    assert left_out(taken(name, 1)) == {name}
    assert left_out(taken(name, 1, position=None)) == {name}
    rounded = replace(FULL[1].position, latitude_deg=FULL[1].position.latitude_deg + 3e-9)
    assert left_out(taken(name, 1, position=rounded)) == {name}  # programs drop the XMP
    kept, out = without_reduced([taken(name, 1)])  # where that is all there is
    assert len(kept) == 1 and out == ()


@pytest.mark.parametrize(
    "other",
    [
        taken("DJI_0001_edited.JPG", 9),  # of another moment
        taken("DJI_0001_edited.JPG", 1, time=None),
        taken("DJI_0001_edited.JPG", 1, width=4000, height=4000),  # cropped: a view of its own
        taken("DJI_0001_T.JPG", 1),
        taken("DJI_0001_2.JPG", 1),  # a burst, a bracket, another camera of a rig
        taken("DJI_0001_edited.JPG", 1, band="thermal"),
        taken("right/DJI_0001.JPG", 1),
        taken("edited.JPG", 1),
    ],
    ids=str,
)
def test_what_is_no_edited_copy(other):
    assert left_out(other) == set()


def test_without_metadata_anywhere_equal_names_tell_nothing():
    bare = [replace(p, time=None, position=None) for p in FULL]
    small = replace(bare[0], name="second/DJI_0000.JPG", width=2000, height=1500)
    assert without_reduced([*bare, small])[1] == ()


def test_maps_are_left_out_but_not_where_all_files_are_placed():
    maps = [taken("old.tif", 5, placed=True), taken("dsm.tif", 6, placed=True)]
    kept, out = without_maps([*FULL, *maps])
    assert list(kept) == FULL and {r.name for r in out} == {"old.tif", "dsm.tif"}
    assert without_maps(maps) == (tuple(maps), ())


PANORAMA = taken("PANO0001.JPG", 2, width=8000, height=4000)


@pytest.mark.parametrize(
    ("more", "out"),
    [
        ([PANORAMA], ["PANO0001.JPG"]),
        ([taken("cut.jpg", 2, width=3000, height=1500)], []),  # a part of a photo is smaller
        ([replace(PANORAMA, height=4001)], []),
        ([replace(PANORAMA, name=f"{k}.jpg") for k in range(2)], []),  # too many for exceptions
    ],
)
def test_panoramas_are_told_by_their_shape(more, out):
    kept, gone = without_panoramas([*FULL, *more])
    assert [r.name for r in gone] == out
    assert len(kept) + len(gone) == len(FULL) + len(more)


def test_a_survey_of_that_shape_stays():
    assert without_panoramas([PANORAMA])[1] == ()
