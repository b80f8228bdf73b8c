import csv
import math
from importlib.resources import files

import numpy as np
import piexif
import pytest

from skyquilt.geometry.camera import project
from skyquilt.photos.lens import _table, find_sensor
from skyquilt.photos.read import read_photo

from .conftest import dji_exif, dji_xmp, pixels


def exif_of(model, **tags):
    numbers = {getattr(piexif.ExifIFD, name): value for name, value in tags.items()}
    return {"0th": {piexif.ImageIFD.Make: "X", piexif.ImageIFD.Model: model}, "Exif": numbers}


def focal(make_jpeg, exif=None, xmp=None):
    return read_photo(make_jpeg(exif=exif, xmp=xmp, image=pixels(120, 90))).focal


def test_reduced_copy_scales_the_focal_length(make_jpeg):
    exif = exif_of(
        "Canon PowerShot SX260 HS",
        FocalLength=(45, 10),
        PixelXDimension=4000,
        PixelYDimension=3000,
        FocalPlaneXResolution=(4_000_000, 244),
        FocalPlaneResolutionUnit=2,
    )
    found = focal(make_jpeg, exif)
    assert (found.source, found.px) == ("sensor", pytest.approx(4.5 / 6.17 * 120))
    exif["0th"][piexif.ImageIFD.Model] = "Some other camera"
    found = focal(make_jpeg, exif)
    assert (found.source, found.px) == (
        "focal-plane",
        pytest.approx(4.5 * 4_000_000 / 244 / 25.4 * 120 / 4000),
    )
    assert found.sigma_px == pytest.approx(0.03 * found.px)


def test_35mm_equivalent_counts_for_the_diagonal(make_jpeg):
    found = focal(make_jpeg, exif_of("Unknown", FocalLengthIn35mmFilm=24))
    assert (found.source, found.px) == ("35mm", pytest.approx(24 / math.hypot(36, 24) * 150))


@pytest.mark.parametrize(
    "exif", [None, exif_of("Unknown", FocalLength=(5, 1)), exif_of("FC300S", FocalLength=(0, 0))]
)
def test_otherwise_it_is_native_or_guessed(make_jpeg, exif):
    found = focal(make_jpeg, exif)
    if exif and exif["0th"][piexif.ImageIFD.Model] == "FC300S":
        assert (found.source, found.px) == ("sensor", pytest.approx(3.61 / 6.25 * 120))
    else:
        assert (found.source, found.px, found.sigma_px) == (
            "guess",
            pytest.approx(0.75 * 120),
            pytest.approx(0.75 * 120 * 0.25),
        )


def test_a_guess_is_that_of_usual_cameras():
    """In the middle of the table, and every visible camera within two and a half deviations."""
    with files("skyquilt.photos").joinpath("sensors.csv").open() as table:
        rows = [r for r in csv.DictReader(table) if r["band"] == "visible" and r["focal_mm"]]
    known = [float(r["focal_mm"]) / float(r["sensor_width_mm"]) for r in rows]
    assert 0.45 < sum(k < 0.75 for k in known) / len(known) < 0.75
    assert all(abs(k - 0.75) < 2.5 * 0.25 * 0.75 for k in known)


def test_an_absurd_focal_length_is_passed_over(make_jpeg):
    assert focal(make_jpeg, exif_of("FC300S", FocalLength=(361_000, 1))).source == "guess"


def test_dewarp_data(make_jpeg):
    data = "2018-09-04;75.0,75.3,2.0,-1.0,-0.26,0.11,0.0002,-0.0001,-0.05"
    photo = read_photo(
        make_jpeg(
            image=pixels(120, 90), exif=dji_exif(), xmp=dji_xmp(DewarpData=data, DewarpFlag="0")
        )
    )
    camera = photo.calibration
    assert camera.focal == pytest.approx(75.0) and camera.aspect == pytest.approx(1.004)
    assert (camera.cx, camera.cy) == (pytest.approx(61.5), pytest.approx(43.5))
    assert (camera.k1, camera.k2, camera.k3, camera.p1, camera.p2) == (
        -0.26,
        0.11,
        -0.05,
        0.0002,
        -0.0001,
    )
    assert (photo.focal.source, photo.focal.px) == ("calibrated", camera.focal)


