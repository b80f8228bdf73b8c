"""Folders that photos are copied into, by writers of all manners."""

import errno
import os
import shutil
from pathlib import Path

import pytest

from skyquilt.errors import UsageError
from skyquilt.live import folder_watch as watching
from skyquilt.live.folder_watch import Watch
from skyquilt.live.inbox import Inbox
from skyquilt.live.ledger import Ledger
from skyquilt.live.photo_intake import Accepted, Intake, Refused
from skyquilt.live.settings import LiveSettings
from tests.live.clock import Clock


class Watched:
    """A folder, what was taken from it, and the ledger."""

    def __init__(self, home, out="out", inbox="in"):
        self.folder, self.out = home / inbox, home / out
        self.folder.mkdir(parents=True)
        self.out.mkdir(parents=True)
        self.ledger = Ledger(self.out, write=True)
        self.intake = Intake(self.ledger, Inbox(self.ledger, self.out / "photos"), LiveSettings())
        self.watch, self.clock = Watch(folder=self.folder, intake=self.intake), Clock()

    def look(self, seconds):
        """All that is taken or refused within some seconds."""
        done = []
        for _ in range(round(seconds / 0.01)):
            done += self.clock.look(self.watch, 0.01)
        return done


@pytest.fixture(params=["told", "untold"])
def watched(request, tmp_path, monkeypatch):
    """Where the system tells of complete files, and where it does not."""
    if request.param == "untold":
        monkeypatch.setattr(watching.ClosedFiles, "_watch", lambda *_: False)
    found = Watched(tmp_path)
    if request.param == "told" and not found.watch._closed.told:
        pytest.skip("this system does not tell of files that are complete")
    return found


