"""A campaign against crashes: kills, power cuts, fuzzed inputs, and a soak. It takes hours, goes on
over several calls, and keeps its progress in a file.

python benchmarks/campaign.py FOLDER                      everything, in turns
python benchmarks/campaign.py FOLDER kills mosaic --minutes 20
python benchmarks/campaign.py FOLDER --table              what was reached so far, as Markdown

Parts: `kills` (live, at random moments and named points, with torn, short, failed and delayed
writes), `power` (power cuts of live at named points: what was not synced is dropped), `mosaic`
(kills of mosaic), `fuzz` (fuzzed inputs of all readers), `soak` (live at 2 photos/s with a clock
that jumps, a disk that is full now and then, an inbox that goes away and comes back).
"""

import argparse
import errno
import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GOALS = {"kills": 1000, "power": 200, "mosaic": 200, "fuzz": 1_000_000, "soak": 7200}
"""What the campaign is to reach: runs, inputs, and seconds of the soak."""
OFTEN = 6
"""Kills that one survey meets."""
FAULTS = ("none", "torn", "short", "failed", "delayed")
PHOTOS = 6


# -- progress


class Progress:
    """What was tried and found, in a file that is replaced as a whole."""

    def __init__(self, folder):
        self.path = folder / "progress.json"
        self.found = json.loads(self.path.read_text()) if self.path.exists() else {}

    def add(self, part, **numbers):
        """Adds numbers to a part; those that begin with `most_` keep the largest."""
        row = self.found.setdefault(part, {"tried": 0, "lost": 0, "tracebacks": 0})
        for key, value in numbers.items():
            old = row.get(key, 0)
            row[key] = max(old, value) if key.startswith("most_") else old + value
        fresh = self.path.with_suffix(".new")
        fresh.write_text(json.dumps(self.found, indent=1))
        fresh.replace(self.path)

    def tried(self, part):
        return self.found.get(part, {}).get("tried", 0)

    def note(self, part, text):
        with (self.path.parent / "notes.txt").open("a") as file:
            file.write(f"{time.strftime('%F %T')} {part}: {text[-4000:]}\n")

    def table(self):
        lines = [
            "| part | tried | of | lost | unexplained tracebacks | longest | largest memory |",
            "|---|---|---|---|---|---|---|",
        ]
        for part, goal in GOALS.items():
            row = self.found.get(part)
            if row:
                pause, memory = row.get("most_pause_s"), row.get("most_mb")
                lines.append(
                    f"| {part} | {row['tried']:.0f} | {goal} | {row['lost']} | {row['tracebacks']}"
                    f" | {'' if pause is None else f'{pause:.1f} s'}"
                    f" | {'' if memory is None else f'{memory:.0f} MB'} |"
                )
        return "\n".join(lines)


def flight(folder):
    """Photos of a small simulated flight, made once."""
    made = folder / "flight"
    if not (made / "photos").is_dir():
        command = [sys.executable, "-m", "skyquilt", "simulate", str(made), "--photos", "15"]
        subprocess.run([*command, "--size", "400x300", "--overwrite"], check=True, env=env())
    chosen = folder / "photos"
    if not chosen.is_dir():
        chosen.mkdir()
        for path in sorted((made / "photos").glob("*.jpg"))[:PHOTOS]:
            shutil.copyfile(path, chosen / path.name)
    return chosen


def env():
    paths = os.pathsep.join([*filter(None, [os.environ.get("PYTHONPATH")]), str(ROOT / "src")])
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": paths}


