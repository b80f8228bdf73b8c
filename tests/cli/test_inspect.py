import json
import os

import pytest
from typer.testing import CliRunner

from skyquilt.cli.main import app
from skyquilt.errors import NoPhotosError
from tests.photos.conftest import dji_exif, dji_xmp, jpeg_bytes, pixels

XMP = dji_xmp(
    GimbalYawDegree="35", GimbalPitchDegree="-90", FlightYawDegree="90", RelativeAltitude="40"
)


@pytest.fixture
def folder(tmp_path):
    for i in range(2):
        (tmp_path / f"DJI_{i}.JPG").write_bytes(jpeg_bytes(pixels(seed=i), dji_exif(), XMP))
    (tmp_path / "bad.jpg").write_bytes(b"")
    return tmp_path


def test_inspect_says_it_in_words(folder):
    result = CliRunner().invoke(app, ["inspect", str(folder)])
    assert result.exit_code == 0, result.output
    for words in (
        "DJI_0.JPG",
        "55 +- 1 (sensor)",
        "40.0 (take-off)",
        "35.0 / 0.0 / 0.0",
        "2016-06-23 16:31:59",
    ):
        assert words in result.output
    assert "Camera yaw and flight yaw differ" in result.output
    assert "Left out: bad.jpg: it is empty (0 bytes)." in result.output


def test_inspect_json(folder):
    result = CliRunner().invoke(app, ["inspect", "--json", str(folder)])
    record = json.loads(result.output)
    assert [p["name"] for p in record["photos"]] == ["DJI_0.JPG", "DJI_1.JPG"]
    assert record["photos"][0]["position"]["takeoff_m"] == 40
    assert record["rejected"] == [{"name": "bad.jpg", "reason": "it is empty (0 bytes)"}]
    assert record["contradictions"]


def test_inspect_waits_for_no_pipe_and_shows_no_control_bytes(folder):
    """Nor does it take words in brackets for colours."""
    os.mkfifo(folder / "pipe.jpg")
    (folder / "\x1b[31mred.jpg").write_bytes(b"\xff\xd8\xff no photo")
    (folder / "[").mkdir()
    (folder / "[" / "y][bold].jpg").write_bytes(b"\xff\xd8\xff no photo")
    (folder / os.fsdecode(b"\xff\x9b.jpg")).write_bytes(b"")
    result = CliRunner().invoke(app, ["inspect", str(folder)])
    assert result.exit_code == 0, result.output
    assert "DJI_0.JPG" in result.output
    assert "\\x1b[31mred.jpg" in result.output and "[/y][bold].jpg" in result.output
    assert not {"\x1b", "\x9b"} & set(result.output)


def test_inspect_nothing(tmp_path):
    result = CliRunner().invoke(app, ["inspect", str(tmp_path)])
    assert isinstance(result.exception, NoPhotosError)
    assert result.exception.exit_code == 3


def test_several_paths_are_one_survey(folder):
    """As a shell makes them of `photos/*`: the side file among them counts."""
    (folder / "card").mkdir()
    (folder / "card" / "DJI_7.JPG").write_bytes(jpeg_bytes(pixels(seed=7), dji_exif(), XMP))
    (folder / "geo.txt").write_text("EPSG:4326\nDJI_0 -92.001 46.501 300\n")
    paths = [folder / n for n in ("DJI_0.JPG", "DJI_1.JPG", "card", "geo.txt")]
    result = CliRunner().invoke(app, ["inspect", *map(str, paths), "--json"])
    assert result.exit_code == 0, result.output
    photos = {p["name"]: p for p in json.loads(result.output)["photos"]}
    assert sorted(photos) == ["DJI_0.JPG", "DJI_1.JPG", "DJI_7.JPG"]
    assert photos["DJI_0.JPG"]["position"]["latitude_deg"] == 46.501
