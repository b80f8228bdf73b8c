"""One photo that fails, whatever the error, is left out; the rest goes on, after a restart too."""

import errno
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import rasterio

from skyquilt.engine.lock import FolderLock
from skyquilt.errors import NoPhotosError, OutputError
from skyquilt.live import final_map, folder_watch, workflow
from skyquilt.live.folder_watch import REMOVED, Watch
from skyquilt.live.inbox import Inbox
from skyquilt.live.ledger import Ledger
from skyquilt.live.live_map import LiveMap
from skyquilt.live.photo_intake import Intake, Refused
from skyquilt.live.settings import LiveSettings
from skyquilt.live.workflow import iter_live
from skyquilt.model.event import Note
from skyquilt.server.access import Guard
from skyquilt.server.uploads import Uploads
from tests.attacks import SHARED, jpeg, needs_attacks
from tests.live.clock import Clock

QUICK = LiveSettings(features=600)


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    """Whoever waits for a file that is not whole waits for half a second, not for four."""
    monkeypatch.setattr(folder_watch, "PATIENCE_S", 0.5)


def taken(out, inbox, photos, seconds=300):
    """Runs live on a folder until so many photos are placed or refused and nothing is left to draw;
    the map stays open.
    """
    live = LiveMap(out, QUICK)
    stop = threading.Event()
    timer = threading.Timer(seconds, stop.set)
    timer.start()
    for _ in iter_live([inbox], live, stop=stop):
        done, redraw = live.ledger.counts(), live.redraw
        left = redraw.urgent or redraw.pending or redraw.dirty or redraw.later
        settled = sum(done.get(k, 0) for k in ("placed", "refined", "waiting", "refused"))
        if settled >= photos and not left:
            stop.set()
    timer.cancel()
    return live


def refused(live):
    rows = live.ledger.rows("select name, reason from refused")
    more = live.ledger.rows("select name, reason from photo where state = 'refused'")
    return dict([*rows, *more])


@needs_attacks
def test_a_thin_photo_is_refused_and_the_others_are_mapped(flight, tmp_path):
    inbox = tmp_path / "in"
    inbox.mkdir()
    shutil.copyfile(SHARED / "thin-20000x32.jpg", inbox / "a.jpg")
    shutil.copyfile(flight.photos[0], inbox / "b.jpg")
    live = taken(tmp_path / "out", inbox, 2)
    assert "20000x32" in refused(live)["a.jpg"]
    state = live.ledger.row("select state from photo where name = 'b.jpg'")
    assert state is not None and state[0] in ("placed", "refined", "waiting")
    live.close()


def test_a_map_in_the_inbox_is_refused_and_the_others_are_mapped(flight, tmp_path):
    inbox = tmp_path / "in"
    inbox.mkdir()
    about = {"width": 400, "height": 300, "count": 3, "dtype": "uint8", "crs": "EPSG:32633"}
    place = rasterio.Affine(0.1, 0, 446_000, 0, -0.1, 5_160_000)
    with rasterio.open(inbox / "a.tif", "w", driver="GTiff", transform=place, **about) as to:
        to.write(np.random.default_rng(0).integers(0, 255, (3, 300, 400), np.uint8))
    shutil.copyfile(flight.photos[0], inbox / "b.jpg")
    live = taken(tmp_path / "out", inbox, 2)
    assert "it is a map" in refused(live)["a.tif"]
    live.close()


