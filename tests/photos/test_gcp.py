import pytest

from skyquilt.errors import SideFileError
from skyquilt.photos.gcp import check_control, read_gcp_list
from skyquilt.photos.read import read_photo

from .conftest import dji_exif, dji_xmp


@pytest.fixture
def photo(make_jpeg):
    return read_photo(make_jpeg("DJI_0001.JPG", exif=dji_exif(), xmp=dji_xmp()))


def checked(tmp_path, photo, text):
    path = tmp_path / "gcp_list.txt"
    path.write_text(text)
    control, _ = read_gcp_list(path, [photo.name])
    check_control(path, control, [photo])
    return control


def place(photo):
    return photo.position.longitude_deg, photo.position.latitude_deg


def test_points_near_the_photos_are_taken(tmp_path, photo):
    x, y = place(photo)
    (point,) = checked(tmp_path, photo, f"EPSG:4326\n{x + 0.1} {y} 100 5 6 DJI_0001.JPG a\n")
    assert (point.x, point.y) == (x + 0.1, y)


def test_points_of_another_system_or_with_swapped_axes_are_refused(tmp_path, photo):
    x, y = place(photo)
    with pytest.raises(SideFileError, match=r"km from the photos. .* order of x \(east\)"):
        checked(tmp_path, photo, f"EPSG:4326\n{y} {x / 2} 100 5 6 DJI_0001.JPG a\n")
    with pytest.raises(SideFileError, match="no place in EPSG:32632|km from the photos"):
        checked(tmp_path, photo, "EPSG:32632\n1e300 5e6 100 5 6 DJI_0001.JPG a\n")


@pytest.mark.parametrize("pixel", ["-50 5", "5 -50", "100000 5", "5 100000"])
def test_a_pixel_outside_its_photo_is_refused(tmp_path, photo, pixel):
    x, y = place(photo)
    with pytest.raises(SideFileError, match=r"outside DJI_0001.JPG of \d+ x \d+ px"):
        checked(tmp_path, photo, f"EPSG:4326\n{x} {y} 100 {pixel} DJI_0001.JPG a\n")


def test_one_point_at_two_places_of_a_photo_is_refused(tmp_path, photo):
    x, y = place(photo)
    rows = [f"{x} {y} 100 {column} 6 DJI_0001.JPG a\n" for column in (5, 9)]
    with pytest.raises(SideFileError, match=r"a is observed at two places of DJI_0001.JPG"):
        checked(tmp_path, photo, "EPSG:4326\n" + "".join(rows))
    # a row that stands there twice counted twice
    (point,) = checked(tmp_path, photo, "EPSG:4326\n" + 2 * rows[0])
    assert len(point.observations) == 1


ROW = ("446363.450", "5160978.180", "437.678", "33.10", "51.48", "DJI_0001.JPG", "p 1")


@pytest.mark.parametrize(
    "text",
    [
        "\t".join(ROW),
        ",".join(ROW),
        ", ".join(ROW),
        ";".join(ROW),
        ",".join(f'"{w}"' for w in ROW),
        ";".join(w.replace(".", ",") for w in ROW[:5]) + ";" + ";".join(ROW[5:]),
        "\t".join(w.replace(".", ",") for w in ROW[:5]) + "\t" + "\t".join(ROW[5:]),
        "geo_x geo_y geo_z im_x im_y image_name gcp_name\n" + "\t".join(ROW),
        "x,y,z,px,py,image,name\n" + ",".join(ROW),
    ],
)
def test_columns_as_spreadsheets_write_them(tmp_path, text):
    path = tmp_path / "gcp_list.txt"
    path.write_text(f"EPSG:32633\n{text}\n")
    ((point,), notes) = read_gcp_list(path, ["DJI_0001.JPG"])
    assert (point.name, point.x, point.y, point.z) == ("p 1", 446363.45, 5160978.18, 437.678)
    ((seen,), _) = (point.observations, notes)
    assert (seen.photo, seen.x, seen.y) == ("DJI_0001.JPG", 33.1, 51.48)


def test_points_in_files_of_another_band_are_told(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_text("EPSG:32632\n500000 5100000 400 10 10 IMG_0001_4.tif a\n")
    names = ["IMG_0001_2.tif"], ["IMG_0001_1.tif", "IMG_0001_4.tif"]
    with pytest.raises(SideFileError, match=r"other bands than the map's; .* \(--band\)"):
        read_gcp_list(path, *names)
    with pytest.raises(SideFileError, match="no photo of the survey is called that"):
        read_gcp_list(path, names[0])
