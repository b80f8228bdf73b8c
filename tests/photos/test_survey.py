import errno
import os
import shutil
from datetime import datetime
from pathlib import Path

import numpy as np
import piexif
import pytest
from PIL import Image

from skyquilt.errors import NoPhotosError, SideFileError, UsageError
from skyquilt.model.photo import RejectedPhoto
from skyquilt.photos.contradictions import contradictions
from skyquilt.photos.read import read_photo
from skyquilt.photos.survey import read_survey

from .conftest import dji_exif, dji_xmp, gps_exif, pixels


def flight(make_jpeg, n=5):
    """n photos ten metres apart towards the north, five seconds between them; names run
    backwards.
    """
    for i in range(n):
        exif = dji_exif(Exif={piexif.ExifIFD.DateTimeOriginal: f"2020:06:01 10:00:{5 * i:02d}"})
        exif["GPS"] = gps_exif(46.5 + i * 0.0001, -92.0, 150)
        path = make_jpeg(f"p{n - i}.JPG", exif=exif, seed=i)
    return path.parent


def test_order_is_that_of_capture_and_names_are_relative(make_jpeg):
    folder = flight(make_jpeg)
    make_jpeg("sub/deep.jpeg", exif=dji_exif(), seed=50)
    survey = read_survey(folder)
    assert [p.name for p in survey.photos] == [
        "sub/deep.jpeg",
        "p5.JPG",
        "p4.JPG",
        "p3.JPG",
        "p2.JPG",
        "p1.JPG",
    ]


def test_photos_without_a_time_come_last_by_name(make_jpeg):
    folder = flight(make_jpeg, 2)
    make_jpeg("a.jpg", seed=9)
    survey = read_survey(folder)
    assert [p.name for p in survey.photos] == ["p2.JPG", "p1.JPG", "a.jpg"]
    assert any("Without a capture time" in n and "a.jpg" in n for n in survey.notes)


def test_pictures_of_formats_that_are_not_read_are_told(make_jpeg):
    folder = flight(make_jpeg, 3)
    for name in ("b.avif", "sub/c.HEIC", "p1.dng", "notes.txt", "Thumbs.db"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"x")
    (told,) = (n for n in read_survey(folder).notes if "format" in n)
    assert told.startswith("2 pictures are not in the map") and "(b.avif, sub/c.HEIC)" in told
    (folder / "b.avif").unlink()
    (folder / "sub/c.HEIC").unlink()  # a raw picture beside its JPEG is no loss
    assert not any("format" in n for n in read_survey(folder).notes)


def test_a_bad_file_never_stops_a_survey(make_jpeg):
    folder = flight(make_jpeg, 3)
    (folder / "cut.jpg").write_bytes((folder / "p1.JPG").read_bytes()[:1500])
    (folder / "empty.jpg").write_bytes(b"")
    (folder / "lies.jpg").write_text("these are words")
    (folder / "film.MP4").write_bytes(b"\0\0\0 ftypisom")
    (folder / "notes.txt").write_text("hello")
    Image.fromarray(pixels(seed=7)).save(folder / "also.png")
    Image.fromarray(pixels(seed=8)).save(folder / "also.tif")
    shutil.copy(folder / "p1.JPG", folder / "zz-copy.jpg")
    survey = read_survey(folder)
    assert {p.name for p in survey.photos} == {"p1.JPG", "p2.JPG", "p3.JPG", "also.png", "also.tif"}
    reasons = {r.name: r.reason for r in survey.rejected}
    assert "truncated" in reasons["cut.jpg"]
    assert "0 bytes" in reasons["empty.jpg"]
    assert "neither JPEG" in reasons["lies.jpg"]
    assert reasons["zz-copy.jpg"] == "same file content as p1.JPG"
    assert survey.ignored == ("film.MP4", "notes.txt")


def test_png_under_a_jpeg_name_is_read_by_its_content(make_jpeg, tmp_path):
    Image.fromarray(pixels()).save(tmp_path / "a.png")
    (tmp_path / "a.png").rename(tmp_path / "a.jpg")
    assert len(read_survey(tmp_path).photos) == 1


def test_nothing_to_read(tmp_path):
    with pytest.raises(UsageError, match="does not exist"):
        read_survey(tmp_path / "nowhere")
    with pytest.raises(NoPhotosError, match="contains nothing"):
        read_survey(tmp_path)
    (tmp_path / "readme.txt").write_text("x")
    with pytest.raises(NoPhotosError, match=r"readme\.txt"):
        read_survey(tmp_path)
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(NoPhotosError, match=r"None of the 1 .* truncated"):
        read_survey(tmp_path)


