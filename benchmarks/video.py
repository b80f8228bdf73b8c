"""Maps of simulated clips against those of photos of the same flight, and what looking costs.

    python benchmarks/video.py WORK [--seeds 1,2]
    python benchmarks/video.py WORK --long 3600
    python benchmarks/video.py WORK --clip LONG.MP4
    python benchmarks/video.py WORK --cost FLIGHT.MP4

The first makes, for each seed, a flight of about 60 s (two lines and a turn, 1280 x 960, 5
frames a second, gusts that blur, MPEG-4) and prints seams of both maps, frames used against
those the overlap needs, blurred frames among them, errors of the camera positions, and the
offset found where the telemetry is 7 s late. The second looks through a 4K clip of that many
seconds (a short one again and again) and prints CPU per look beside decoding, and memory. The third
does so with a clip of any length and codec, chooses its frames, and fetches some of them.
The last one maps a clip, and the frames that were used as photos, and compares the CPU time of both
without that of decoding the clip once and of 30 ms a look.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from skyquilt.engine.clock import result_of
from skyquilt.engine.store import Store
from skyquilt.settings import InputSettings
from skyquilt.video.decoder import Decoder
from skyquilt.video.looks import Looker
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.clip_frames import with_frames
from skyquilt.workflows.photo_features import pixels_of
from skyquilt.workflows.survey_input import read_input

FLIGHT = "--photos 18 --sidelap 40 --speed 4.8 --size 1280x960 --video 5 --gust-blur 9 --quiet"
LATE_S = 7.0


def skyquilt(*words: str) -> None:
    """Runs a command."""
    subprocess.run([sys.executable, "-m", "skyquilt", *words], check=True)


def flight(work: Path, seed: int) -> None:
    """One row of the table."""
    home = work / f"flight-{seed}"
    if not (home / "truth" / "truth.json").is_file():
        skyquilt("simulate", str(home), *FLIGHT.split(), "--seed", str(seed), "--overwrite")
    made = {}
    for what in ("photos", "video"):
        out = work / f"map-{what}-{seed}"
        skyquilt("mosaic", str(home / what), "-o", str(out), "--overwrite", "--quiet")
        made[what] = json.loads((out / "metrics.json").read_text())
    truth = json.loads((home / "truth" / "truth.json").read_text())
    frames = truth["clips"][0]["frames"]
    fps, clip = truth["clips"][0]["fps"], made["video"]["clips"][0]
    used = [round(f["time_s"] * fps) for f in clip["frames"]]
    places = np.array([f["position"] for f in frames])
    lens = truth["cameras"]["visible"]
    high = places[0, 2] - truth["vertical"]["takeoff_m"]
    step = (1 - clip["overlap_wanted"]) * high * lens["height"] / lens["focal"]
    need = 1 + float(np.hypot(*np.diff(places[:, :2], axis=0).T).sum()) / step
    seams = [made[w]["seam_disparity_px"]["median"] for w in ("photos", "video")]
    print(
        f"seed {seed}: seams {seams[1]:.3f} px, of photos {seams[0]:.3f}"
        f" ({seams[1] / seams[0]:.2f});"
        f" frames {len(used)}, needed {need:.1f} ({len(used) / need:.2f});"
        f" blurred {sum(frames[i]['blurred'] for i in used)};"
        f" position error {position_error(work / f'map-video-{seed}', places):.2f} m;"
        f" {LATE_S:g} s late: found {late(work, home, seed)}"
    )


def position_error(folder: Path, places: np.ndarray) -> float:
    """Root mean square error of the cameras' positions across, without their common shift, m."""
    shots = json.loads((folder / "shots.geojson").read_text())["features"]
    off = np.array(
        [
            np.array(s["properties"]["translation"][:2])
            - places[int(s["properties"]["filename"].rsplit(".", 1)[1]), :2]
            for s in shots
        ]
    )
    return float(np.sqrt(((off - off.mean(axis=0)) ** 2).sum(axis=1).mean()))


def late(work: Path, home: Path, seed: int) -> str:
    """The offset found where the telemetry is late."""
    folder = work / f"late-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    clip = folder / "FLIGHT.MP4"
    clip.unlink(missing_ok=True)
    clip.symlink_to((home / "video" / "FLIGHT.MP4").resolve())
    text = (home / "video" / "FLIGHT.SRT").read_text()
    lines = [delayed(line) if "-->" in line else line for line in text.splitlines()]
    clip.with_suffix(".SRT").write_text("\n".join(lines) + "\n")
    settings, store = InputSettings(), Store(folder=work / "looks", registry=REGISTRY)
    told = result_of(with_frames(read_input(clip, settings), settings, store)).clips[0]
    return f"{told.offset_s:.2f} +- {told.offset_sigma_s or 0:.2f} ({told.offset_source})"


def delayed(line: str) -> str:
    """A line of times, `LATE_S` later."""

    def later(stamp: str) -> str:
        hours, minutes, seconds = stamp.strip().replace(",", ".").split(":")
        ms = round(1000 * (int(hours) * 3600 + int(minutes) * 60 + float(seconds) + LATE_S))
        clock = f"{ms // 3600000:02d}:{ms // 60000 % 60:02d}:{ms // 1000 % 60:02d}"
        return f"{clock},{ms % 1000:03d}"

    a, b = line.split("-->")
    return f"{later(a)} --> {later(b)}"


