"""What a survey costs on many workers: a simulation of the scheduler with measured task times.

    python benchmarks/scale_plan.py measure PHOTOS FILE.json [-- --gsd 3]
    python benchmarks/scale_plan.py plan FILE.json [--photos 10000,100000] [--workers 1,10,1000]
    python benchmarks/scale_plan.py check PHOTOS FILE.json [--workers 2] [-- --gsd 3]

`measure` maps a survey in one thread and writes down every task that workers can take (its CPU
time and the bytes of its result), and what is left for the process of the command. `plan`
simulates `--scheduler` with these: tasks are handed out one after another, at most AHEAD for each
worker, and results are taken in order. `check` runs the command with local workers and prints its
wall time beside the simulated one (on a machine that does nothing else).

Surveys of other sizes: tasks and the rest grow with the number of photos; the factor of the joint
adjustment with its power of 1.5, and the memory of the adjustment as docs/scale.md says.
"""

import argparse
import heapq
import json
import pickle
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from cost import machine, run_process
from floor import COMMAND

from skyquilt.engine.cluster import AHEAD
from skyquilt.engine.workers import HERE
from skyquilt.model.event import Note, StageFinished, StageStarted
from skyquilt.settings import MosaicSettings
from skyquilt.workflows import mosaic
from skyquilt.workflows.flow import ADJUSTED_GB, ADJUSTED_PHOTO_GB

HANDED_S, TAKEN_S = 0.0015, 0.0018
"""CPU seconds of the command's process to hand out a task and to take a small result."""
TAKEN_BYTES_S = 0.5e9
"""Bytes of results that it takes per second."""
START_S = 4.0
"""Seconds until workers are there."""
FACTOR_S, FACTORS, FACTOR_PHOTOS = 0.08, 43, 500
"""Seconds of one factor of the adjustment's matrix, and how often, for so many photos."""
MOST = 20_000
"""Tasks simulated of a stage; more go on at the rate of these."""