def test_a_file_that_grows_slowly_is_taken_once_and_whole(watched, flight):
    data = flight.photos[0].read_bytes()
    path = watched.folder / "slow.jpg"
    with path.open("wb") as file:
        for k in range(6):
            file.write(data[len(data) * k // 6 : len(data) * (k + 1) // 6])
            file.flush()
            done = watched.look(0.1)  # twice as long as a file must be quiet
            assert [type(d) for d in done] == ([Accepted] if k == 5 else [])
    file = watched.ledger.row("select file from photo")[0]
    assert (watched.out / "photos" / file).read_bytes() == data
    assert watched.look(0.2) == []


def test_a_file_that_stays_torn_is_refused_and_taken_when_it_is_whole(watched, flight, monkeypatch):
    monkeypatch.setattr(watching, "PATIENCE_S", 0.4)
    data = flight.photos[0].read_bytes()
    path = watched.folder / "torn.jpg"
    path.write_bytes(data[: len(data) // 2])
    assert watched.look(0.25) == []
    done = watched.look(0.5)
    assert [type(d) for d in done] == [Refused]
    assert "truncated" in done[0].reason
    assert watched.look(0.5) == []  # said once
    path.write_bytes(data)
    assert watched.ledger.counts() == {"refused": 1}
    path.with_name("other.jpg").write_bytes(data[:9000])
    watched.look(0.8)
    path.write_bytes(data)
    assert [type(d) for d in watched.look(0.4)] == [Accepted]
    # what was refused before is no photo that the map lacks
    assert watched.ledger.rows("select name from refused") == [("other.jpg",)]


def test_a_file_must_be_quiet_where_the_system_does_not_tell(tmp_path, flight, monkeypatch):
    monkeypatch.setattr(watching.ClosedFiles, "_watch", lambda *_: False)
    found = Watched(tmp_path)
    shutil.copyfile(flight.photos[0], found.folder / "a.jpg")
    assert found.look(0.04) == []
    assert [type(d) for d in found.look(0.02)] == [Accepted]


def test_a_complete_file_is_taken_without_waiting(tmp_path, flight, monkeypatch):
    monkeypatch.setattr(watching, "QUIET_S", 60.0)
    found = Watched(tmp_path)
    if not found.watch._closed.told:
        pytest.skip("this system does not tell of files that are complete")
    shutil.copyfile(flight.photos[0], found.folder / "a.jpg")
    shutil.copyfile(flight.photos[1], tmp_path / "elsewhere.jpg")
    assert len(list(found.watch.look())) == 1
    (tmp_path / "elsewhere.jpg").rename(found.folder / "b.jpg")
    assert len(list(found.watch.look())) == 1
    (found.folder / "drone-2").mkdir()
    assert list(found.watch.look()) == []
    shutil.copyfile(flight.photos[2], found.folder / "drone-2" / "c.jpg")
    assert [d.name for d in found.watch.look()] == ["c.jpg"]
    assert found.ledger.row("select source from photo where name = 'c.jpg'") == ("drone-2",)


@pytest.mark.parametrize(
    ("way", "drone"),
    {
        ("in", "east/DCIM/100MEDIA"): "east",
        ("in", "west/DCIM/100MEDIA"): "west",
        ("in", "west/DCIM/101MEDIA"): "west",
        ("in", "DCIM/100MEDIA"): "in",
        ("in", "west/flight-2"): "west/flight-2",
        ("in", "100MEDIA"): "100MEDIA",
        ("east/DCIM", "."): "east",
        ("east/dcim", "100media"): "east",
    }.items(),
)
def test_a_source_is_a_drone_not_a_folder_of_its_card(tmp_path, flight, way, drone):
    """What is learned of a drone goes on where its camera begins another folder, and is not mixed
    with that of another one, whose card has the same folders.
    """
    inbox, below = way
    found = Watched(tmp_path, inbox=inbox)
    (found.folder / below).mkdir(parents=True, exist_ok=True)
    shutil.copyfile(flight.photos[0], found.folder / below / "a.jpg")
    assert [d.name for d in found.look(1.2)] == ["a.jpg"]
    assert found.ledger.row("select source from photo") == (drone,)


def test_files_that_came_together_are_taken_in_order_of_names(watched, flight):
    for path in reversed(flight.photos):
        shutil.copyfile(path, watched.folder / path.name)
    names = [d.name for d in watched.look(0.8)]
    assert names == sorted(p.name for p in flight.photos)


def test_pictures_that_are_not_read_are_refused_with_what_they_are(watched, flight, monkeypatch):
    """A JPEG under such a name is a photo; raw pictures lie beside photos and are left alone."""
    monkeypatch.setattr(watching, "PATIENCE_S", 0.1)
    for name in ("IMG_1.HEIC", "a.jpg"):
        (watched.folder / name).write_bytes(b"\0\0\0\x18ftypheic" + bytes(500))
    (watched.folder / "raw.DNG").write_bytes(b"II*\0" + bytes(500))
    shutil.copyfile(flight.photos[0], watched.folder / "IMG_2.heic")
    done = {d.name: d for d in watched.look(0.6)}
    assert sorted(done) == ["IMG_1.HEIC", "IMG_2.heic", "a.jpg"]
    assert isinstance(done["IMG_2.heic"], Accepted)
    assert all("a HEIC picture" in done[n].reason for n in ("IMG_1.HEIC", "a.jpg"))


def test_what_is_no_photo_by_its_name_or_not_ready_is_left_alone(watched, flight):
    for name in ("notes.txt", ".hidden.jpg", "a.jpg.part", "b.jpg.crdownload"):
        shutil.copyfile(flight.photos[0], watched.folder / name)
    (watched.folder / ".cache").mkdir()
    shutil.copyfile(flight.photos[0], watched.folder / ".cache" / "c.jpg")
    (watched.folder / "@eaDir").mkdir()
    shutil.copyfile(flight.photos[0], watched.folder / "@eaDir" / "thumbnail.jpg")
    assert watched.look(0.3) == []
    (watched.folder / "empty.jpg").touch()
    assert watched.look(0.3) == []  # it may be about to be written
    shutil.copyfile(flight.photos[0], watched.folder / "empty.jpg")
    assert [type(d) for d in watched.look(0.3)] == [Accepted]


def test_a_file_that_vanishes_is_forgotten(watched, flight):
    path = watched.folder / "gone.jpg"
    path.write_bytes(flight.photos[0].read_bytes()[:1000])
    assert watched.look(0.1) == []
    assert watched.watch.growing
    path.unlink()
    assert watched.look(0.2) == []
    assert not watched.watch.growing


def test_a_folder_made_in_place_of_a_renamed_one_is_watched(watched, flight, monkeypatch):
    """Not by scans alone: the second photo comes when none is due."""
    if not watched.watch._closed.told:
        pytest.skip("this system does not report closed files")
    monkeypatch.setattr(watching, "SCAN_TOLD_S", 60.0)
    watched.folder.rename(watched.folder.with_name("yesterday"))
    assert watched.look(0.1) == []
    watched.folder.mkdir()
    shutil.copyfile(flight.photos[0], watched.folder / "a.jpg")
    assert [d.name for d in watched.look(0.2)] == ["a.jpg"]
    shutil.copyfile(flight.photos[1], watched.folder / "b.jpg")
    assert [d.name for d in watched.look(0.2)] == ["b.jpg"]


def test_a_folder_that_cannot_be_read_is_named_once(watched, flight, monkeypatch):
    monkeypatch.setattr(watching, "SCAN_TOLD_S", 0.2)
    hidden = watched.folder / "drone 2"
    hidden.mkdir()
    shutil.copyfile(flight.photos[0], hidden / "a.jpg")
    honest, closed = os.scandir, [True]

    def scandir(path):
        if closed[0] and Path(path) == hidden:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return honest(path)

    monkeypatch.setattr(os, "scandir", scandir)
    done = watched.look(0.6)
    told = [d for d in done if isinstance(d, Refused)]
    assert [(d.name, d.reason) for d in told] == [
        ("drone 2", "this folder cannot be read (Permission denied)")
    ]
    closed[0] = False
    done += watched.look(0.6)
    assert [d.name for d in done if isinstance(d, Accepted)] == ["a.jpg"]


@pytest.mark.parametrize("told", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_maps_that_grow_below_the_folder_are_no_photos(tmp_path, flight, monkeypatch, told):
    """The survey's own files, and those of an earlier run: they were mapped, again and again."""
    if not told:
        monkeypatch.setattr(watching.ClosedFiles, "_watch", lambda *_: False)
    found = Watched(tmp_path, "in/survey")
    earlier = found.folder / "earlier"
    earlier.mkdir()
    (earlier / "run.toml").write_text("")
    shutil.copyfile(flight.photos[1], earlier / "mosaic.jpg")  # there before
    shutil.copyfile(flight.photos[0], found.folder / "a.jpg")
    done = found.look(1.3)
    shutil.copyfile(flight.photos[2], found.out / "map.jpg")  # and while it is watched
    shutil.copyfile(flight.photos[3], earlier / "dsm.jpg")
    (found.out / "photos" / "deep").mkdir(parents=True, exist_ok=True)
    shutil.copyfile(flight.photos[4], found.out / "photos" / "deep" / "b.jpg")
    done += found.look(1.3)
    assert [d.name for d in done] == ["a.jpg"]
    assert found.ledger.counts() == {"received": 1, "refused": 0}


def test_the_folder_of_photos_itself_is_no_survey(tmp_path):
    found = Watched(tmp_path)
    (tmp_path / "link").symlink_to(found.out)
    for folder in (found.out, tmp_path / "link", found.out / ".." / "out"):
        with pytest.raises(UsageError, match="is the folder of the photos"):
            Watch(folder=folder, intake=found.intake)


def test_a_file_that_is_removed_before_it_was_read_is_told(tmp_path, flight):
    found = Watched(tmp_path)
    if not found.watch._closed.told:
        pytest.skip("this system does not tell of files that are complete")
    data = flight.photos[0].read_bytes()
    path = found.folder / "drone-1" / "a.jpg"
    path.parent.mkdir()
    found.look(0.02)
    for part in (data, data[:9000]):
        path.write_bytes(part)
        path.unlink()
        done = found.look(0.1)
        assert [(type(d), d.name, d.reason) for d in done] == [(Refused, "a.jpg", watching.REMOVED)]
    path.write_bytes(data)
    assert [type(d) for d in found.look(0.1)] == [Accepted]
    path.unlink()  # read by now
    assert found.look(0.1) == [] and found.ledger.rows("select name from refused") == []
    path.write_bytes(data)
    path.rename(path.with_name("b.jpg"))  # still there
    path.with_name("b.jpg").rename(path.with_name("c.jpg"))
    assert all(isinstance(d, Accepted) for d in found.look(0.1))
    path.with_name("notes.txt").write_text("no photo", "utf-8")
    path.with_name("notes.txt").unlink()
    assert found.look(0.1) == []