def test_one_photo_and_lists_of_files(make_jpeg):
    folder = flight(make_jpeg, 3)
    assert len(read_survey(folder / "p1.JPG").photos) == 1
    assert [p.name for p in read_survey([folder / "p1.JPG", folder / "p2.JPG"]).photos] == [
        "p2.JPG",
        "p1.JPG",
    ]
    make_jpeg("sub/p1.JPG", seed=77)
    both = read_survey([folder / "p1.JPG", folder / "sub" / "p1.JPG"])
    assert {p.name for p in both.photos} == {"p1.JPG", "sub/p1.JPG"}


def test_hidden_files_and_earlier_runs_are_passed_over(make_jpeg):
    folder = flight(make_jpeg, 2)
    make_jpeg(".thumbs/p9.jpg", seed=30)
    make_jpeg(".p8.jpg", seed=31)
    for k, system in enumerate(("@eaDir/p0.JPG", "__MACOSX", "#recycle", "$RECYCLE.BIN")):
        make_jpeg(f"{system}/SYNOPHOTO_THUMB_XL.jpg", seed=40 + k)
    make_jpeg("out/mosaic.jpg", seed=32)
    (folder / "out" / "run.toml").write_text("")
    make_jpeg("live/map.jpg", seed=33)
    (folder / "live" / "live.db").write_text("")
    survey = read_survey(folder)
    assert len(survey.photos) == 2 and not survey.rejected
    for name in ("out", "live"):
        assert any(f"The folder {name} contains an earlier run" in n for n in survey.notes)


def test_a_photo_300_km_away_loses_its_position_but_stays(make_jpeg):
    folder = flight(make_jpeg, 6)
    exif = dji_exif()
    exif["GPS"] = gps_exif(49.2, -92.0)
    make_jpeg("far.jpg", exif=exif, seed=40)
    survey = read_survey(folder)
    far = next(p for p in survey.photos if p.name == "far.jpg")
    assert far.position is None
    assert "49.200000" in far.notes[-1] and "301 km" in far.notes[-1]
    assert sum(p.position is not None for p in survey.photos) == 6


@pytest.mark.parametrize(
    ("degrees", "why", "metres"),
    [((5_160_000, 445_000), "5.16e+06", True), ((0, 0), "without a satellite fix", False)],
)
def test_a_survey_says_why_stated_positions_are_none(make_jpeg, degrees, why, metres):
    folder = flight(make_jpeg, 3)
    for i in range(2):
        exif = dji_exif()
        for key, value in zip(("GPSLatitude", "GPSLongitude"), degrees, strict=True):
            exif["GPS"][getattr(piexif.GPSIFD, key)] = ((value, 1), (0, 1), (0, 1))
        make_jpeg(f"none{i}.jpg", exif=exif, seed=50 + i)
    survey = read_survey(folder)
    assert sum(p.position is None for p in survey.photos) == 2
    (told,) = [n for n in survey.notes if "state a position that cannot be used" in n]
    assert told.startswith("2 of 5 photos") and why in told
    assert ("geo.txt" in told) == metres


def test_two_cameras_and_mixed_clocks_are_named(make_jpeg):
    folder = flight(make_jpeg, 3)
    make_jpeg(
        "other.jpg",
        exif={"0th": {piexif.ImageIFD.Make: "X", piexif.ImageIFD.Model: "Y"}},
        image=pixels(80, 60),
    )
    notes = " ".join(read_survey(folder).notes)
    assert "There are 2 cameras" in notes
    assert "Rolling (electronic) shutter: dji fc300s" in notes
    assert "focal length is guessed for x y 80x60" in notes


def test_geo_txt_in_the_folder_counts_and_an_explicit_one_wins(make_jpeg, tmp_path_factory):
    folder = flight(make_jpeg, 2)
    (folder / "geo.txt").write_text(
        "EPSG:4326\np1.JPG 9.5 46.25 300\np2.JPG 9.6 46.25 301\nstranger.JPG 1 2 3\n"
    )
    survey = read_survey(folder)
    assert {p.position.source for p in survey.photos} == {"geo.txt"}
    assert survey.ignored == ()
    assert any("stranger.JPG" in n for n in survey.notes)
    other = tmp_path_factory.mktemp("side") / "mine.txt"
    other.write_text("EPSG:4326\np1.JPG 10.5 46.25\n")
    survey = read_survey(folder, geo=other)
    assert {round(p.position.longitude_deg, 6) for p in survey.photos} == {10.5, -92.0}


def test_side_file_that_knows_no_photo_is_an_error(make_jpeg):
    folder = flight(make_jpeg, 2)
    (folder / "geo.txt").write_text("EPSG:4326\nq1.JPG 9.5 46.25 300\n")
    with pytest.raises(SideFileError, match=r"q1\.JPG.*p"):
        read_survey(folder)


