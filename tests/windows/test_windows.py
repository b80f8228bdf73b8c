"""Skyquilt as on Windows, as far as Linux can show it (`sitecustomize.py`)."""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx
import pytest

ROOT = Path(__file__).resolve().parents[2]
OPEN, DENIED, FORBIDDEN = 32, 5, 123
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="it looks into /proc")

HOLDS = """
import sys
from pathlib import Path
from skyquilt.engine.lock import FolderLock
lock = FolderLock(Path(sys.argv[1]), "run.lock", "run")
lock.tell("http://127.0.0.1:8080/")
print("held", flush=True)
sys.stdin.read()
"""


def test_two_programs_do_not_write_into_one_folder(windows, tmp_path):
    holder = windows.start("-c", HOLDS, tmp_path)
    assert holder.stdout.readline() == "held\n"
    other = windows.start("-c", HOLDS, tmp_path)
    said = other.communicate(timeout=20)[0]
    assert f"another run works in {tmp_path} (process {holder.pid}, http://127" in said
    assert json.loads((tmp_path / "run.lock").read_bytes())["process"] == holder.pid
    holder.kill()
    holder.wait()
    after = windows.start("-c", HOLDS, tmp_path)
    assert after.stdout.readline() == "held\n"


REFUSES = """
import os, sys, threading, time
from pathlib import Path
from skyquilt.outside import put_in_place, remove_file, remove_folder

here = Path.cwd()
def told(change):
    try:
        change()
    except OSError as error:
        print(type(error).__name__, getattr(error, "winerror", ""))
    except (AttributeError, ImportError, EncodingWarning) as error:
        print(type(error).__name__)

for name in "abcd":
    (here / name).write_bytes(b"x")
(here / "folder").mkdir()
(here / "folder" / "e").write_bytes(b"x")
told(lambda: exec("import fcntl", globals()))
told(lambda: os.nice)
told(lambda: (here / "a").write_text("x"))
told(lambda: (here / "a:b").write_bytes(b"x"))
told(lambda: (here / "aux.txt").write_bytes(b"x"))
told(lambda: os.open(here, os.O_RDONLY))
with open(here / "a", "rb"), open(here / "folder" / "e", "rb"):
    told(lambda: (here / "b").replace(here / "a"))
    told(lambda: (here / "a").replace(here / "b"))
    told(lambda: (here / "a").unlink())
    told(lambda: (here / "folder").rename(here / "other"))
readers = [open(here / name, "rb") for name in ("a", "c", "folder/e")]
def ends():
    time.sleep(0.2)
    for reader in readers:
        reader.close()
threading.Thread(target=ends).start()
put_in_place(here / "b", here / "a")
remove_file(here / "c")
remove_folder(here / "folder")
print(sorted(p.name for p in here.iterdir()))
"""


def test_what_others_read_is_waited_for(windows, tmp_path, monkeypatch):
    """The emulation refuses what Windows does; what is put in place and removed waits."""
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.chdir(home)
    assert windows.ours(REFUSES).splitlines() == [
        "ModuleNotFoundError",
        "AttributeError",
        "EncodingWarning",
        f"OSError {FORBIDDEN}",
        f"OSError {FORBIDDEN}",
        f"PermissionError {DENIED}",
        f"PermissionError {DENIED}",
        f"PermissionError {OPEN}",
        f"PermissionError {OPEN}",
        f"PermissionError {OPEN}",
        "['a', 'd']",
    ]