def long(work: Path, seconds: float) -> None:
    """Cost of a long clip."""
    clip = work / "4k.mp4"
    size, fps = (3840, 2160), 30.0
    if not clip.is_file():
        rng = np.random.default_rng(0)
        small = rng.integers(0, 255, (700, 1300, 3), dtype=np.uint8)
        ground = cv2.GaussianBlur(cv2.resize(small, (7800, 4200)), (0, 0), 1.2)
        code = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(clip), cv2.CAP_FFMPEG, code, fps, size)
        for i in range(300):
            x = 1500 + int(1400 * np.sin(i / 48))
            writer.write(np.ascontiguousarray(ground[900 : 900 + size[1], x : x + size[0]]))
        writer.release()
    started, frames = time.process_time(), 0
    decoder = Decoder(clip)
    while decoder.skip():
        frames += 1
    decoding = (time.process_time() - started) / frames
    started, looks, decoded = time.process_time(), 0, 0
    while decoded < seconds * fps:
        for step in Looker()(Decoder(clip, grey=True), 0, last=None, open_end=True):
            if not isinstance(step, int):
                looks += len(step.time_s)
        decoded += frames
    spent = time.process_time() - started - decoding * decoded
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{decoded / fps:.0f} s of 4K: decoding {1000 * decoding:.1f} ms of CPU a frame; {looks}"
        f" looks, {1000 * spent / looks:.1f} ms of CPU each beside it; {peak:.0f} MB at most"
    )


def cost(clip: Path, work: Path) -> None:
    """A clip's map against that of the same frames as photos."""
    decoder, started, frames = Decoder(clip), time.process_time(), 0
    while decoder.skip():
        frames += 1
    decoding = time.process_time() - started
    decoder.close()
    skyquilt("mosaic", str(clip), "-o", str(work / "once"), "--write-frames", "--overwrite", "-q")
    photos = sorted((work / "once" / "frames").iterdir())
    spent: dict[str, list[float]] = {"clip": [], "photos": []}
    for _ in range(2):
        for what, source in (("clip", clip), ("photos", work / "once" / "frames")):
            shutil.rmtree(work / what, ignore_errors=True)  # a finished run is not repeated
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            skyquilt("mosaic", str(source), "-o", str(work / what), "--overwrite", "-q")
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            user, system = after.ru_utime - before.ru_utime, after.ru_stime - before.ru_stime
            spent[what].append(user + system)
    looks = json.loads((work / "clip" / "metrics.json").read_text())["clips"][0]["frames_looked_at"]
    whole_, plain = min(spent["clip"]), min(spent["photos"])
    rest = whole_ - decoding - 0.03 * looks
    print(
        f"{clip.name}: {frames} frames, {looks} looks, {len(photos)} used; map from the clip"
        f" {whole_:.1f} s of CPU, decoding once {decoding:.1f} s, looks at 30 ms {0.03 * looks:.1f}"
        f" s, the rest {rest:.1f} s; map from these frames as photos {plain:.1f} s"
        f" ({rest / plain:.2f})"
    )


def whole(clip: Path, work: Path) -> None:
    """Cost of a clip as `mosaic` meets it: looks, choice, and the frames it uses."""
    decoder, started, decoded = Decoder(clip), time.process_time(), 0
    while decoded < 1500 and decoder.skip():
        decoded += 1
    decoding = (time.process_time() - started) / decoded
    decoder.close()
    settings, store = InputSettings(), Store(folder=work / "looks", registry=REGISTRY)
    started, clock = time.process_time(), time.monotonic()
    survey = result_of(with_frames(read_input(clip, settings), settings, store))
    told, photos = survey.clips[0], survey.survey.photos
    spent = time.process_time() - started - decoding * survey.survey.photos[-1].frame_s * told.fps
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{clip.name}: decoding {1000 * decoding:.1f} ms of CPU a frame; {told.looked} looks,"
        f" {1000 * spent / told.looked:.1f} ms of CPU each beside it; {len(photos)} frames chosen;"
        f" {time.monotonic() - clock:.0f} s; {peak:.0f} MB at most"
    )
    several = photos[: min(40, len(photos))]
    cost = []
    for _ in range(2):
        started = time.process_time()
        for photo in several:
            pixels_of(photo, store)
        cost.append((time.process_time() - started) / len(several))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    kept = sum(p.stat().st_size for p in (work / "looks").rglob("*.npz")) / 1e6 / len(several)
    print(
        f"a frame from the clip {cost[0]:.3f} s of CPU, again {cost[1]:.3f} s; {kept:.1f} MB each"
        f" in the store; {peak:.0f} MB at most"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", default="1")
    parser.add_argument("--long", type=float)
    parser.add_argument("--clip", type=Path)
    parser.add_argument("--cost", type=Path)
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    if given.cost:
        cost(given.cost, given.work)
    elif given.clip:
        whole(given.clip, given.work)
    elif given.long:
        long(given.work, given.long)
    else:
        for number in given.seeds.split(","):
            flight(given.work, int(number))
