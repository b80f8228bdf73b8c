"""Kills, torn journals, threads and full disks."""

import errno
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from skyquilt.errors import OutputError
from skyquilt.raster import CogWriter, write_array

from .raster_cases import assert_valid_cog, disc, picture, read, spec_for

ARRAY, VALID = picture(1400, 1900), disc(1400, 1900)
SPEC = spec_for(ARRAY, compress="jpeg", mask=True, tile=64)
FLOATS = np.where(VALID, ARRAY[..., 0], np.nan).astype(np.float32)


def cut(block):
    return np.s_[block.row0 : block.row0 + block.height, block.col0 : block.col0 + block.width]


def write_some(writer, count):
    blocks = [block for block, _ in zip(writer.blocks(), range(count), strict=False)]
    for block in blocks:
        writer.write_block(block, ARRAY[cut(block)], VALID[cut(block)])
    return blocks


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "a.tif"
    write_array(path, ARRAY, SPEC, VALID)
    return path.read_bytes()


@pytest.mark.parametrize("first", [0, 1, 9, 20])
def test_interrupted_runs_end_in_the_same_file(tmp_path, whole, first):
    path = tmp_path / "a.tif"
    with pytest.raises(KeyboardInterrupt), CogWriter(path, SPEC, digest="x") as writer:
        total = len(list(writer.blocks()))
        write_some(writer, first)
        raise KeyboardInterrupt
    assert not path.exists()
    with CogWriter(path, SPEC, digest="x") as writer:
        assert len(list(writer.blocks())) == total - first
        write_some(writer, total)
    assert path.read_bytes() == whole
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"]


@pytest.mark.parametrize("lost", [1, 30, 700])
def test_torn_journal(tmp_path, whole, lost):
    path, journal = tmp_path / "a.tif", tmp_path / "a.tif.spool" / "journal.bin"
    with pytest.raises(KeyboardInterrupt), CogWriter(path, SPEC, digest="x") as writer:
        total = len(list(writer.blocks()))
        write_some(writer, 8)
        raise KeyboardInterrupt
    os.truncate(journal, journal.stat().st_size - lost)
    with CogWriter(path, SPEC, digest="x") as writer:
        left = len(list(writer.blocks()))
        assert total - 8 < left <= total - 5
        write_some(writer, left)
    assert path.read_bytes() == whole


