import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyquilt.geometry.camera import project
from skyquilt.geometry.camera_formats import camera_from_opensfm, camera_to_opensfm
from skyquilt.model.camera import Camera

small = st.floats(-0.3, 0.3)


@given(
    st.integers(100, 9000),
    st.integers(100, 9000),
    st.floats(0.3, 5),
    small,
    small,
    small,
    small,
    st.sampled_from([0.0, 1.0]),
)
def test_round_trip(width, height, focal, k1, k2, p1, cx, fisheye):
    unit = max(width, height)
    camera = Camera(
        width=width,
        height=height,
        focal=focal * unit,
        cx=cx * unit,
        cy=height / 2,
        k1=k1,
        k2=k2,
        k3=-k1,
        p1=p1,
        fisheye=fisheye,
    )
    back = camera_from_opensfm(camera_to_opensfm(camera))
    assert back.vector == pytest.approx(camera.vector, rel=1e-9, abs=1e-6)


def test_deviations_come_along_and_are_no_part_of_the_lens():
    sigmas = (4.0, 2.0, 1.5, 0.01, 0.02, 0.03, 1e-4, 2e-4, 1e-3, 0.0)
    camera = Camera(width=640, height=480, focal=660, cx=320, cy=240, k1=-0.3, sigmas=sigmas)
    record = camera_to_opensfm(camera)
    assert record["standard_deviations"]["focal_x"] == pytest.approx(4 / 640)
    assert camera_from_opensfm(record).sigmas == pytest.approx(sigmas)
    del record["standard_deviations"]
    assert camera_from_opensfm(record).sigmas is None


@pytest.mark.parametrize("broken", [3, {"focal_x": 0.1}, {"focal_x": "wide"}])
def test_broken_deviations_are_told(broken):
    record = camera_to_opensfm(Camera.ideal(width=640, height=480, focal=660)) | {
        "standard_deviations": broken
    }
    with pytest.raises(ValueError, match="expected"):
        camera_from_opensfm(record)


def test_a_centred_principal_point_is_the_middle_of_integer_centres():
    camera = camera_from_opensfm(
        {"projection_type": "perspective", "width": 4000, "height": 3000, "focal": 0.85}
    )
    assert (camera.focal, camera.cx, camera.cy) == (3400, 1999.5, 1499.5)


@pytest.mark.parametrize("kind", ["fisheye", "fisheye_opencv", "fisheye62"])
def test_fisheyes_are_those_of_opencv(kind):
    record = {"projection_type": kind, "width": 4000, "height": 3000, "focal": 0.45}
    camera = camera_from_opensfm(record | {"k1": 0.03, "k2": -0.01, "k4": 0.0})
    xyz = np.array([[0.0, 0, 1], [1.5, -2, 1], [-0.3, 0.9, 0.7]])
    K, k = (
        np.array([[1800, 0, 1999.5], [0, 1800, 1499.5], [0, 0, 1]]),
        np.array([0.03, -0.01, 0, 0]),
    )
    theirs = cv2.fisheye.projectPoints(xyz[None], np.zeros(3), np.zeros(3), K, k)[0][0]
    assert project(camera, xyz) == pytest.approx(theirs, abs=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"projection_type": "spherical"}, "spherical"),
        ({"projection_type": "fisheye_opencv", "k4": 0.1}, "k4"),
        ({"width": "wide"}, "width"),
        ({"width": 0}, "size"),
        ({"focal": None}, "focal"),
        ({"focal": -1.0}, "positive focal"),
    ],
)
def test_a_broken_record_says_what_is_wrong(change, words):
    record = {"projection_type": "perspective", "width": 40, "height": 30, "focal": 1.0, **change}
    with pytest.raises(ValueError, match=words):
        camera_from_opensfm(record)
