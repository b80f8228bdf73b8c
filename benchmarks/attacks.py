"""What attacks on readers, requests and the live map get: the sentence or status, seconds, memory.

    python benchmarks/attacks.py WORK                      this program
    python benchmarks/attacks.py WORK --source OTHER/src   another version of it
    python benchmarks/attacks.py WORK --only wms

Prints a row of Markdown for each attack. Inputs are those of `../shared/data/attacks` where they
lie there, and what is made here. Seconds are of CPU for photos and side files (the start of the
program included), otherwise elapsed; MB is resident memory: what a photo added, what a command
took, what the live map and its viewer grew by. Every command has 7 GB of addresses and a minute.
"""

import argparse
import http.client
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from contextlib import contextmanager, suppress
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data" / "attacks"
LIMIT_S, LIMIT_BYTES = 60, 7 * 2**30
READ = """
import resource, sys, time
from pathlib import Path
import cv2, simplejpeg, tifffile, PIL.PngImagePlugin
from skyquilt.photos.read import read_photo
from skyquilt.photos.pixels import read_color
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
before, began = peak(), time.process_time()
try:
    photo = read_photo(Path(sys.argv[1]))
    said = getattr(photo, "reason", "") or f"read, {read_color(photo).shape}"
except Exception as error:
    said = f"{type(error).__name__}: {error}"
print(f"{time.process_time() - began:.2f}|{peak() - before:.0f}|{said}")
"""


def environment(source):
    return {
        **os.environ,
        "PYTHONPATH": str(source),
        "OPENBLAS_NUM_THREADS": "1",
        "COLUMNS": "200",
        "NO_COLOR": "1",
    }


def bounded():
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))


def run(source, *words):
    """Exit status, what it said last, seconds of CPU, and memory in MB of a command."""
    began, spent = time.monotonic(), cpu_of_children()
    with tempfile.TemporaryFile() as said:
        child = subprocess.Popen(
            [sys.executable, *map(str, words)],
            stdout=said,
            stderr=subprocess.STDOUT,
            env=environment(source),
            preexec_fn=bounded,
        )
        status, most = None, 0.0
        while status is None and time.monotonic() - began < LIMIT_S:
            time.sleep(0.02)
            most = max(most, peak_mb(child.pid))
            status = child.poll()
        if status is None:
            child.kill()
            child.wait()
            status = "killed after a minute"
        said.seek(0)
        return status, said.read().decode(errors="replace"), cpu_of_children() - spent, most


def cpu_of_children():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def peak_mb(pid):
    with suppress(OSError, IndexError):
        text = Path(f"/proc/{pid}/status").read_text()
        return int(text.split("VmHWM:")[1].split()[0]) / 1024
    return 0.0


def row(name, said, seconds, memory):
    """One row; the sentence shortened, with escapes visible."""
    flat = " ".join(str(said).split()).replace("|", "\\|").encode("unicode_escape").decode()
    flat = flat if len(flat) < 170 else f"{flat[:90]} ... {flat[-70:]}"
    print(f"| {name} | {flat} | {seconds:.1f} | {memory:.0f} |", flush=True)


# -- readers


def photos(source, work):
    ends = {"jpeg": ".jpg", "png": ".png", "tiff": ".tif"}
    for path in sorted(SHARED.iterdir()):
        kind = path.name.split("-")[1] if path.name.startswith("bomb-") else ""
        if kind or path.suffix == ".jpg":
            copy = work / (path.name + ends.get(kind, ""))
            shutil.copyfile(path, copy)
            status, said, seconds, memory = run(source, "-c", READ, copy)
            line = said.strip().splitlines()[-1] if said.strip() else f"status {status}"
            parts = line.split("|", 2)
            if len(parts) == 3:
                row(path.name, parts[2], float(parts[0]), float(parts[1]))
            else:
                row(path.name, f"{status}: {line}", seconds, memory)


