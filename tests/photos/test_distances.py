"""Known distances as people write them."""

from contextlib import suppress

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skyquilt.errors import SideFileError
from skyquilt.model.photo import ControlPoint, PointObservation
from skyquilt.photos.distances import read_distances

NAMES = ("one.jpg", "two.jpg", "sub/three.jpg")
LONG = "point_a,point_b,metres,px_a,py_a,image_a,px_b,py_b,image_b\n"


def read(folder, text, control=()):
    path = folder / "distances.csv"
    path.write_text(text)
    return read_distances(path, NAMES, control)


def test_columns_of_pixels(tmp_path):
    (d,) = read(
        tmp_path,
        LONG + "A,B,31.5,10,20,one.jpg,30.5,40,TWO.JPG\nA,B,31.5,11,21,three,30.5,40,two.jpg\n",
    )
    assert (d.a, d.b, d.metres) == ("A", "B", 31.5)
    assert [(o.photo, o.x, o.y) for o in d.observations_a] == [
        ("one.jpg", 10, 20),
        ("sub/three.jpg", 11, 21),
    ]
    assert [(o.photo, o.x, o.y) for o in d.observations_b] == [("two.jpg", 30.5, 40)]


def test_points_of_the_list_of_control_points(tmp_path):
    points = [
        ControlPoint(
            name=n,
            x=0,
            y=0,
            z=None,
            crs="EPSG:32633",
            observations=(PointObservation(photo="one.jpg", x=k, y=2),),
        )
        for k, n in enumerate("PQ")
    ]
    (d,) = read(tmp_path, "point_a,point_b,metres\nP,Q,12\n", points)
    assert d.observations_a[0].x == 0 and d.observations_b[0].x == 1


def test_points_written_as_observations(tmp_path):
    (d,) = read(tmp_path, "point_a, point_b, metres\n100.5 200 one.jpg, 7 8 two.jpg, 9.25\n")
    assert (d.observations_a[0].photo, d.observations_a[0].x, d.metres) == ("one.jpg", 100.5, 9.25)


def test_several_distances_share_their_points(tmp_path):
    rows = "A,B,10,1,1,one.jpg,2,2,one.jpg\nB,C,20,2,2,one.jpg,3,3,one.jpg\n"
    first, second = read(tmp_path, LONG + rows)
    assert first.observations_b == second.observations_a


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "found '' and 0 lines"),
        ("point_a,point_b,metres\n", "0 lines"),
        ("a,b,c\n1,2,3\n", "expected a header"),
        (
            LONG + "A,B,-3,1,1,one.jpg,2,2,one.jpg\n",
            "line 2: expected a length in m above 0, found '-3'",
        ),
        (LONG + "A,B,far,1,1,one.jpg,2,2,one.jpg\n", "found 'far'"),
        (LONG + "A,B,nan,1,1,one.jpg,2,2,one.jpg\n", "found 'nan'"),
        (
            LONG + "A,B,3,1,1,nine.jpg,2,2,ten.jpg\n",
            "names nine.jpg, ten.jpg; no photo of the survey",
        ),
        (LONG + "A,B,3,x,1,one.jpg,2,2,one.jpg\n", "there is no observation of point 'A'"),
        ("point_a,point_b,metres\nA,B,3\n", "there is no observation of point 'A'"),
        (
            LONG + "A,B,3,1,1,one.jpg,2,2,one.jpg\nA,B,4,1,1,one.jpg,2,2,one.jpg\n",
            "two different lengths",
        ),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, says):
    with pytest.raises(SideFileError, match=says.replace("(", r"\(")):
        read(tmp_path, text)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(SideFileError, match="cannot be read"):
        read_distances(tmp_path / "none.csv", NAMES)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(text=st.text(alphabet='point_a,b metres12.-\n"\t;é', max_size=200))
def test_no_text_raises_anything_else(tmp_path, text):
    with suppress(SideFileError):
        read(tmp_path, text)