def content(path):
    return hashlib.blake2b(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Six photos and their map, made without the emulation."""
    out = tmp_path_factory.mktemp("flown")
    words = [sys.executable, "-m", "skyquilt"]
    for more in (
        ["simulate", out / "flight", "--photos", "6", "--size", "400x300"],
        ["mosaic", out / "flight" / "photos", "-o", out / "map"],
    ):
        subprocess.run([*words, *map(str, more), "--quiet"], check=True, timeout=120)
    return out


class Reading:
    """Two clients that ask a server for all it has, again and again."""

    def __init__(self, url):
        self.url, self.end = url, threading.Event()
        self.answers: dict[tuple[str, int], int] = {}
        self.threads = [threading.Thread(target=self.work) for _ in range(2)]

    def __enter__(self):
        for thread in self.threads:
            thread.start()
        return self

    def __exit__(self, *_):
        self.end.set()
        for thread in self.threads:
            thread.join()

    def work(self):
        with httpx.Client(base_url=self.url, timeout=30) as web:
            while not self.end.is_set():
                for path in self.paths(web):
                    try:
                        answer = web.get(path)
                    except httpx.HTTPError:  # the viewer's process was ended
                        time.sleep(0.1)
                        continue
                    what = path.split("?")[0].split("/")[0], answer.status_code
                    self.answers[what] = self.answers.get(what, 0) + 1
                    self.end.wait(0.03)

    def paths(self, web):
        try:
            photos = [p["id"] for p in web.get("photos").json()["photos"]][:2]
            files = [f["name"] for f in web.get("files").json()["files"]]
            box = ",".join(map(str, web.get("tiles.json").json()["bounds"]))
        except (httpx.HTTPError, LookupError, ValueError):
            return ["info"]
        return ["info", *(f"photos/{k}/file" for k in photos), *(f"files/{f}" for f in files)] + [
            f"export?bbox={box}"
        ]


@pytest.mark.slow
def test_a_map_is_made_resumed_and_replaced_while_it_is_shown(windows, flight, tmp_path):
    photos, out = flight / "flight" / "photos", tmp_path / "out"
    first = windows.start("-m", "skyquilt", "mosaic", photos, "-o", out, "--quiet")
    store = out / ".skyquilt" / "store"
    while not list(store.glob("features/*.npz")):
        assert first.poll() is None
        time.sleep(0.02)
    first.kill()
    first.wait()
    windows.skyquilt("mosaic", photos, "-o", out)
    assert content(out / "mosaic.tif") == content(flight / "map" / "mosaic.tif")
    assert windows.refused() == []
    windows.skyquilt("export", out, "--what", "png,kmz,mbtiles,tiles,tif,heights,footprints")
    windows.skyquilt("export", out, "--what", "tiles,mbtiles,footprints")  # in place of those
    assert windows.refused() == []
    viewer, url = windows.served("view", out)
    assert "javascript" in httpx.get(url + "static/viewer.js").headers["content-type"]
    with Reading(url) as reading:
        while reading.answers.get(("export", 200), 0) < 2:
            time.sleep(0.05)
        windows.skyquilt("mosaic", photos, "-o", out, "--gsd", "20", "--overwrite", "--quiet")
    assert reading.answers["files", 200] > 2
    keeps = windows.start(
        "-c", f"f = open({str(out / 'mosaic.tif')!r}); print(1, flush=True); input()"
    )
    assert keeps.stdout.readline() == "1\n"
    replaces = windows.start(
        "-m", "skyquilt", "mosaic", photos, "-o", out, "--gsd", "30", "--overwrite"
    )
    said = replaces.communicate(timeout=60)[0]
    assert replaces.returncode == 5
    assert f"{out / 'mosaic.tif'} cannot be written: another program has it open" in said
    assert viewer.poll() is None


def until(holds, seconds=40.0):
    end = time.monotonic() + seconds
    while not (found := holds()):
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.1)
    return found


def placed(web):
    """Number of the photos that are on the map; 0 while one waits."""
    rings = [bool(p["ring"]) for p in web.get("photos").json()["photos"]]
    return len(rings) * all(rings)


def finished(out):
    """The key of the finished map, empty while there is none."""
    try:
        said = json.loads((out / "finished" / ".skyquilt" / "run.json").read_bytes())
    except (OSError, ValueError):
        return ""
    return said["key"] if said["state"] == "done" else ""


@pytest.mark.slow
def test_a_live_map_is_shown_finished_and_goes_on_when_its_viewer_ends(windows, flight, tmp_path):
    inbox, out = tmp_path / "inbox", tmp_path / "out"
    live, url = windows.served("live", inbox, "-o", out)
    threading.Thread(target=live.stdout.read, daemon=True).start()
    with httpx.Client(base_url=url, timeout=60) as web, Reading(url) as reading:
        lossy = ("--loss", "0.3", "--rate", "10", "--quiet")
        windows.skyquilt("fly", flight / "flight", "--to", inbox, *lossy)
        some = len(list(inbox.rglob("*.jpg")))
        assert 3 <= some < 6
        until(lambda: placed(web) == some)
        assert web.post("finish").status_code == 200
        first = until(lambda: finished(out))
        # the photos that were lost, under the name of a device
        for photo in sorted((flight / "flight" / "photos").glob("*.jpg")):
            sent = {"name": "CON.jpg", "source": "web"}
            assert web.post("photos", params=sent, content=photo.read_bytes()).is_success
        until(lambda: placed(web) == 6)
        assert web.post("finish").status_code == 200
        until(lambda: finished(out) not in ("", first))
        children = Path(f"/proc/{live.pid}/task/{live.pid}/children").read_text().split()
        (viewer,) = (
            int(k) for k in children if b"spawn_main" in Path(f"/proc/{k}/cmdline").read_bytes()
        )
        os.kill(viewer, signal.SIGKILL)

        def answers():
            try:
                return web.get("info").is_success
            except httpx.HTTPError:
                return False

        until(lambda: not answers())
        until(answers)
    assert reading.answers["files", 200] > 2
    assert not [what for what in reading.answers if what[1] == 500]
    assert "CON.jpg" not in {p.name for p in (out / "named").iterdir()}


ASKS_THE_SYSTEM = re.compile(
    r"^\s*(?:import|from) (?:asyncio|ctypes|errno|mmap|multiprocessing|os|select|signal|socket"
    r"|subprocess|sys|tempfile|threading|time)\b",
    re.M,
)


def lacking(platform, files):
    """What mypy finds in files that are looked at one by one: all together take 45 s."""
    words = ["--platform", platform, "--follow-imports=skip", "--cache-dir", os.devnull]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words, *map(str, files)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert f"checked {len(files)} source files" in done.stdout, done.stdout + done.stderr
    return set(done.stdout.splitlines()[:-1])


@pytest.mark.slow
def test_nothing_is_used_that_a_platform_lacks():
    """By mypy's library of types: nothing is wrong there that is not on Linux."""
    files = [p for p in (ROOT / "src").rglob("*.py") if ASKS_THE_SYSTEM.search(p.read_text())]
    here = lacking("linux", files)
    for platform in ("win32", "darwin"):
        assert lacking(platform, files) - here == set()
