"""What a finished map leaves for photos that are added to it."""

import os

from skyquilt.ortho.former_files import FILES
from skyquilt.workflows.finished import stamps_of


def test_rasters_are_known_by_what_is_in_them(tmp_path):
    """Not by size and time alone, which a disk that lost a part of a file leaves as they were; and
    copies of a folder, whose times are new, are what they are copied from.
    """
    for name in FILES:
        (tmp_path / name).write_bytes(bytes(range(256)) * 100)
    before, path = stamps_of(tmp_path), tmp_path / FILES[0]
    time = path.stat().st_mtime_ns
    os.utime(path, ns=(time + 10**9, time + 10**9))
    assert stamps_of(tmp_path) == before
    path.write_bytes(bytes(25_600))
    os.utime(path, ns=(time, time))
    assert stamps_of(tmp_path) != before
    path.unlink()
    assert stamps_of(tmp_path) != before