def side_files(source, work, flight):
    """Through the command line: exit status and last line."""
    few = work / "few"
    few.mkdir()
    for path in flight[:2]:
        shutil.copyfile(path, few / path.name)
    named = {"geo": ".txt", "csv": ".csv", "mrk": ".MRK", "cameras": ".json", "geojson": ".geojson"}
    options = {"cameras": "--cameras", "geojson": "--boundary", "distances": "--distances"}
    for path in [*sorted(SHARED.iterdir()), *sorted((SHARED / "cli").iterdir())]:
        kind, geo = path.name.split("-")[0], path.parent.name == "cli"
        if geo:
            kind = {".json": "cameras", ".csv": "csv"}.get(path.suffix, "geo")
            kind = "distances" if path.name.startswith("q") else kind
            kind = "bench" if path.name.startswith("p") else kind
        if kind not in (*named, "distances", "bench"):
            continue
        copy = work / (path.name if geo else path.name + named.get(kind, ".csv"))
        shutil.copyfile(path, copy)
        out = work / "out"
        shutil.rmtree(out, ignore_errors=True)
        words = ["-m", "skyquilt", "mosaic", few, "-o", out, options.get(kind, "--geo"), copy]
        if kind == "bench":
            words = ["-m", "skyquilt", "spectral-bench", copy, "-o", out]
        status, said, seconds, memory = run(source, *words)
        row(path.name, f"exit {status}: {last(said)}", seconds, memory)


def last(said):
    """The last paragraph of what a command said, without its frame."""
    text = said.strip().replace("╭", " ").replace("╰", " ").replace("│", " ").replace("─", "")
    traceback = "Traceback" in text
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return ("Traceback ... " if traceback else "") + " ".join(
        lines[-1:] if traceback else lines[-3:]
    )


# -- the live map


class Site:
    """A live map and its viewer in processes of their own."""

    def __init__(self, source, folder, *options):
        self.inbox, self.out = folder / "in", folder / "out"
        self.inbox.mkdir(parents=True, exist_ok=True)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        words = ["-m", "skyquilt", "live", self.inbox, "-o", self.out, "--port", self.port]
        self.log = (folder / "log").open("ab+")
        self.child = subprocess.Popen(
            [sys.executable, *map(str, [*words, *options])],
            stdout=self.log,
            stderr=subprocess.STDOUT,
            env=environment(source),
        )

    def up(self, seconds=90):
        until = time.monotonic() + seconds
        while time.monotonic() < until and self.child.poll() is None:
            if self.get("/info")[0] == 200:
                return True
            time.sleep(0.2)
        return False

    def get(self, path, timeout=60, **headers):
        """Status, seconds and the first of the body."""
        began = time.monotonic()
        try:
            web = http.client.HTTPConnection("127.0.0.1", self.port, timeout=timeout)
            web.putrequest("GET", path, skip_host="Host" in headers)
            for key, value in headers.items():
                web.putheader(key.replace("_", "-"), value)
            web.endheaders()
            answer = web.getresponse()
            return answer.status, time.monotonic() - began, answer.read(300)
        except (OSError, http.client.HTTPException) as error:
            return type(error).__name__, time.monotonic() - began, b""

    def send(self, method, path, body=b"", **headers):
        try:
            web = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
            named = {k.replace("_", "-"): v for k, v in headers.items()}
            web.request(method, path, body=body, headers=named)
            answer = web.getresponse()
            answer.read()
            return answer
        except (OSError, http.client.HTTPException) as error:
            return error

    def names(self):
        """Names of the photos that it has."""
        try:
            where = f"http://127.0.0.1:{self.port}/photos"
            with urllib.request.urlopen(where, timeout=20) as answer:
                said = json.load(answer)
            return [p["name"] for p in said["photos"]]
        except (OSError, ValueError, urllib.error.URLError):
            return []

    def waits_for(self, name, seconds=30):
        """What became of a photo that was put into the folder."""
        began = time.monotonic()
        while time.monotonic() - began < seconds:
            if self.child.poll() is not None:
                return f"the live map ended with status {self.child.poll()}"
            if name in self.names():
                return "the next photo is taken"
            time.sleep(0.3)
        return "the next photo is never taken"

    def viewer(self):
        """The process that answers: the child that holds most memory, or the map itself."""
        found = Path(f"/proc/{self.child.pid}/task/{self.child.pid}/children")
        pids = [int(p) for p in found.read_text().split()] if found.exists() else []
        return max([*pids, self.child.pid], key=now_mb) if pids else self.child.pid

    def memory(self):
        """Of the map and all its children, MB."""
        found = Path(f"/proc/{self.child.pid}/task/{self.child.pid}/children")
        pids = [int(p) for p in found.read_text().split()] if found.exists() else []
        return sum(map(now_mb, [*pids, self.child.pid]))

    def end(self):
        with suppress(OSError):
            self.child.send_signal(signal.SIGINT)
        try:
            self.child.wait(20)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()