def test_contradictions_state_both_values(make_jpeg):
    for i in range(5):
        exif = dji_exif(Exif={piexif.ExifIFD.DateTimeOriginal: f"2020:06:01 10:00:{5 * i:02d}"})
        exif["GPS"] = gps_exif(46.5 + i * 0.0001, -92.0, 150 + 20 * i)
        xmp = dji_xmp(
            GimbalYawDegree="35",
            GimbalPitchDegree="-90",
            FlightYawDegree="90",
            RelativeAltitude="40",
        )
        folder = make_jpeg(f"p{i}.jpg", exif=exif, xmp=xmp, seed=i).parent
    said = " ".join(contradictions(read_survey(folder).photos))
    assert "differ by more than 30 deg in 5 photos (camera 35 to 35, aircraft 90 to 90 deg)" in said
    assert "ranges from 110 to 190 m" in said
    assert "direction of flight (from GPS) and the heading differ" in said


def test_digest_is_of_the_content(make_jpeg, tmp_path):
    first = read_survey(make_jpeg("a.jpg", seed=1)).photos[0]
    again = read_survey(make_jpeg("b.jpg", seed=1)).photos[0]
    other = read_survey(make_jpeg("c.jpg", seed=2)).photos[0]
    assert first.digest == again.digest != other.digest


def test_a_large_jpeg_changed_at_its_end_has_another_digest(make_jpeg):
    noise = np.random.default_rng(0).integers(0, 255, (1200, 1200, 3), np.uint8)
    path = make_jpeg(image=noise)
    before = read_survey(path).photos[0].digest
    assert path.stat().st_size > 1 << 20
    noise[-1] = 0
    make_jpeg(image=noise)
    assert read_survey(path).photos[0].digest != before


def test_times_of_different_offsets_sort_by_the_wall_clock(make_jpeg):
    exif = dji_exif(Exif={piexif.ExifIFD.OffsetTimeOriginal: "+02:00"})
    make_jpeg("b.jpg", exif=exif, seed=1)
    folder = make_jpeg("a.jpg", exif=dji_exif(), seed=2).parent
    survey = read_survey(folder)
    assert [p.name for p in survey.photos] == ["a.jpg", "b.jpg"]
    assert survey.photos[0].time == datetime(2016, 6, 23, 16, 31, 59)


def test_of_two_photos_far_apart_both_stay_and_the_note_says_so(make_jpeg):
    for i, latitude in enumerate((46.0, 49.0)):
        exif = dji_exif()
        exif["GPS"] = gps_exif(latitude, 9.0)
        folder = make_jpeg(f"{i}.jpg", exif=exif, seed=i).parent
    survey = read_survey(folder)
    assert all(p.position for p in survey.photos)
    assert any("334 km apart" in n for n in survey.notes)


def test_two_positions_far_apart_among_photos_without_any_are_not_used(make_jpeg):
    for i, latitude in enumerate((46.0, 49.0, None)):
        exif = dji_exif()
        exif["GPS"] = {} if latitude is None else gps_exif(latitude, 9.0)
        folder = make_jpeg(f"{i}.jpg", exif=exif, seed=i).parent
    survey = read_survey(folder)
    assert not any(p.position for p in survey.photos)
    told = [n for n in survey.notes if "334 km apart" in n]
    assert len(told) == 1 and told[0].endswith("neither is used.")


def test_a_flight_at_height_zero_counts_from_sea_level_instead(make_jpeg):
    for i in range(3):
        folder = make_jpeg(
            f"{i}.jpg", exif=dji_exif(), xmp=dji_xmp(RelativeAltitude="+0.00"), seed=i
        ).parent
    survey = read_survey(folder)
    assert {
        (p.position.altitude_m, p.position.datum, p.position.takeoff_m) for p in survey.photos
    } == {(198.3, "sea_level", None)}
    assert any("were not used" in n for n in survey.notes)
    for i in range(3, 6):  # another drone, which tells its own
        about = dji_exif()
        about["0th"][piexif.ImageIFD.Model] = "another"
        make_jpeg(f"{i}.jpg", exif=about, xmp=dji_xmp(RelativeAltitude="+40.00"), seed=i)
    survey = read_survey(folder)
    assert [p.above_takeoff_m for p in survey.photos] == [None] * 3 + [40.0] * 3
    assert sum("take-off of " in n and "another" not in n for n in survey.notes) == 1


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "a HEIC picture"),
        (b"\0\0\0\x1cftypavif", "an AVIF picture"),
        (b"RIFF\x10\0\0\0WEBPVP8 ", "truncated"),
        (b"RIFF\x10\0\0\0AVI LIST", "a film or sound"),
        (b"<html><body>403 forbidden", "a web page"),
        (b"version https://git-lfs.github.com/spec/v1", "Git LFS"),
        (bytes(5000), "interrupted copy"),
        (b"something else", "neither JPEG, TIFF, PNG nor WebP"),
    ],
)
def test_other_content_under_the_name_of_a_photo_is_named(tmp_path, content, what):
    path = tmp_path / "DJI_0001.JPG"
    path.write_bytes(content)
    found = read_photo(path)
    assert isinstance(found, RejectedPhoto) and what in found.reason