@dataclass
class Recorder:
    """One thread that writes down what it does, as `engine.workers.Workers`."""

    stage: str = ""
    apart: bool = True
    handed: int = 0
    tasks: dict[str, list[tuple[float, int]]] = field(default_factory=lambda: defaultdict(list))
    weighing: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """CPU seconds taken to find the size of results, by stage."""

    def each(self, work: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        for item in items:
            began = time.thread_time()
            result = work(item)
            spent = time.thread_time() - began
            self.tasks[self.stage].append((spent, len(pickle.dumps(result, protocol=5))))
            self.weighing[self.stage] += time.thread_time() - began - spent
            yield result

    def news(self) -> Sequence[Note]:
        return HERE.news()


def main() -> int:
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    for kind in ("measure", "check", "plan"):
        asked = kinds.add_parser(kind)
        if kind != "plan":
            asked.add_argument("photos_folder", type=Path)
        asked.add_argument("file", type=Path)
        if kind == "plan":
            asked.add_argument("--photos", default="10000,100000,1000000")
        if kind != "measure":
            asked.add_argument("--workers", default="2" if kind == "check" else "1,10,1000")
    options = parser.parse_args(words[:cut])
    if options.kind == "measure":
        record = measured(options.photos_folder, words[cut + 1 :])
        options.file.write_text(json.dumps(record))
        shares(record)
        return 0
    record = json.loads(options.file.read_text())
    workers = [int(w) for w in options.workers.split(",")]
    if options.kind == "plan":
        plan(record, [int(n) for n in options.photos.split(",")], workers)
    else:
        for number in workers:
            check(options.photos_folder, record, number, words[cut + 1 :])
    return 0


def measured(photos: Path, words: list[str]) -> dict[str, Any]:
    """Tasks and other CPU time of each stage of a map of these photos, made in one thread."""
    recorder, cpu = Recorder(), dict[str, float]()

    @contextmanager
    def recording(*_: Any) -> Iterator[Recorder]:
        yield recorder

    mosaic.workers_for = recording  # type: ignore[assignment]
    settings = dict(zip((w.removeprefix("--") for w in words[::2]), words[1::2], strict=True))
    gsd = float(settings["gsd"]) if "gsd" in settings else None
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        for event in mosaic.iter_mosaic(photos, out, MosaicSettings(gsd_cm=gsd, jobs=1)):
            if isinstance(event, StageStarted):
                recorder.stage = event.stage
            if isinstance(event, StageFinished):
                cpu[event.stage] = event.cpu_seconds
        stored = sum(p.stat().st_size for p in out.rglob("*") if p.is_file())
        metrics = json.loads((out / "metrics.json").read_text())
    read = sum(p.stat().st_size for p in photos.rglob("*") if p.is_file())
    tasks = {stage: recorder.tasks.get(stage, []) for stage in cpu}
    rest = {
        stage: max(cpu[stage] - recorder.weighing[stage] - sum(s for s, _ in tasks[stage]), 0.0)
        for stage in cpu
    }
    return {
        "machine": machine(),
        "photos": metrics["photos_total"],
        "tasks": tasks,
        "rest": rest,
        "bytes_read": read,
        "bytes_stored": stored,
    }


def shares(record: dict[str, Any]) -> None:
    """Prints what can be shared out, by stage."""
    print(", ".join(f"{k} {v}" for k, v in record["machine"].items()))
    print("| stage | tasks | CPU s each, median / most | shared out, s | not, s | results, MB |")
    print("|---|---|---|---|---|---|")
    for stage, tasks in record["tasks"].items():
        times = [s for s, _ in tasks] or [0.0]
        moved = sum(b for _, b in tasks) / 1e6
        print(
            f"| {stage} | {len(tasks)} | {np.median(times):.3f} / {max(times):.3f} |"
            f" {sum(times):.1f} | {record['rest'][stage]:.1f} | {moved:.0f} |"
        )
    out = sum(s for tasks in record["tasks"].values() for s, _ in tasks)
    print(f"shared out {out:.0f} s of {out + sum(record['rest'].values()):.0f} s")


def stage_s(tasks: list[tuple[float, int]], number: float, workers: int, seed: int) -> float:
    """Wall seconds until `workers` have done `number` tasks like these and their results were taken
    in order.
    """
    if not tasks or number < 1:
        return 0.0
    count = int(min(number, MOST))
    chosen = np.random.default_rng(seed).integers(0, len(tasks), count)
    free = [0.0] * workers
    heapq.heapify(free)
    boss, window = 0.0, AHEAD * workers
    ready: list[float] = []
    for k in range(count + window):
        if k >= window and k - window < len(ready):  # the boss takes a result before it hands out
            bytes_ = tasks[chosen[k - window]][1]
            boss = max(boss, ready[k - window]) + TAKEN_S + bytes_ / TAKEN_BYTES_S
        if k < count:
            boss += HANDED_S
            begun = max(boss, heapq.heappop(free))
            heapq.heappush(free, begun + tasks[chosen[k]][0])
            ready.append(begun + tasks[chosen[k]][0])
    return boss * number / count


def wall_s(record: dict[str, Any], photos: float, workers: int) -> dict[str, float]:
    """Simulated wall seconds of each stage."""
    scale = photos / record["photos"]
    factor = FACTOR_S * FACTORS
    out = {}
    for seed, (stage, tasks) in enumerate(record["tasks"].items()):
        rest = record["rest"][stage]
        if stage == "align":
            own = min(rest, factor * (record["photos"] / FACTOR_PHOTOS) ** 1.5)
            rest = (rest - own) * scale + factor * (photos / FACTOR_PHOTOS) ** 1.5
        else:
            rest *= scale
        out[stage] = stage_s(tasks, len(tasks) * scale, workers, seed) + rest
    return out


def plan(record: dict[str, Any], photos: list[int], workers: list[int]) -> None:
    """Prints what surveys of these sizes cost on so many workers."""
    columns = " | ".join(f"{w:,} workers" for w in workers)
    print(f"| photos | GB read, stored | GB of the adjustment | {columns} |")
    print("|---" * (3 + len(workers)) + "|")
    each = (record["bytes_read"] / record["photos"], record["bytes_stored"] / record["photos"])
    for number in photos:
        times = []
        for count in workers:
            stages = wall_s(record, number, count)
            total, longest = sum(stages.values()), max(stages, key=lambda s: stages[s])
            times.append(f"{total / 3600:.1f} h ({longest} {100 * stages[longest] / total:.0f} %)")
        moved = " + ".join(f"{b * number / 1e9:,.0f}" for b in each)
        memory = ADJUSTED_GB + ADJUSTED_PHOTO_GB * number
        print(f"| {number:,} | {moved} | {memory:,.1f} | {' | '.join(times)} |")


def check(photos: Path, record: dict[str, Any], workers: int, words: list[str]) -> None:
    """Prints the wall time with local workers, that of one thread, and the simulated ones."""
    walls = []
    for extra in (["--jobs", "1"], ["--scheduler", f"local:{workers}"]):
        folder = Path(tempfile.mkdtemp())
        told = ["mosaic", str(photos), "-o", str(folder / "out"), "--quiet", *words, *extra]
        _, wall, _ = run_process([sys.executable, "-c", COMMAND, *told])
        walls.append(wall)
        shutil.rmtree(folder)
    alone = sum(sum(s for s, _ in t) for t in record["tasks"].values()) + sum(
        record["rest"].values()
    )
    simulated = START_S + sum(wall_s(record, record["photos"], workers).values())
    print(
        f"one thread {walls[0]:.1f} s (recorded {alone:.1f}); {workers} workers {walls[1]:.1f} s,"
        f" simulated {simulated:.1f} s; efficiency {walls[0] / walls[1] / workers:.2f}"
    )


if __name__ == "__main__":
    raise SystemExit(main())