def now_mb(pid):
    with suppress(OSError, IndexError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 2**20
    return 0.0


@contextmanager
def site(source, *options):
    folder = Path(tempfile.mkdtemp(prefix="skyquilt-attack-"))
    live = Site(source, folder, *options)
    try:
        yield live
    finally:
        live.end()
        shutil.rmtree(folder, ignore_errors=True)


def folders(source, flight):
    """What lies in a watched folder."""

    def tried(name, put, *options):
        with site(source, *options) as live:
            if not live.up():
                row(name, "it does not start", 0, 0)
                return
            before, began = live.memory(), time.monotonic()
            put(live.inbox)
            shutil.copyfile(flight[0], live.inbox / "z.jpg")
            said = live.waits_for("z.jpg")
            live.log.seek(0)
            raw = " and escape bytes are shown raw" if b"\x1b[31mx" in live.log.read() else ""
            row(name, said + raw, time.monotonic() - began, live.memory() - before)

    def thin(inbox):
        shutil.copyfile(SHARED / "thin-20000x32.jpg", inbox / "a.jpg")

    def bytes_name(inbox):
        shutil.copyfile(flight[1], os.fsencode(inbox) + b"/\xff.jpg")

    def large(inbox):
        (inbox / "a.jpg").write_bytes(flight[1].read_bytes() + bytes(2_000_000))

    def loops(inbox):
        (inbox / "d").mkdir()
        for k in range(12):
            (inbox / "d" / f"l{k}").symlink_to("..")

    tried("1: a thin photo in the folder", thin)
    tried("5: a name that is no UTF-8", bytes_name)
    tried("7: a file above --max-mb, first in order", large, "--max-mb", "1")
    tried("8: a pipe as a.jpg", lambda inbox: os.mkfifo(inbox / "a.jpg"))
    tried("9: links that loop", loops)
    tried(
        "22: escape bytes in a name",
        lambda inbox: (inbox / "\x1b[31mx.jpg").write_bytes(b"\xff\xd8\xff no photo"),
    )


WMS = "/wms?SERVICE=WMS&VERSION=1.3.0&REQUEST=GetMap&STYLES=&CRS=EPSG:4326&FORMAT=image/png"


def requests(source, flight, part):
    with site(source) as live:
        if not live.up():
            row("requests", "it does not start", 0, 0)
            return
        for path in flight:
            shutil.copyfile(path, live.inbox / path.name)
        until = time.monotonic() + 60
        while len(live.names()) < len(flight) and time.monotonic() < until:
            time.sleep(0.5)
        time.sleep(5)
        caps = live.get("/wms?SERVICE=WMS&REQUEST=GetCapabilities")[2]
        del caps
        where = urllib.request.urlopen(f"http://127.0.0.1:{live.port}/photos", timeout=30)
        at = next(p["at"] for p in json.load(where)["photos"] if p["at"])
        box = f"&BBOX={at[1] - 0.002},{at[0] - 0.003},{at[1] + 0.002},{at[0] + 0.003}"
        base = WMS + box + "&LAYERS=visible"

        def ask(name, path, **headers):
            before, most, done = live.memory(), [0.0], threading.Event()

            def watch():
                while not done.wait(0.02):
                    most[0] = max(most[0], live.memory())

            threading.Thread(target=watch, daemon=True).start()
            status, seconds, _ = live.get(path, **headers)
            done.set()
            row(name, status, seconds, max(most[0] - before, 0))

        part(source, live, ask, base, box, flight)


def images(source, live, ask, base, box, flight):
    """Rows 2 and 3."""
    del source, box, flight
    ask("2: WIDTH=000000012000", base + "&WIDTH=000000012000&HEIGHT=000000012000")
    ask("2: WIDTH=40000", base + "&WIDTH=40000&HEIGHT=40000")
    ask("3: LAYERS 400 times", base + ",visible" * 400 + "&WIDTH=1024&HEIGHT=1024")
    for size in ((4096, 4096), (2048, 2048)):
        many(live, base + f"&WIDTH={size[0]}&HEIGHT={size[1]}", size)


def others(source, live, ask, base, box, flight):
    """Rows 11 to 13 and 17 to 19."""
    del base
    info = WMS.replace("GetMap", "GetFeatureInfo") + box + "&LAYERS=visible&QUERY_LAYERS=visible"
    info += "&WIDTH=256&HEIGHT=256&INFO_FORMAT=application/json"
    ask("18: WMS I of 400 digits", info + f"&I={'9' * 400}&J=1")
    ask("18: /photos/10**24", f"/photos/{10**24}")
    ask("18: /events?after= of 30 digits", f"/events?after={'9' * 30}&wait=0", timeout=3)
    ask("17: a strange Host", "/info", Host="evil.example")
    uploads(live, flight)
    half(live)
    words = ["live", live.inbox, "-o", live.out, "--port", live.port + 1]
    status, said, *cost = run(source, "-m", "skyquilt", *words)
    row("19: a second live map on the folder", f"exit {status}: {last(said)}", *cost)
    live.end()
    with site(source, "--token", "abc") as other:
        if other.up():
            asked = other.get("/info", Host="evil.example")
            row("17: a strange Host, with --token", asked[0], asked[1], 0)


def many(live, path, size):
    """40 requests at once: statuses, seconds of the slowest, memory at most and afterwards."""
    before, most, said, done = live.memory(), [0.0], [], threading.Event()

    def watch():
        while not done.wait(0.05):
            most[0] = max(most[0], live.memory())

    threading.Thread(target=watch, daemon=True).start()
    threads = [threading.Thread(target=lambda: said.append(live.get(path, 120))) for _ in range(40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    done.set()
    counts = {s: [x[0] for x in said].count(s) for s in {x[0] for x in said}}
    time.sleep(3)
    text = ", ".join(f"{n} x {s}" for s, n in counts.items())
    kept = live.memory() - before
    name = f"3: 40 GetMaps of {size[0]} x {size[1]} at once"
    row(name, f"{text}; {kept:.0f} MB kept", max(x[1] for x in said), most[0] - before)


def uploads(live, flight):
    tus = {"Tus_Resumable": "1.0.0"}
    body = flight[0].read_bytes() + b"another"
    for number in range(200):
        live.send("POST", "/photos/uploads", Upload_Length=str(1000 + number), **tus)
    now = live.send("POST", "/photos?name=n.jpg", body)
    began = time.monotonic()
    time.sleep(32)
    later = live.send("POST", "/photos?name=n.jpg", body)
    said = f"a photo at once {status(now)}, after 32 s {status(later)}"
    row("11: 200 announced uploads without a body", said, time.monotonic() - began, 0)
    began = live.send("POST", "/photos/uploads", Upload_Length="100", **tus)
    where = began.getheader("Location") if hasattr(began, "getheader") else None
    if not where:
        row("12: a part too long", f"no upload began ({status(began)})", 0, 0)
        return
    where = urllib.parse.urlparse(where).path
    part = {"Content_Type": "application/offset+octet-stream", "Upload_Offset": "0"}
    answer = live.send("PATCH", where, bytes(500), **tus, **part)
    after = live.send("HEAD", where, **tus)
    offset = after.getheader("Upload-Offset") if hasattr(after, "getheader") else None
    gone = live.send("DELETE", where, **tus)
    said = f"{status(answer)}, offset then {offset} of 100, DELETE {status(gone)}"
    row("12: a part too long", said, 0, 0)


def status(answer):
    return getattr(answer, "status", type(answer).__name__)


def half(live):
    """1,100 half-sent headers, then an ordinary request."""
    held = []
    for _ in range(1100):
        with suppress(OSError):
            one = socket.create_connection(("127.0.0.1", live.port), timeout=5)
            one.send(b"GET /info HTTP/1.1\r\nHost: localhost\r\nX-A: ")
            held.append(one)
    said = live.get("/info", timeout=30)
    time.sleep(12)
    after = live.get("/info", timeout=30)
    row("13: 1,100 half-sent headers", f"then {said[0]}, after 12 s {after[0]}", said[1], 0)
    for one in held:
        one.close()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--source", type=Path, default=ROOT / "src")
    parser.add_argument("--only", choices=["photos", "side", "folders", "images", "requests"])
    asked = parser.parse_args()
    source = asked.source.resolve()
    asked.work.mkdir(parents=True, exist_ok=True)
    made = asked.work / "flight"
    if not made.is_dir():
        words = ["simulate", made, "--photos", 15, "--size", "400x300", "--quiet"]
        assert run(ROOT / "src", "-m", "skyquilt", *words)[0] == 0
    flight = sorted((made / "photos").glob("*.jpg"))[:6]
    parts = {
        "photos": lambda folder: photos(source, folder),
        "side": lambda folder: side_files(source, folder, flight),
        "folders": lambda _: folders(source, flight),
        "images": lambda _: requests(source, flight, images),
        "requests": lambda _: requests(source, flight, others),
    }
    print("| attack | what it gets | s | MB |\n|---|---|---|---|")
    for name, part in parts.items():
        if asked.only in (None, name):
            with tempfile.TemporaryDirectory(prefix="skyquilt-attack-") as folder:
                part(Path(folder))


if __name__ == "__main__":
    main()