def test_pictures_that_the_camera_undistorted_are_of_a_lens_of_their_own(make_jpeg):
    """Beside others, one in four was adjusted with the others' distortion: 0.8 m off."""
    data = "2018-09-04;75.0,75.3,2.0,-1.0,-0.26,0.11,0.0002,-0.0001,-0.05"
    flat, bent = (
        read_photo(make_jpeg(image=pixels(120, 90), xmp=dji_xmp(DewarpData=data, DewarpFlag=f)))
        for f in "10"
    )
    assert flat.calibration.k1 == 0 != bent.calibration.k1
    assert flat.camera_key == f"{bent.camera_key} undistorted"


@pytest.mark.parametrize(
    ("numbers", "word"),
    [
        ("nan,75,0,0,0,0,0,0,0", "not 9 finite numbers"),
        ("75,75,0,0,0,0", "not 9 finite numbers"),
        ("a lens", "not 9 finite numbers"),
        ("-100,-100,0,0,0,0,0,0,0", "focal length of -100"),
        ("1e308,1e308,0,0,0,0,0,0,0", "focal length of 1e+308 px in a picture of 120 x 90"),
        ("75,75,80,0,0,0,0,0,0", "principal point at 140"),
        ("75,112.5,0,0,0,0,0,0,0", "factor 1.5"),
        ("75,75,0,0,1e308,0,0,0,0", "distortion that no lens has"),
        # the sensor of an FC300S is 6.25 mm long, its lens 3.61 mm
        ("500,500,0,0,0,0,0,0,0", "of another size; the camera has 69.31 px"),
    ],
)
def test_a_calibration_that_no_lens_has_is_ignored_and_named(make_jpeg, numbers, word):
    xmp = dji_xmp(DewarpData=f"2018-09-04;{numbers}")
    photo = read_photo(make_jpeg(image=pixels(120, 90), exif=dji_exif(), xmp=xmp))
    assert photo.calibration is None and photo.focal.source == "sensor"
    assert photo.unusable_calibration.startswith("DewarpData: ")
    assert word in photo.unusable_calibration
    assert f"Its calibration was ignored: {photo.unusable_calibration}." in photo.notes


def test_a_calibration_that_agrees_with_the_35_mm_equivalent_is_believed(make_jpeg):
    """A model with a long lens beside that of the table: 500 px of 120 x 90 are 144 mm."""
    exif = exif_of("FC300S", FocalLengthIn35mmFilm=144)
    xmp = dji_xmp(DewarpData="2018-09-04;500,500,0,0,0,0,0,0,0")
    photo = read_photo(make_jpeg(image=pixels(120, 90), exif=exif, xmp=xmp))
    assert photo.calibration.focal == pytest.approx(500) and not photo.unusable_calibration
    short = exif_of("FC300S", FocalLengthIn35mmFilm=20)
    photo = read_photo(make_jpeg(image=pixels(120, 90), exif=short, xmp=xmp))
    assert photo.calibration is None and "of another size" in photo.unusable_calibration


def test_a_usable_calibration_is_taken_where_another_one_is_not(make_jpeg):
    xmp = dji_xmp(DewarpData="d;-1,-1,0,0,0,0,0,0,0", CalibratedFocalLength="70")
    photo = read_photo(make_jpeg(image=pixels(120, 90), exif=dji_exif(), xmp=xmp))
    assert photo.calibration.focal == pytest.approx(70)
    assert "focal length of -1" in photo.unusable_calibration
    untold = dji_xmp(DewarpData="d;" + ",".join(["0.0"] * 9))
    none = read_photo(make_jpeg(image=pixels(120, 90), exif=dji_exif(), xmp=untold))
    assert none.calibration is None and not none.unusable_calibration


def test_calibrated_focal_length_of_a_reduced_copy(make_jpeg):
    exif = exif_of("FC6310", PixelXDimension=5472, PixelYDimension=3648)
    xmp = dji_xmp(
        CalibratedFocalLength="3666.67",
        CalibratedOpticalCenterX="2736.0",
        CalibratedOpticalCenterY="1824.0",
    )
    photo = read_photo(make_jpeg(image=pixels(120, 80), exif=exif, xmp=xmp))
    assert photo.calibration.focal == pytest.approx(3666.67 * 120 / 5472)
    assert (photo.calibration.cx, photo.calibration.cy) == (
        pytest.approx(59.5),
        pytest.approx(39.5),
    )