def test_lost_tiles_are_written_again(tmp_path, whole):
    """After a power cut the journal may have reached the disk and the tiles not."""
    path, heap = tmp_path / "a.tif", tmp_path / "a.tif.spool" / "tiles.bin"
    with pytest.raises(KeyboardInterrupt), CogWriter(path, SPEC, digest="x", fsync=True) as writer:
        total = len(list(writer.blocks()))
        write_some(writer, 8)
        raise KeyboardInterrupt
    os.truncate(heap, heap.stat().st_size // 2)
    with CogWriter(path, SPEC, digest="x") as writer:
        assert total - 8 < len(list(writer.blocks())) < total
        write_some(writer, total)
    assert path.read_bytes() == whole


@pytest.mark.parametrize("change", [{"digest": "y"}, {"digest": ""}])
def test_a_spool_of_other_pixels_is_dropped(tmp_path, change):
    with (
        pytest.raises(KeyboardInterrupt),
        CogWriter(tmp_path / "a.tif", SPEC, digest="x") as writer,
    ):
        write_some(writer, 5)
        raise KeyboardInterrupt
    writer = CogWriter(tmp_path / "a.tif", SPEC, **change)
    assert len(list(writer.blocks())) == 6 * 8
    writer.abort()


KILLED = """
import sys, os
sys.path[:0] = sys.argv[2:]
from pathlib import Path
from tests.raster.test_resume import *
with CogWriter(Path(sys.argv[1]), SPEC, digest="x") as writer:
    write_some(writer, 11)
    block = next(writer.blocks())
    writer.write_tile(block.row0 // 64, block.col0 // 64, ARRAY[cut(block)][:64, :64])
    os.kill(os.getpid(), 9)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_killed_process(tmp_path, whole):
    path = tmp_path / "a.tif"
    command = [sys.executable, "-c", KILLED, str(path), *sys.path]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    with CogWriter(path, SPEC, digest="x") as writer:
        assert len(list(writer.blocks())) == 6 * 8 - 11
        write_some(writer, 6 * 8)
    assert path.read_bytes() == whole


def test_radiometric_resume_keeps_nan(tmp_path):
    spec, path = spec_for(FLOATS, nodata=np.nan, tile=64), tmp_path / "a.tif"
    write_array(tmp_path / "whole.tif", FLOATS, spec)
    for stop in (7, 100):
        try:
            with CogWriter(path, spec, digest="x") as writer:
                for number, block in enumerate(writer.blocks()):
                    if number == stop:
                        raise KeyboardInterrupt
                    writer.write_block(block, FLOATS[cut(block)])
        except KeyboardInterrupt:
            continue
    assert path.read_bytes() == (tmp_path / "whole.tif").read_bytes()


@pytest.mark.slow
def test_threads(tmp_path):
    path = tmp_path / "a.tif"
    with CogWriter(path, SPEC, digest="x") as writer, ThreadPoolExecutor(8) as pool:
        done = pool.map(
            lambda b: writer.write_block(b, ARRAY[cut(b)], VALID[cut(b)]), writer.blocks()
        )
        assert len(list(done)) == 6 * 8
    write_array(tmp_path / "b.tif", ARRAY, SPEC, VALID)
    for level in (None, 0, 1, 2, 3, 4):
        for ours, theirs in zip(read(path, level), read(tmp_path / "b.tif", level), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    assert_valid_cog(path)


def test_unwritten_tiles_of_a_finished_block_are_empty(tmp_path):
    with CogWriter(tmp_path / "a.tif", SPEC) as writer:
        for block in writer.blocks():
            if block.row0 == 0:
                writer.write_tile(0, block.col0 // 64, ARRAY[:64, block.col0 : block.col0 + 64])
            writer.finish_block(block)
    mask = read(tmp_path / "a.tif")[1]
    assert mask[:64, :64].all()
    assert not mask[64:].any()


class FullDisk:
    def __init__(self, file, room):
        self.file, self.room = file, room

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        self.room -= len(data)
        if self.room < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.file.write(data)


def test_disk_fills_while_spooling(tmp_path):
    full = pytest.raises(OutputError, match=r"disk is full.*needs .* MB free")
    with full, CogWriter(tmp_path / "a.tif", SPEC) as writer:
        writer._spool._heap = FullDisk(writer._spool._heap, 20_000)
        write_some(writer, 100)
    assert list(tmp_path.iterdir()) == []


def test_disk_fills_while_assembling(tmp_path, monkeypatch, whole):
    monkeypatch.setattr("skyquilt.raster.assemble._framed", refuse)
    (tmp_path / "a.tif").write_bytes(b"the last good one")
    with pytest.raises(
        OutputError, match=rf"a\.tif needs about {len(whole) / 1e6:.1f} MB in .* MB free"
    ):
        write_array(tmp_path / "a.tif", ARRAY, SPEC, VALID)
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"]
    assert (tmp_path / "a.tif").read_bytes() == b"the last good one"


def test_room_made_after_a_full_disk_costs_no_pixels(tmp_path, monkeypatch, whole):
    with monkeypatch.context() as patch:
        patch.setattr("skyquilt.raster.assemble._framed", refuse)
        with pytest.raises(OutputError), CogWriter(tmp_path / "a.tif", SPEC, digest="x") as writer:
            write_some(writer, 100)
    with CogWriter(tmp_path / "a.tif", SPEC, digest="x") as writer:
        assert list(writer.blocks()) == []
    assert (tmp_path / "a.tif").read_bytes() == whole


def test_few_overview_tiles_are_open_at_a_time(tmp_path):
    with CogWriter(tmp_path / "a.tif", SPEC) as writer:
        for block in writer.blocks():
            writer.write_block(block, ARRAY[cut(block)], VALID[cut(block)])
            assert len(writer._pyramid._open) < len(SPEC.levels)


def refuse(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_too_little_room_is_known_before_the_first_byte(tmp_path, monkeypatch):
    monkeypatch.setattr("skyquilt.raster.atomic.free_bytes", lambda folder: 1000)
    with pytest.raises(OutputError, match=r"needs about .* 0\.0 MB free"):
        write_array(tmp_path / "a.tif", ARRAY, SPEC, VALID)
    assert list(tmp_path.iterdir()) == []


def test_output_folder_is_a_file(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_array(tmp_path / "out" / "a.tif", ARRAY, SPEC, VALID)