@pytest.mark.slow
@pytest.mark.parametrize("step", ["features", "place", "draw", "refine"])
def test_whatever_fails_on_one_photo_the_others_are_mapped(flight, tmp_path, monkeypatch, step):
    """The second photo makes a step fail with an error that nobody foresaw."""
    from skyquilt.live import initial_pose, links, reduced_pictures, refinement

    live = LiveMap(tmp_path / "out", QUICK)
    bad = flight.photos[1].name

    def failing(honest, name_of):
        def step_(self, *args, **more):
            if name_of(self, *args) == bad:
                raise ZeroDivisionError("nobody foresaw this")
            return honest(self, *args, **more)

        return step_

    def by_number(self, number, *_):
        return self.members.by_id[number].photo.name

    module, cls, method, name_of = {
        "features": (links, "LiveLinks", "features", by_number),
        "place": (initial_pose, "InitialPose", "place", lambda self, m: m.photo.name),
        "refine": (refinement, "Refinement", "refine", lambda self, m: m.photo.name),
        "draw": (
            reduced_pictures,
            "SmallPictures",
            "_reduced",
            lambda self, n: self.members[n].photo.name,
        ),
    }[step]
    owner = getattr(module, cls)
    monkeypatch.setattr(owner, method, failing(getattr(owner, method), name_of))
    for path in flight.photos[:4]:
        live.intake.take_file(path, "drone")
    list(live.drain_all())
    counts = live.ledger.counts()
    assert live.ledger.row("select state, reason from photo where name = ?", bad)[0] == "refused"
    assert sum(counts.get(k, 0) for k in ("refined", "placed", "waiting")) == 3
    log = (tmp_path / "out" / "errors.log").read_text()
    assert bad in log and "ZeroDivisionError: nobody foresaw this" in log and "Traceback" in log
    events = [json.loads(b) for _, kind, b in live.ledger.told(0) if kind == "photo"]
    assert any(e["name"] == bad and e["state"] == "refused" for e in events)
    live.close()
    again = LiveMap(tmp_path / "out", QUICK)  # and it starts again
    list(again.drain_all())
    again.add(flight.photos[4])
    assert again.ledger.row("select state from photo where name = ?", flight.photos[4].name)[0] in (
        "refined",
        "placed",
        "waiting",
    )
    again.close()


def test_an_error_of_the_disk_is_no_error_of_a_photo(flight, tmp_path, monkeypatch):
    live = LiveMap(tmp_path / "out", QUICK)
    live.intake.take_file(flight.photos[0], "drone")
    honest = LiveMap._pixels

    def broken(self, number):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(LiveMap, "_pixels", lambda self, n: broken(self, n))
    live.full.read = lambda n: broken(live, n)
    with pytest.raises(OutputError):
        list(live.drain())
    monkeypatch.setattr(LiveMap, "_pixels", honest)
    live._reload()
    list(live.drain())
    assert live.ledger.counts()["refused"] == 0
    live.close()


class Box:
    """A watched folder and what was taken from it."""

    def __init__(self, tmp_path, **settings):
        self.folder = tmp_path / "in"
        self.folder.mkdir(exist_ok=True)
        self.out = tmp_path / "out"
        self.out.mkdir(exist_ok=True)
        self.ledger = Ledger(self.out, write=True)
        settings = LiveSettings(**settings)
        inbox = Inbox(self.ledger, self.out / "photos", most_bytes=settings.most_bytes)
        self.intake = Intake(self.ledger, inbox, settings)
        self.watch, self.clock = Watch(folder=self.folder, intake=self.intake), Clock()

    def look(self, seconds=1.0, photos=None):
        """What is taken or refused within some seconds; soon after so many `photos` no more is
        waited for, but for what would be one too many.
        """
        found, rounds = [], int(seconds / 0.05)
        while rounds > 0:
            found += self.clock.look(self.watch, 0.05)
            rounds = (
                min(rounds - 1, 5) if photos is not None and len(found) >= photos else rounds - 1
            )
        return found


def test_names_that_are_no_text_are_taken(tmp_path):
    box = Box(tmp_path)
    Path(os.fsdecode(os.fsencode(box.folder) + b"/a\xff\x1b.jpg")).write_bytes(jpeg())
    found = box.look(photos=1)
    assert len(found) == 1 and not isinstance(found[0], Refused)
    assert found[0].name.isprintable()
    assert Box(tmp_path).look(0.3) == []  # it is known after a restart


def test_a_file_that_is_gone_again_is_told_and_forgotten(tmp_path, monkeypatch):
    box = Box(tmp_path)
    (box.folder / "a.jpg").write_bytes(jpeg())
    honest = Watch._unfinished

    def gone(self, path, **more):
        path.unlink(missing_ok=True)
        return honest(self, path, **more)

    monkeypatch.setattr(Watch, "_unfinished", gone)
    told = [REMOVED] if box.watch._closed.told else []
    assert [f.reason for f in box.look(0.5)] == told and box.watch.growing == {}


def test_a_file_that_is_too_large_is_refused_and_the_next_is_taken(tmp_path):
    box = Box(tmp_path, most_bytes=10_000)
    (box.folder / "a.jpg").write_bytes(jpeg() + bytes(20_000))
    (box.folder / "b.jpg").write_bytes(jpeg())
    found = {f.name: f for f in box.look(5, photos=2)}
    assert isinstance(found["a.jpg"], Refused) and "--max-mb" in found["a.jpg"].reason
    assert not isinstance(found["b.jpg"], Refused)