def test_pix4d_lens_model_in_mm(make_jpeg):
    model = (
        'xmlns:Camera="http://pix4d.com/camera/1.0/" Camera:ModelType="perspective" '
        'Camera:PerspectiveFocalLength="5.5" Camera:PrincipalPoint="2.4,1.8" '
        'Camera:PerspectiveDistortion="-0.1,0.15,-0.03,0.001,0.002"'
    )
    xmp = dji_xmp().replace("xmlns:drone-dji", model + " xmlns:drone-dji")
    exif = exif_of("RedEdge", FocalPlaneXResolution=(25, 1), FocalPlaneResolutionUnit=4)
    camera = read_photo(make_jpeg(image=pixels(120, 90), exif=exif, xmp=xmp)).calibration
    assert camera.focal == pytest.approx(5.5 * 25)
    assert (camera.cx, camera.cy, camera.p2) == (pytest.approx(59.5), pytest.approx(44.5), 0.002)


def fisheye_xmp(matrix="1600,0,0,1604", polynomial="0,1,0.02,-0.11"):
    model = (
        'xmlns:Camera="http://pix4d.com/camera/1.0/" Camera:ModelType="fisheye" '
        f'Camera:PrincipalPoint="2.45,1.8" Camera:FisheyeAffineMatrix="{matrix}" '
        f'Camera:FisheyePolynomial="{polynomial}"'
    )
    return dji_xmp().replace("xmlns:drone-dji", model + " xmlns:drone-dji")