def child(*words, timeout=300):
    """Runs a part of this program in a process of its own; returns it, and its time and memory."""
    began = time.monotonic()
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    done = subprocess.run(
        [sys.executable, __file__, *map(str, words)],
        env=env(),
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return done, time.monotonic() - began, max(before, after) / 1024


# -- live, killed


def live_child(out, photos, point, count, fault, cut=""):
    """Maps the photos; dies at a point, or at a moment in ms; else prints the poses."""
    from skyquilt.live import inbox
    from skyquilt.live import ledger as points
    from skyquilt.live.folder_watch import Watch
    from skyquilt.live.live_map import LiveMap
    from skyquilt.live.settings import LiveSettings

    def die(*_):
        os.kill(os.getpid(), signal.SIGKILL)

    out, rng, left = Path(out), random.Random(f"{point}{count}{fault}"), [int(count)]
    synced = Synced(out) if cut else None

    def watcher(name):
        if fault == "delayed":
            time.sleep(rng.random() * 0.05)
        left[0] -= name == point
        if name == point and left[0] == 0:
            if synced is not None:
                synced.copy(Path(cut))
            die()

    points.watcher = watcher
    if point == "time":
        signal.signal(signal.SIGALRM, die)
        signal.setitimer(signal.ITIMER_REAL, int(count) / 1000)
    honest = inbox.Inbox.bring
    tries = [0]

    def bring(self, blocks):
        tries[0] += 1
        blocks = list(blocks)
        if fault in ("torn", "short") and tries[0] == 2:
            size = 1000 if fault == "torn" else len(blocks[0]) - 1
            (self.folder / "torn.partial").write_bytes(blocks[0][:size])
            die()
        if fault == "failed" and tries[0] in (2, 3):
            from skyquilt.errors import OutputError

            raise OutputError("the disk is full (made up)") from OSError(errno.ENOSPC, "full")
        return honest(self, blocks)

    inbox.Inbox.bring = bring
    live = LiveMap(out, LiveSettings(deterministic=True, features=600))
    watch = Watch(folder=Path(photos), intake=live.intake)
    names = sorted(p.name for p in Path(photos).glob("*.jpg"))
    while True:
        try:
            for _ in watch.look():
                break
            if live.work() is not None:
                continue
        except Exception as error:
            from skyquilt.errors import OutputError

            if not isinstance(error, OutputError):
                raise
            continue
        count_ = live.ledger.row("select count(*) from photo")[0]
        if count_ >= len(names) and live.work() is None:
            break
        time.sleep(0.01)
    signal.setitimer(signal.ITIMER_REAL, 0)
    poses = {
        m.photo.name: [m.pose.map_C.tolist(), m.pose.cam_R_map.tolist()]
        for m in live.members.on_map()
    }
    files = live.ledger.rows("select file, digest from photo")
    for name, digest in files:  # what was accepted is there, whole
        body = (out / "photos" / name).read_bytes()
        assert hashlib.blake2b(body, digest_size=16).hexdigest() == digest
    failed = (out / "errors.log").exists()
    sys.stdout.write(json.dumps({"poses": poses, "states": live.ledger.counts(), "log": failed}))
    live.close()


class Synced:
    """Which files would survive a power cut: those that were synced, under names that were."""

    def __init__(self, out):
        self.out, self.sizes, self.names = out, {}, set()
        honest = os.fsync

        def fsync(handle):
            honest(handle)
            path = Path(f"/proc/self/fd/{handle}").readlink()
            if path.is_dir():
                for entry in os.scandir(path):
                    self.names.add((str(path / entry.name), entry.inode()))
            else:
                status = os.fstat(handle)
                self.sizes[status.st_ino] = status.st_size

        os.fsync = fsync

    def copy(self, target):
        """The folder after the cut. SQLite keeps its own promises, so its files are copied."""
        shutil.rmtree(target, ignore_errors=True)
        (target / "photos").mkdir(parents=True)
        for path in self.out.glob("*.db*"):
            shutil.copyfile(path, target / path.name)
        for path in (self.out / "photos").iterdir():
            inode = path.stat().st_ino
            earlier = (self.out / ".kept" / path.name).exists()
            if earlier or (str(path), inode) in self.names:
                size = None if earlier else self.sizes.get(inode, 0)
                (target / "photos" / path.name).write_bytes(path.read_bytes()[:size])


def reference(folder, photos):
    """What an undisturbed run gives, and how long it takes."""
    path = folder / "reference.json"
    if not path.exists():
        shutil.rmtree(folder / "undisturbed", ignore_errors=True)
        done, seconds, _ = child("--live", folder / "undisturbed", photos, "", 0, "none")
        assert done.returncode == 0, done.stderr
        path.write_text(json.dumps({"out": json.loads(done.stdout), "seconds": seconds}))
    return json.loads(path.read_text())


def judged(progress, part, done, wanted, pause, memory):
    """Counts a run that was allowed to end."""
    lost = done.returncode != 0 or json.loads(done.stdout) != wanted["out"]
    unexplained = int(done.returncode not in (0, -9)) + int('"log": true' in done.stdout)
    if lost or unexplained:
        progress.note(part, done.stderr or done.stdout)
    progress.add(
        part,
        lost=int(lost),
        tracebacks=unexplained,
        ended=1,
        most_pause_s=round(pause, 1),
        most_mb=round(memory),
    )


def kills(folder, progress, until):
    photos = flight(folder)
    wanted = reference(folder, photos)
    from skyquilt.live.ledger import POINTS

    rng = random.Random()
    while time.monotonic() < until and progress.tried("kills") < GOALS["kills"]:
        out = folder / "killed"
        shutil.rmtree(out, ignore_errors=True)
        for _ in range(OFTEN):
            fault = rng.choice(FAULTS)
            point, count = rng.choice(POINTS[:8]), rng.randint(1, 2)
            if rng.random() < 0.5:
                point, count = "time", int(1000 * wanted["seconds"] * rng.uniform(0.1, 0.5))
            done, seconds, memory = child("--live", out, photos, point, count, fault)
            if done.returncode == -9:
                progress.add("kills", tried=1, most_mb=round(memory))
            elif done.returncode != 0:
                progress.add("kills", tracebacks=1)
                progress.note("kills", f"{point} {count} {fault}: {done.stderr}")
            else:
                break
        if done.returncode != 0:
            done, seconds, memory = child("--live", out, photos, "", 0, "none")
        judged(progress, "kills", done, wanted, seconds, memory)


def power(folder, progress, until):
    photos = flight(folder)
    wanted = reference(folder, photos)
    from skyquilt.live.ledger import POINTS

    rng = random.Random()
    while time.monotonic() < until and progress.tried("power") < GOALS["power"]:
        out, cut = folder / "powered", folder / "cut"
        shutil.rmtree(out, ignore_errors=True)
        point, count = rng.choice(POINTS[:8]), rng.randint(1, PHOTOS)
        done, _, _ = child("--live", out, photos, point, count, "none", cut)
        if done.returncode != -9:
            continue
        progress.add("power", tried=1)
        done, seconds, memory = child("--live", cut, photos, "", 0, "none")
        judged(progress, "power", done, wanted, seconds, memory)


# -- mosaic, killed


def mosaic_digest(out):
    found = hashlib.blake2b((out / "mosaic.tif").read_bytes()).hexdigest()
    assert json.loads((out / "metrics.json").read_text())["photos_used"] == PHOTOS
    return found


def mosaic(folder, progress, until):
    photos, whole = flight(folder), folder / "whole"
    command = [sys.executable, "-m", "skyquilt", "mosaic", str(photos), "--quiet", "-o"]
    if not (whole / "metrics.json").exists():
        began = time.monotonic()
        subprocess.run([*command, str(whole)], check=True, env=env())
        (folder / "whole.txt").write_text(str(time.monotonic() - began))
    seconds, wanted = float((folder / "whole.txt").read_text()), mosaic_digest(whole)
    rng = random.Random()
    while time.monotonic() < until and progress.tried("mosaic") < GOALS["mosaic"]:
        out = folder / "mosaic"
        shutil.rmtree(out, ignore_errors=True)
        for _ in range(OFTEN):
            running = subprocess.Popen([*command, str(out)], env=env(), stderr=subprocess.PIPE)
            try:
                running.wait(seconds * rng.uniform(0.15, 0.95))
                ended = running.returncode
            except subprocess.TimeoutExpired:
                running.kill()
                running.wait()
                ended = -9
            if ended == -9:
                progress.add("mosaic", tried=1)
            elif ended != 0:
                progress.add("mosaic", tracebacks=1)
                progress.note("mosaic", running.stderr.read().decode(errors="replace"))
            if ended == 0:
                break
        began = time.monotonic()
        done = subprocess.run([*command, str(out)], env=env(), capture_output=True, check=False)
        try:
            lost = done.returncode != 0 or mosaic_digest(out) != wanted
        except (OSError, ValueError, AssertionError):
            lost = True
        memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        progress.add(
            "mosaic",
            lost=int(lost),
            ended=1,
            most_pause_s=round(time.monotonic() - began, 1),
            most_mb=round(memory),
        )
        if lost:
            progress.note("mosaic", done.stderr.decode(errors="replace"))


# -- fuzzed inputs


def fuzz(folder, progress, until):
    """Mutated seeds, many thousands in a process, which says what it did when it ends."""
    while time.monotonic() < until and progress.tried("fuzz") < GOALS["fuzz"]:
        seed = random.randrange(10**9)
        done, _, memory = child("--fuzz", seed, 20, timeout=600)
        try:
            said = json.loads(done.stdout.splitlines()[-1])
        except (IndexError, ValueError):
            progress.add("fuzz", tracebacks=1)
            progress.note("fuzz", f"seed {seed}: {done.stderr}")
            continue
        progress.add(
            "fuzz",
            tried=said["tried"],
            tracebacks=said["failed"],
            most_pause_s=said["slowest_s"],
            most_mb=round(memory),
        )
        if said["failed"]:
            progress.note("fuzz", f"seed {seed}: {said['first']}")


def fuzz_child(seed, seconds):
    sys.path.insert(0, str(ROOT))
    from fuzz.mutations import mutated
    from fuzz.targets import TARGETS, prepare

    prepare("http")
    rng, until = random.Random(int(seed)), time.monotonic() + float(seconds)
    tried, failed, slowest, first = 0, 0, 0.0, ""
    names = list(TARGETS)
    while time.monotonic() < until:
        name = rng.choice(names)
        target = TARGETS[name]
        turn = time.monotonic() + 0.5
        while time.monotonic() < turn:
            data = mutated(rng.choice(target.seeds()), rng)
            began = time.monotonic()
            try:
                target.run(data)
            except Exception as error:  # whatever it is, it was not foreseen
                failed += 1
                first = first or f"{name}: {type(error).__name__}: {error}"
            slowest = max(slowest, time.monotonic() - began)
            tried += 1
    found = {"tried": tried, "failed": failed, "slowest_s": round(slowest, 2), "first": first}
    sys.stdout.write(json.dumps(found) + "\n")


# -- soak


def soak(folder, progress, until):
    """Live in one process, photos copied at 2 per second by this one."""
    photos, inbox, out = sorted(flight(folder).glob("*.jpg")), folder / "inbox", folder / "soaked"
    state = folder / "soak.json"
    sent = json.loads(state.read_text())["sent"] if state.exists() else 0
    inbox.mkdir(exist_ok=True)
    running = subprocess.Popen(
        [sys.executable, __file__, "--soak", str(inbox), str(out)],
        env=env(),
        stdout=subprocess.PIPE,
        stderr=(folder / "soak.err").open("a"),
        text=True,
    )
    latest = {}

    def listen():
        for line in running.stdout:
            latest.update(json.loads(line))

    threading.Thread(target=listen, daemon=True).start()
    began = last = time.monotonic()
    away = folder / "inbox-away"
    try:
        while time.monotonic() < until and progress.tried("soak") < GOALS["soak"]:
            if running.poll() is not None:
                progress.add("soak", tracebacks=1)
                progress.note("soak", "it ended")
                break
            elapsed = int(time.monotonic() - began)
            if elapsed % 120 in (60, 61, 62) and inbox.is_dir():
                inbox.rename(away)  # the disk was pulled out
            elif elapsed % 120 not in (60, 61, 62) and away.is_dir():
                away.rename(inbox)
            target = inbox if inbox.is_dir() else away
            body = moved(photos[sent % len(photos)].read_bytes(), sent // len(photos))
            (target / f"{sent:06d}.part").write_bytes(body)
            (target / f"{sent:06d}.part").rename(target / f"{sent:06d}.jpg")
            sent += 1
            state.write_text(json.dumps({"sent": sent}))
            time.sleep(max(0.0, 0.5 - (time.monotonic() - last)))
            now = time.monotonic()
            progress.add(
                "soak",
                tried=now - last,
                most_pause_s=latest.get("pause_s", 0),
                most_mb=latest.get("mb", 0),
            )
            last = now
        if away.is_dir():
            away.rename(inbox)
        waited = time.monotonic()  # what was sent last is taken
        while latest.get("photos", 0) < sent and time.monotonic() - waited < 120:
            time.sleep(0.5)
        missing = sent - latest.get("photos", 0)
        progress.add("soak", lost=missing if missing > 0 else 0, sent=0)
        if missing:
            progress.note("soak", f"{missing} of {sent} are missing: {latest}")
    finally:
        running.terminate()
        running.wait(300)  # it ends after the step at hand, however busy the machine is


def moved(body, lap):
    """The photo as if it were taken `lap` times 150 m further north, an hour later for each lap."""

    def shifted(found):
        value = float(found[2]) + lap * 150 / 111_320
        return found[1] + f"{value:+.{len(found[2].split(b'.')[1])}f}".encode() + found[3]

    body = re.sub(rb'(GpsLatitude=")([-+0-9.]+)(")', shifted, body)
    return body + b"%012d" % lap  # bytes after the end make another file


def soak_child(inbox, out):
    from skyquilt.live import inbox as inboxes
    from skyquilt.live.folder_watch import Watch
    from skyquilt.live.live_map import LiveMap
    from skyquilt.live.settings import LiveSettings
    from skyquilt.live.workflow import iter_live

    real, offset, start = time.time, [0.0], time.monotonic()
    time.time = lambda: real() + offset[0]
    honest = os.fsync

    def fsync(handle):
        if (time.monotonic() - start) % 90 > 86:
            raise OSError(errno.ENOSPC, "No space left on device")
        honest(handle)

    inboxes.os = type("Os", (), {**vars(os), "fsync": staticmethod(fsync)})
    rng, stop, live = random.Random(1), threading.Event(), LiveMap(Path(out), LiveSettings())
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    last, pause, told = time.monotonic(), 0.0, 0.0
    assert Watch
    for happened in iter_live([Path(inbox)], live, stop=stop):
        now = time.monotonic()
        waiting = len(live.queues.received) > 0
        pause, last = max(pause, now - last if waiting else 0.0), now
        if now - told > 2:
            told = now
            offset[0] = rng.choice((0.0, 0.0, 86400.0, -86400.0, 30 * 86400.0, offset[0]))
            mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            count = live.ledger.row("select count(*) from photo")[0]
            sys.stdout.write(
                json.dumps({"photos": count, "mb": round(mb), "pause_s": round(pause, 1)}) + "\n"
            )
            sys.stdout.flush()
        del happened
    live.close()


PARTS = {"kills": kills, "power": power, "mosaic": mosaic, "fuzz": fuzz, "soak": soak}


def main():
    inner = {"--live": live_child, "--fuzz": fuzz_child, "--soak": soak_child}
    if sys.argv[1:2] and sys.argv[1] in inner:
        inner[sys.argv[1]](*sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], default=list(PARTS))
    parser.add_argument("--minutes", type=float, default=10, help="for each part")
    parser.add_argument("--table", action="store_true")
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    progress = Progress(asked.folder)
    if not asked.table:
        for part in asked.parts or PARTS:
            PARTS[part](asked.folder, progress, time.monotonic() + 60 * asked.minutes)
    print(progress.table())


if __name__ == "__main__":
    main()