def test_pipes_sockets_and_devices_are_refused_and_the_next_is_taken(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    box = Box(tmp_path)
    os.mkfifo(box.folder / "a.jpg")
    with socket.socket(socket.AF_UNIX) as one:
        one.bind("in/b.jpg")
    (box.folder / "c.jpg").symlink_to(os.devnull)
    (box.folder / "d.jpg").write_bytes(jpeg())
    found = {f.name: f for f in box.look(6, photos=4)}
    assert not isinstance(found.pop("d.jpg"), Refused)
    assert {name: bool(f) for name, f in found.items()} == {
        "a.jpg": False,
        "b.jpg": False,
        "c.jpg": False,
    }


def test_links_that_loop_are_not_followed(tmp_path):
    inner = tmp_path / "in" / "x"
    inner.mkdir(parents=True)
    for k in range(6):
        (inner / f"l{k}").symlink_to(tmp_path / "in", target_is_directory=True)
    box = Box(tmp_path)
    assert len(box.watch._closed._folders) == 2
    (inner / "a.jpg").write_bytes(jpeg())
    assert len(box.look(photos=1)) == 1


def test_an_inbox_that_goes_away_and_comes_back(tmp_path):
    box = Box(tmp_path)
    (box.folder / "a.jpg").write_bytes(jpeg())
    assert len(box.look(photos=1)) == 1
    box.folder.rename(tmp_path / "away")
    assert box.look(0.3) == []
    (tmp_path / "away").rename(box.folder)
    (box.folder / "b.jpg").write_bytes(jpeg(96, 80))
    assert len(box.look(2.5, photos=1)) == 1


def test_what_was_reported_while_the_inbox_is_away_is_taken_when_it_is_back(tmp_path, monkeypatch):
    """Without waiting for the next scan of the whole folder."""
    box = Box(tmp_path)
    monkeypatch.setattr(folder_watch, "SCAN_TOLD_S", 1000.0)
    monkeypatch.setattr(folder_watch, "SCAN_S", 1000.0)
    (box.folder / "a.jpg").write_bytes(jpeg())
    assert len(box.look(1.0, photos=1)) == 1
    for number in range(3):
        (box.folder / f"b{number}.jpg").write_bytes(jpeg(96, 80 + number))
    box.folder.rename(tmp_path / "away")
    assert box.look(0.3) == []  # the reports are read now
    (tmp_path / "away").rename(box.folder)
    assert len(box.look(2.0, photos=3)) == 3


def test_an_inbox_that_the_system_does_not_answer_for_is_waited_for(tmp_path, monkeypatch):
    """As of a network that is gone: what asks for the folder gets another error than of one that is
    missing.
    """
    box = Box(tmp_path)
    real = Path.is_dir

    def unanswered(path, **words):
        if path == box.folder:
            raise OSError(errno.ENOTCONN, "Transport endpoint is not connected", str(path))
        return real(path, **words)

    monkeypatch.setattr(Path, "is_dir", unanswered)
    assert box.look(0.3) == []
    monkeypatch.undo()
    (box.folder / "b.jpg").write_bytes(jpeg(96, 80))
    assert len(box.look(2.5, photos=1)) == 1


def run_until(live, inbox, done, seconds=300, stop=None):
    """Notes of a live map that runs until `done()` after something happened, or until `stop`."""
    stop = stop or threading.Event()
    timer = threading.Timer(seconds, stop.set)
    timer.start()
    notes = []
    for happened in iter_live([inbox], live, stop=stop):
        if isinstance(happened, Note):
            notes.append(happened.text)
        if done(notes):
            stop.set()
    timer.cancel()
    return notes


@pytest.mark.slow
def test_an_inbox_that_goes_away_is_told_once_and_when_it_is_back(tmp_path, monkeypatch):
    inbox = tmp_path / "in"
    inbox.mkdir()
    live = LiveMap(tmp_path / "out", QUICK)
    rounds, stop = count(), threading.Event()

    def moved(folder, *rest):
        if (n := next(rounds)) == 20:
            inbox.rename(tmp_path / "away")
        elif n == 60:
            (tmp_path / "away").rename(inbox)
        elif n == 200:
            stop.set()
        return real(folder, *rest)

    real = workflow._away
    monkeypatch.setattr(workflow, "_away", moved)
    notes = run_until(live, inbox, lambda _: False, stop=stop)
    live.close()
    assert notes == [
        f"{inbox} cannot be found or read; no photo arrives from there until it is back",
        f"{inbox} is there again",
    ]


@pytest.mark.slow
def test_a_disk_that_stays_full_is_told_once(tmp_path, monkeypatch):
    inbox = tmp_path / "in"
    inbox.mkdir()
    live = LiveMap(tmp_path / "out", QUICK)
    errors = [OutputError("the disk is full")] * 5 + [None] * 3 + [OutputError("again")] * 2
    failing, stop = iter([*errors, *[None] * 20]), threading.Event()

    def work():
        if (error := next(failing, stop)) is stop:
            stop.set()
        elif error is not None:
            raise error

    monkeypatch.setattr(workflow, "FULL_S", 0.0)
    monkeypatch.setattr(live, "work", work)
    notes = run_until(live, inbox, lambda _: False, stop=stop)
    live.close()
    assert notes == ["the disk is full", "again"]


def stored(live):
    """The stored file of each photo by its name."""
    rows = live.ledger.rows("select name, file from photo")
    return {str(n): live.folder / "photos" / str(f) for n, f in rows}


@pytest.mark.slow
def test_a_stored_photo_that_is_lost_is_told_and_taken_again(flight, tmp_path):
    """From its folder at the next start; sent by HTTP, when it is sent again."""
    inbox = tmp_path / "in"
    inbox.mkdir()
    for path in flight.photos[:4]:
        shutil.copy(path, inbox)
    live = taken(tmp_path / "out", inbox, 4)
    assert live.ledger.counts().get("refused") == 0
    first, second = (p.name for p in flight.photos[:2])
    stored(live)[first].unlink()
    stored(live)[second].write_bytes(b"")
    (inbox / second).unlink()
    live.close()

    live = LiveMap(tmp_path / "out", QUICK)
    reasons = refused(live)
    assert set(reasons) == {first, second} and live.ledger.counts()["refused"] == 2
    told = [json.loads(b) for _, kind, b in live.ledger.told(0) if kind == "photo"][-2:]
    assert {(b["name"], b["state"]) for b in told} == {(first, "refused"), (second, "refused")}
    live.close()

    live = LiveMap(tmp_path / "out", QUICK)
    run_until(live, inbox, lambda _: set(refused(live)) == {second})
    assert set(refused(live)) == {second}
    done = live.intake.take(iter([flight.photos[1].read_bytes()]), second, "drone")
    assert not done.duplicate and live.ledger.counts()["refused"] == 0
    for _ in live.drain_all():
        pass
    states = {str(n): str(s) for n, s in live.ledger.rows("select name, state from photo")}
    assert len(states) == 4 and set(states.values()) <= {"placed", "refined"}
    again = live.intake.take(iter([flight.photos[1].read_bytes()]), second, "drone")
    assert again.duplicate and again.id == done.id
    live.close()


def test_the_final_map_names_photos_whose_files_are_gone(flight, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(final_map, "iter_bands", lambda paths, *_, **__: seen.append(paths) or ())
    live = LiveMap(tmp_path / "out", QUICK)
    for path in flight.photos[:3]:
        live.intake.take_file(path, "drone")
    gone = flight.photos[1].name
    stored(live)[gone].unlink()
    (note,) = final_map.iter_finish(live.folder, QUICK)
    assert note.warning and gone in note.text and "without them" in note.text
    assert [p.stem for p in seen[0]] == [p.stem for p in flight.photos[:3] if p.name != gone]
    for path in stored(live).values():
        path.unlink(missing_ok=True)
    with pytest.raises(NoPhotosError, match="all photos are gone"):
        list(final_map.iter_finish(live.folder, QUICK))
    live.close()


def test_a_folder_of_the_survey_that_is_removed_is_told_on_the_page_too(flight, tmp_path):
    (tmp_path / "in").mkdir()
    live = LiveMap(tmp_path / "out", QUICK)
    shutil.rmtree(live.folder / "photos")
    shutil.copy(flight.photos[0], tmp_path / "in")
    stop, events = threading.Event(), []
    for event in iter_live([tmp_path / "in"], live, stop=stop):
        events.append(event)
        stop.set()
    (note,) = events
    assert note.warning and "is gone: no photo is accepted until it is back" in note.text
    told = live.ledger.rows("select body from event where kind = 'note'")
    assert [json.loads(body)["text"] for (body,) in told] == [note.text]
    live.close()


def test_no_photo_is_lost_while_the_survey_is_elsewhere(flight, tmp_path):
    """Its folder is moved away and back: what was accepted is placed then, what comes meanwhile is
    not refused, and the place stays free.
    """
    live, gone = LiveMap(tmp_path / "out", QUICK), "is gone: no photo is accepted until"
    uploads = Uploads(live.folder / "uploads", Guard())
    live.intake.take_file(flight.photos[0], "")
    live.folder.rename(tmp_path / "away")
    for _ in range(2):  # the second time all is read again from the database
        with pytest.raises(OutputError, match=gone):
            live.work()
    with pytest.raises(OutputError, match=gone):
        live.intake.take_file(flight.photos[1], "")
    with pytest.raises(OutputError):
        live.store.put("features", "0", [1])
    with pytest.raises(FileNotFoundError):
        uploads.begin("a.jpg", "phone", 9)
    assert not live.folder.exists()
    (tmp_path / "away").rename(live.folder)
    list(live.drain_all())
    assert live.ledger.counts() == {"placed": 1, "refused": 0}
    live.close()


def test_a_photo_that_is_stored_while_the_survey_is_moved_is_not_refused(
    flight, tmp_path, monkeypatch
):
    live = LiveMap(tmp_path / "out", QUICK)
    bring = live.inbox.bring

    def brought(blocks):
        arrived = bring(blocks)
        live.folder.rename(tmp_path / "away")
        return arrived

    monkeypatch.setattr(live.inbox, "bring", brought)
    with pytest.raises(OutputError, match="is gone: no photo is accepted until it is back"):
        live.intake.take_file(flight.photos[0], "")
    (tmp_path / "away").rename(live.folder)
    assert live.ledger.counts()["refused"] == 0
    monkeypatch.undo()
    assert live.intake.take_file(flight.photos[0], "")
    live.close()


@pytest.mark.parametrize("what", ["removed", "replaced", "back in time"])
def test_a_survey_that_is_removed_while_it_grows_ends_it(tmp_path, monkeypatch, what):
    """It had gone on for ever, with a page of what is gone. Where another survey took its place,
    photos were accepted by a database without a name, and lost.
    """
    monkeypatch.setattr(workflow, "GONE_S", 0.2)
    monkeypatch.setattr(workflow, "IDLE_S", 0.0)
    live = LiveMap(tmp_path / "out", QUICK)
    stopped, until = threading.Event(), time.monotonic() + 0.5
    events = iter_live([], live, stop=stopped)
    live.folder.rename(tmp_path / "away")
    if what == "back in time":
        (tmp_path / "away").rename(live.folder)
    elif what == "replaced":
        live.folder.mkdir()
        Ledger(live.folder, write=True).close()
    monkeypatch.setattr(live, "work", lambda: stopped.set() if time.monotonic() > until else None)
    if what == "back in time":
        assert list(events) == []
    else:
        with pytest.raises(OutputError, match="was removed or replaced while the map grew there"):
            list(events)
    live.close()


def test_two_live_maps_on_one_folder_are_refused(tmp_path):
    code = (
        "import sys; from pathlib import Path; from skyquilt.engine.lock import FolderLock;"
        "lock = FolderLock(Path(sys.argv[1]), 'live.lock', 'live map'); lock.tell('http://here/');"
        "print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(OutputError, match=rf"process {other.pid}, http://here/"):
            FolderLock(tmp_path, "live.lock", "live map")
        other.kill()
        other.wait()
        FolderLock(tmp_path, "live.lock", "live map").close()  # whoever was killed holds nothing


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
def test_a_folder_that_is_now_read_only_is_refused_at_the_start(tmp_path):
    LiveMap(tmp_path / "out", QUICK).close()
    for path in [tmp_path / "out", *(tmp_path / "out").rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    for path in [tmp_path, *tmp_path.parents][:4]:
        path.chmod(path.stat().st_mode | 0o555)
    pid = os.fork()
    if pid == 0:
        os.setuid(65534)
        try:
            LiveMap(tmp_path / "out", QUICK)
        except OutputError:
            os._exit(5)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 5