def test_pix4d_fisheye(make_jpeg):
    """x = C rho(t) cos, y = F rho(t) sin, t the angle from the axis over a right angle."""
    exif = exif_of("Sequoia", FocalPlaneXResolution=(266, 1), FocalPlaneResolutionUnit=4)
    image = pixels(1280, 960)
    camera = read_photo(make_jpeg(image=image, exif=exif, xmp=fisheye_xmp())).calibration
    assert camera.fisheye == 1.0
    assert (camera.cx, camera.cy) == (pytest.approx(2.45 * 266 - 0.5), pytest.approx(478.3))
    angle, turn = (g.ravel() for g in np.meshgrid(np.linspace(0.01, 0.7, 30), (0.3, 2.0, 4.5)))
    t = angle * 2 / np.pi
    rho = t + 0.02 * t**2 - 0.11 * t**3
    theirs = np.column_stack([1600 * rho * np.cos(turn), 1604 * rho * np.sin(turn)])
    xyz = np.column_stack(
        [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
    )
    ours = project(camera, xyz) - (camera.cx, camera.cy)
    assert np.abs(ours - theirs).max() < 0.3  # px: odd powers stand for the even one


@pytest.mark.parametrize(
    ("matrix", "polynomial", "word"),
    [
        ("0,0,0,1600", "0,1,0,0", "affine matrix"),
        ("nan,0,0,1600", "0,1,0,0", "affine matrix"),
        ("1600,0,0,1600", "0,-1,0,0", "polynomial"),
        ("16,0,0,16", "0,1,0,0", "focal length"),
        ("1600,0,0,2600", "0,1,0,0", "differ"),
        ("1600,0,0,1600", "0,1,0,1e9", "distortion"),
    ],
)
def test_a_fisheye_that_no_lens_can_be_is_told(make_jpeg, matrix, polynomial, word):
    xmp = fisheye_xmp(matrix, polynomial)
    photo = read_photo(make_jpeg(image=pixels(1280, 960), exif=exif_of("Nothing"), xmp=xmp))
    assert photo.calibration is None
    assert word in photo.unusable_calibration


def test_sensor_table_is_sane():
    rows = [row for group in _table().values() for row in group]
    assert len(rows) >= 60
    assert all(1.5 < row.width_mm < 60 for row in rows)
    assert all(
        row.shutter in ("rolling", "global", "") and row.band in ("visible", "thermal")
        for row in rows
    )


def test_two_eyes_of_one_model_are_told_apart_by_size():
    model = "MAVIC2-ENTERPRISE-ADVANCED"
    assert find_sensor(model=model, long_side=640).band == "thermal"
    assert find_sensor(model=model, long_side=8000).band == "visible"
    assert find_sensor(model=model, long_side=1234) is None


def test_digital_zoom_lengthens_the_lens(make_jpeg):
    photo = read_photo(
        make_jpeg(exif=exif_of("FC300S", FocalLength=(361, 100), DigitalZoomRatio=(2, 1)))
    )
    assert photo.focal.px == pytest.approx(2 * 3.61 / 6.25 * 96)
    assert any("digital zoom of 2" in n for n in photo.notes)
    assert photo.zoom.factor == 2 and photo.camera_key == f"{photo.zoom.camera} zoom 2"


def test_photos_with_and_without_digital_zoom_have_intrinsics_of_their_own(make_jpeg):
    wide, near, nearer, said = (
        read_photo(make_jpeg(exif=exif_of("FC300S", FocalLength=(361, 100), **zoom)))
        for zoom in ({}, *({"DigitalZoomRatio": (z, 10)} for z in (16, 20, 10)))
    )
    assert len({wide.camera_key, near.camera_key, nearer.camera_key}) == 3
    assert said.camera_key == wide.camera_key


def test_contradicting_focal_lengths_are_named_with_both_values(make_jpeg):
    exif = exif_of("FC300S", FocalLength=(361, 100), FocalLengthIn35mmFilm=35)
    notes = read_photo(make_jpeg(exif=exif, image=pixels(120, 90))).notes
    assert any("corresponds to 69 px, its 35 mm equivalent to 121 px" in n for n in notes)


@pytest.mark.parametrize(
    ("unit", "per_unit", "px", "sigma"),
    [
        (3, 250, 100.0, 3.0),  # centimetres, as stated: 4 mm at 25 px a mm
        (2, 250, 100.0, 3.0),  # said to be inches: 39 px
    ],
)
def test_a_focal_plane_in_another_unit_than_stated(make_jpeg, unit, per_unit, px, sigma):
    exif = exif_of(
        "Unknown",
        FocalLength=(4, 1),
        FocalPlaneXResolution=(per_unit, 1),
        FocalPlaneResolutionUnit=unit,
        FocalLengthIn35mmFilm=29,  # 100.5 px
    )
    found = focal(make_jpeg, exif)
    assert found.source == "focal-plane"
    assert found.px == pytest.approx(px, rel=0.01)
    assert found.sigma_px == pytest.approx(sigma, rel=0.02)


@pytest.mark.parametrize(
    ("per_mm", "equivalent", "source", "px"),
    [
        (50, 29, "35mm", 100.4),  # 200 px by the focal plane
        (174, 29, "35mm", 100.4),  # the 35 mm equivalent written as the focal length: 696 px
        (25, 120, "focal-plane", 100.0),  # 415 px by the equivalent
        (7, 29, "35mm", 100.4),  # 28 px by the focal plane
    ],
)
def test_of_two_that_contradict_each_other_the_usual_one_is_taken(
    make_jpeg, per_mm, equivalent, source, px
):
    """It is known no better than a guess: the other one may be right."""
    exif = exif_of(
        "Unknown",
        FocalLength=(4, 1),
        FocalPlaneXResolution=(10 * per_mm, 1),
        FocalPlaneResolutionUnit=3,
        FocalLengthIn35mmFilm=equivalent,
    )
    found = focal(make_jpeg, exif)
    assert (found.source, found.px) == (source, pytest.approx(px, rel=0.01))
    assert found.sigma_px == pytest.approx(found.px / 4)


@pytest.mark.parametrize("equivalent", [4, 7, 10])
def test_a_35mm_equivalent_that_only_a_circular_fisheye_has_is_none(make_jpeg, equivalent):
    """A program wrote the focal length there: 7 mm are 24 px of 120, and 80 degrees 72 px."""
    exif = exif_of("Unknown", FocalLength=(equivalent, 1), FocalLengthIn35mmFilm=equivalent)
    found = focal(make_jpeg, exif)
    assert (found.source, found.px) == ("guess", 90.0)
    exif["Exif"][piexif.ExifIFD.FocalPlaneXResolution] = (900 // equivalent, 1)
    exif["Exif"][piexif.ExifIFD.FocalPlaneResolutionUnit] = 3
    found = focal(make_jpeg, exif)
    assert (found.source, found.sigma_px / found.px) == ("focal-plane", pytest.approx(0.03))
