"""Measures CPU seconds, wall seconds and peak memory of this process, or of another one and
its children.
"""

import os
import platform
import resource
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import rasterio


@dataclass(frozen=True)
class Cost:
    """Seconds of several runs; CPU is user + system, of all threads or of all child processes."""

    cpu_median: float
    cpu_min: float
    cpu_max: float
    wall_median: float
    runs: int
    peak_mb: float | None = None

    @classmethod
    def of(cls, cpu: list[float], wall: list[float], peak_mb: float | None = None) -> "Cost":
        """From the figures of each run."""
        return cls(
            statistics.median(cpu), min(cpu), max(cpu), statistics.median(wall), len(cpu), peak_mb
        )


def cpu_seconds(who: int = resource.RUSAGE_SELF) -> float:
    usage = resource.getrusage(who)
    return usage.ru_utime + usage.ru_stime


def measure(work: Callable[[], None], runs: int) -> Cost:
    """Warm up once, then measure in this process."""
    work()
    cpu, wall = [], []
    for _ in range(runs):
        before, start = cpu_seconds(), time.perf_counter()
        work()
        cpu.append(cpu_seconds() - before)
        wall.append(time.perf_counter() - start)
    return Cost.of(cpu, wall)


def run_process(command: list[str]) -> tuple[float, float, float]:
    """(CPU s, wall s, peak MB) of a command and everything it starts; ends this program if it
    fails.
    """
    # an installed program is compiled; where nothing may be written, each run compiles it again
    env = {name: v for name, v in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    before, start = cpu_seconds(resource.RUSAGE_CHILDREN), time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=env)
    peak = [0.0]
    watcher = threading.Thread(target=_watch, args=(process, peak), daemon=True)
    watcher.start()
    code = process.wait()
    wall = time.perf_counter() - start
    watcher.join()
    if code:
        sys.exit(f"{' '.join(command[3:])} ended with exit code {code}")
    return cpu_seconds(resource.RUSAGE_CHILDREN) - before, wall, peak[0]


def _watch(process: "subprocess.Popen[bytes]", peak: list[float]) -> None:
    while process.poll() is None:
        peak[0] = max(peak[0], tree_rss_mb(process.pid))
        time.sleep(0.25)


def tree_rss_mb(root: int) -> float:
    """Memory of a process and all below it: proportional (shared pages once), else resident."""
    parents: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents.setdefault(int(fields[1]), []).append(int(stat.parent.name))
    total, todo = 0.0, [root]
    while todo:
        pid = todo.pop()
        todo += parents.get(pid, [])
        total += _pss_kb(pid) / 1024
    return total


def _pss_kb(pid: int) -> float:
    for name, key in (("smaps_rollup", "Pss:"), ("status", "VmRSS:")):
        try:
            text = Path(f"/proc/{pid}/{name}").read_text()
        except OSError:
            continue
        for line in text.splitlines():
            if line.startswith(key):
                return float(line.split()[1])
    return 0.0


def machine() -> dict[str, str | int | float | None]:
    """Where and with what it was measured."""
    names = [line for line in _read("/proc/cpuinfo").splitlines() if line.startswith("model name")]
    git = shutil.which("git")
    found = (
        [git, "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"] if git else ["true"]
    )
    return {
        "cpu": names[0].partition(": ")[2] if names else platform.processor(),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "commit": subprocess.run(found, capture_output=True, text=True, check=False).stdout.strip(),
        "gdal": rasterio.__gdal_version__,
        "opencv": cv2.__version__,
    }


def _read(path: str) -> str:
    return Path(path).read_text() if Path(path).exists() else ""
