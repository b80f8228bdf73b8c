import io
import math
import os
import socket
import time
import zipfile
from pathlib import Path

import pytest

from skyquilt.errors import UnreadablePhotoError
from skyquilt.outside import (
    check_picture,
    open_regular,
    plain,
    read_bounded,
    real,
    shown,
    text_of,
    unzipped,
    walk,
    whole,
)


@pytest.mark.parametrize(
    ("text", "value"),
    [("+39.80", 39.8), ("-1", -1), (".5", 0.5), ("4.", 4), ("1e-3", 0.001), (" 7 ", 7), (3, 3)],
)
def test_a_number_as_people_write_it(text, value):
    assert real(text) == value


@pytest.mark.parametrize(
    "text",
    ["", "nan", "inf", "1e999", "²", "١٢", "1_0", "0x10", "9" * 400, "1 2", None, True, math.nan]
    + [math.inf, 10**400, b"1", [1], "--1", "1e", "1,5"],
)
def test_what_is_no_number(text):
    assert real(text) is None
    assert whole(text) is None


def test_limits_of_numbers():
    assert real("5", 6, 7) is None and real("6", 6, 7) == 6
    assert whole("000000012000", 1, 4096) is None and whole("00012", 1, 4096) == 12
    assert whole("9" * 31) is None and whole(2**63) is None and whole(1.0) is None


def test_text_cannot_steer_a_terminal():
    name = "a\x1b[2J\x9b31m\u202eb\udc80\nc\td"
    assert shown(name) == "a\\x1b[2J\\x9b31m\\u202eb\\udc80\nc\\td"
    assert "\n" not in plain(name) and plain(name).encode()
    assert shown("Straße 測 é") == "Straße 測 é"
    assert len(shown("x" * 10_000)) < 5000


def test_text_is_read_as_editors_save_it():
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        assert text_of("Höhe, é\n".encode(encoding)) == "Höhe, é\n"
    assert text_of(b"\xfe\xff" + "Höhe".encode("utf-16-be")) == "Höhe"
    assert text_of(b"H\xf6he") == "Höhe"
    assert text_of(b"\xff\xfeH\0o") == "H\ufffd"  # torn
    assert text_of(b"") == ""


@pytest.mark.parametrize("kind", ["fifo", "socket", "folder", "device"])
def test_only_regular_files_are_opened_and_nothing_is_waited_for(tmp_path, kind, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.jpg"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as one:
            one.bind("a.jpg")
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(os.devnull)
    began = time.monotonic()
    with pytest.raises(OSError):
        open_regular(path)
    assert time.monotonic() - began < 1


def test_a_file_is_read_up_to_a_limit(tmp_path):
    (tmp_path / "a").write_bytes(b"x" * 100)
    assert len(read_bounded(tmp_path / "a", 100)) == 100
    with pytest.raises(OSError):
        read_bounded(tmp_path / "a", 99)


def test_walking_follows_no_links_and_takes_any_depth(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path)
    here = Path.cwd()
    os.chdir(tmp_path)
    try:
        for _ in range(1500):
            Path("d").mkdir()
            os.chdir("d")
    finally:
        os.chdir(here)
    found = list(walk(tmp_path))
    assert 500 < len(found) <= 1501 and found[0][1:] == (["d"], ["loop"])
    # rmtree of so deep a tree would recurse
    os.system(f"rm -rf '{tmp_path}/d'")


@pytest.mark.parametrize(
    ("size", "word"),
    [
        ((31, 400), "at least 32"),
        ((20_000, 32), "times the other"),
        ((20_000, 19_999), "megapixels are the most"),
        ((12_000, 12_000), "would need"),
    ],
)
def test_sizes_that_are_refused(size, word):
    with pytest.raises(UnreadablePhotoError, match=word):
        check_picture(*size, 7)


def test_sizes_that_are_taken():
    check_picture(14_204, 10_652, 3)  # the largest camera that drones carry
    check_picture(8192, 4096, 3)
    check_picture(640, 512, 2, file_bytes=3_000_000)
    with pytest.raises(UnreadablePhotoError, match="far larger"):
        check_picture(640, 512, 2, file_bytes=10**9)
    with pytest.raises(UnreadablePhotoError, match="--max-mp"):
        check_picture(1000, 1001, 3, most_mp=1)


def packed(body: bytes, method: int, change=lambda raw: raw) -> zipfile.ZipFile:
    """An archive with one file `a.kml`, its bytes changed."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        archive.writestr("a.kml", body)
    return zipfile.ZipFile(io.BytesIO(change(buffer.getvalue())))


METHODS = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]


@pytest.mark.parametrize("method", METHODS)
def test_a_file_in_an_archive_is_read_up_to_a_bound(method):
    assert unzipped(packed(b"x" * 1000, method), "a.kml", 1000) == b"x" * 1000
    with pytest.raises(ValueError, match="unpacks to more than 0.000999 MB"):
        unzipped(packed(b"x" * 1000, method), "a.kml", 999)


@pytest.mark.parametrize("method", METHODS)
def test_whatever_is_wrong_with_it_is_one_error(method):
    """Bytes of the content and of its headers set to others, one at a time; a flag for encryption,
    a method that nobody has, an archive cut off.
    """
    whole = packed(bytes(range(256)) * 20, method).fp.getvalue()
    wrong = 0
    for k in range(min(len(whole), 400)):
        for value in (0, 1, 99, 255):
            torn = whole[:k] + bytes([value]) + whole[k + 1 :]
            try:
                archive = zipfile.ZipFile(io.BytesIO(torn))
            except (zipfile.BadZipFile, ValueError, NotImplementedError):
                continue
            try:
                for name in archive.namelist():
                    unzipped(archive, name, 10**6)
            except ValueError as error:
                wrong += "damaged or encrypted" in str(error)
    assert wrong > 50
