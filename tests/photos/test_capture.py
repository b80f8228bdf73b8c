"""The picture of which a file is a copy or a part: its focal length counts there too."""

import piexif
import pytest

from skyquilt.model.camera import Camera
from skyquilt.photos.capture import native_picture
from skyquilt.photos.read import read_photo
from skyquilt.photos.tags import PIXELS_X, PIXELS_Y, Exif

from .conftest import dji_exif, dji_xmp, pixels


def native(width, height, x=4000, y=3000, **more):
    return native_picture(Exif(tags={PIXELS_X: x, PIXELS_Y: y}), width, height, **more)


@pytest.mark.parametrize(
    ("size", "scale", "sigma"),
    [
        ((4000, 3000), 1.0, 0.0),
        ((1000, 750), 0.25, 0.0),
        ((1001, 750), 0.25, 0.0),
        ((750, 1000), 0.25, 0.0),
    ],
)
def test_a_copy_is_no_part(size, scale, sigma):
    found = native(*size)
    assert not found.part and found.note == "" and found.rows == 1
    assert (found.scale, found.sigma_scale) == (pytest.approx(scale, rel=2e-3), sigma)


@pytest.mark.parametrize(
    ("size", "scale", "sigma"),
    [
        ((4000, 2250), 1.0, 0.0),  # bars cut off
        ((2400, 3000), 1.0, 0.0),  # a side cut off: the longer side is another one
        ((3000, 3000), 1.0, 0.0),
        ((3600, 2800), 1.0, 0.067),  # hardly reduced besides, if at all
        ((1500, 1500), 0.5, 0.25),  # reduced and cut off, or cut out
        ((5320, 3000), 1.33, 0.25),  # bars added, or stretched
    ],
)
def test_the_scale_of_a_part_and_what_is_unknown_of_it(size, scale, sigma):
    found = native(*size)
    assert found.part
    assert found.scale == pytest.approx(scale, rel=1e-3)
    assert found.sigma_scale == pytest.approx(sigma, abs=1e-3)
    assert ("uncertain" in found.note) == (sigma > 0) and "4000x3000" in found.note
    assert native(size[1], size[0], 3000, 4000).scale == found.scale  # upright


def test_a_thermal_frame_is_no_part_of_the_picture_beside_it():
    found = native(640, 512, 1440, 1080, whole=True)
    assert not found.part and max(found.width, found.height) == 1440
    assert found.scale == 640 / 1440


def cut_out(x, y):
    exif = dji_exif()
    exif["Exif"] |= {piexif.ExifIFD.PixelXDimension: x, piexif.ExifIFD.PixelYDimension: y}
    return exif


def test_the_focal_length_of_a_part_is_that_of_the_whole_picture(make_jpeg):
    """The sensor of an FC300S is 6.25 mm long, its lens 3.61 mm."""
    part = read_photo(make_jpeg(image=pixels(72, 90), exif=cut_out(120, 90)))
    assert part.focal.px == pytest.approx(3.61 / 6.25 * 120) and part.whole_told
    assert part.focal.sigma_px == pytest.approx(0.02 * part.focal.px)
    assert any("72x90: cropped; its focal" in n for n in part.notes)
    both = read_photo(make_jpeg(image=pixels(60, 60), exif=cut_out(120, 90)))
    assert both.focal.px == pytest.approx(3.61 / 6.25 * 120 * 60 / 90)
    assert both.focal.sigma_px == pytest.approx(0.25 * both.focal.px, rel=0.01)
    whole = read_photo(make_jpeg(image=pixels(120, 90), exif=cut_out(120, 90)))
    assert not whole.whole_told and whole.focal.px == part.focal.px


def test_the_shutter_reads_the_rows_of_a_part_in_less_time(make_jpeg):
    whole, low, narrow = (
        read_photo(make_jpeg(image=pixels(*size), exif=cut_out(120, 90))).shutter
        for size in ((120, 90), (120, 60), (72, 90))
    )
    assert whole.source == "table" and 0 < whole.readout_s == narrow.readout_s
    assert low.readout_s == pytest.approx(whole.readout_s * 60 / 90)
    assert low.sigma_s == pytest.approx(whole.sigma_s * 60 / 90)


def test_a_calibration_of_the_whole_picture_keeps_its_lens(make_jpeg):
    xmp = dji_xmp(DewarpData="2018-09-04;75.0,75.3,2.0,-1.0,-0.26,0.11,0.0002,-0.0001,-0.05")
    read = {
        size: read_photo(make_jpeg(image=pixels(*size), exif=cut_out(120, 90), xmp=xmp)).calibration
        for size in ((120, 90), (72, 90))
    }
    whole, part = read[120, 90], read[72, 90]
    assert part.vector[3:].tolist() == whole.vector[3:].tolist() and part.focal == whole.focal
    assert (part.width, part.height) == (72, 90)
    assert (part.cx, part.cy) == (35.5, 44.5)  # nothing tells where it was cut out
    assert part.sigmas[1:3] == pytest.approx((0.9, 0.9)) and part.sigmas[3:] == whole.sigmas[3:]


def test_a_calibration_without_deviations_has_none_in_a_part():
    lens = Camera(width=120, height=90, focal=75.0, cx=59.5, cy=44.5)
    assert native(60, 60, 120, 90).camera_of_file(lens).sigmas is None
    assert native(60, 60, 120, 90).camera_of_file(lens).focal == pytest.approx(50)
    assert native(60, 45, 120, 90).camera_of_file(lens).focal == pytest.approx(37.5)