@pytest.fixture
def closed(monkeypatch):
    """Folders that the system does not let be read, whoever runs the tests."""
    folders = set()
    honest = os.scandir

    def scandir(path):
        if Path(path) in folders:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return honest(path)

    monkeypatch.setattr(os, "scandir", scandir)
    return folders


def test_folders_that_cannot_be_read_are_named(make_jpeg, closed):
    folder = flight(make_jpeg)
    hidden = make_jpeg("second card/a.jpg", exif=dji_exif(), seed=50).parent
    assert len(read_survey(folder).photos) == 6
    closed.add(hidden)
    for source, name in ((folder, "second card"), ([folder / "p1.JPG", hidden], str(hidden))):
        survey = read_survey(source)
        assert len(survey.photos) in (5, 1)
        told = [n for n in survey.notes if "cannot be read" in n]
        assert len(told) == 1
        assert told[0].startswith(
            f"1 folder cannot be read, and photos in there are not in the map: {name[:20]}"
        )
    with pytest.raises(NoPhotosError, match="can be found: 1 folder cannot be read"):
        read_survey([hidden])


def test_photos_without_their_ending_are_told(make_jpeg):
    """Recovered and downloaded files; originals and previews beside a photo are none."""
    folder = flight(make_jpeg, 3)
    for name in ("12345", "sub/p9.JPG.download"):
        make_jpeg(name, exif=dji_exif(), seed=40)
    for name in ("p1.JPG_original", "p1.THM", "of_a_video.THM", "a.insp"):
        make_jpeg(name, seed=41)
    (folder / "text").write_text("no photo")
    (told,) = [n for n in read_survey(folder).notes if "by content" in n]
    assert told.startswith("2 files are photos by content and not by name (12345, sub/p9.JPG")


def test_links_to_folders_are_told(make_jpeg, tmp_path_factory):
    """Those to a folder around them lead to nothing new."""
    folder, elsewhere = flight(make_jpeg, 2), tmp_path_factory.mktemp("card")
    (folder / "sub").mkdir()
    (folder / "sub" / "up").symlink_to(folder)
    assert not any("link" in n for n in read_survey(folder).notes)
    (folder / "card").symlink_to(elsewhere)
    (told,) = [n for n in read_survey(folder).notes if "link" in n]
    assert told.startswith("1 link to a folder is not followed (card)")


@pytest.mark.parametrize(
    ("name", "content", "advice"),
    [
        ("IMG_1.HEIC", bytes(20), "Save them as JPEG"),
        ("DJI_1.DNG", bytes(20), "Save them as JPEG"),
        ("photos.zip", b"PK", "Unpack photos.zip first"),
        ("DJI_0001", b"\xff\xd8\xff\xe0", "end in .jpg"),
    ],
)
def test_what_to_do_where_nothing_can_be_read(tmp_path, name, content, advice):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(NoPhotosError, match=advice):
        read_survey(tmp_path)
    if name.endswith(".zip"):
        with pytest.raises(NoPhotosError, match=advice):
            read_survey(tmp_path / name)


def test_a_jpeg_that_is_called_heic_is_read(make_jpeg):
    folder = make_jpeg("IMG_1.HEIC", exif=dji_exif()).parent
    (folder / "IMG_2.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(40))
    survey = read_survey(folder)
    assert [p.name for p in survey.photos] == ["IMG_1.HEIC"]
    assert any("1 picture is not in the map" in n and "IMG_2.HEIC" in n for n in survey.notes)


def test_versions_of_photos_are_told(make_jpeg):
    """Cards on which names begin anew have other times."""
    folder = make_jpeg("a/DJI_0001.JPG", exif=dji_exif()).parent.parent
    later = dji_exif(Exif={piexif.ExifIFD.DateTimeOriginal: "2016:06:23 17:31:59"})
    make_jpeg("b/DJI_0001.JPG", exif=later, seed=1)
    assert not any("versions" in n for n in read_survey(folder).notes)
    make_jpeg("edited/dji_0001.jpeg", exif=dji_exif(), seed=2)
    (told,) = [n for n in read_survey(folder).notes if "versions" in n]
    assert told.startswith("1 photo has the name") and "dji_0001.jpeg of a/DJI_0001.JPG" in told
