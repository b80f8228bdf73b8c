"""CPU time and memory per photo and stage, for surveys of different sizes.

python benchmarks/scale.py FOLDER ...  [--runs 1] [--keep OUT] [-- --gsd 3]

Each folder of photos is mapped by `skyquilt mosaic` in a process of its own, into an empty folder.
Two surveys or more give the exponent with which each stage's time grows with the number of photos.
`benchmarks/large_flight.py` simulates surveys of any size. Words after `--` are passed to
`skyquilt mosaic`.
"""

import argparse
import json
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from cost import machine, run_process
from floor import COMMAND


def one_run(photos: Path, words: list[str], keep: Path | None) -> dict[str, Any]:
    """Metrics of a run, with the CPU seconds and the peak of its process."""
    with tempfile.TemporaryDirectory() as folder:
        out = keep or Path(folder) / "out"
        command = ["mosaic", str(photos), "-o", str(out), "--overwrite", "--quiet", *words]
        cpu, wall, peak = run_process([sys.executable, "-c", COMMAND, *command])
        found: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return found | {"cpu": cpu, "wall": wall, "peak": peak}


def table(photos: Path, runs: list[dict[str, Any]]) -> tuple[int, dict[str, float]]:
    """Prints a survey's table; returns the number of photos and the CPU seconds of each stage."""
    first = runs[0]
    total, used = first["photos_total"], first["photos_used"]
    error, blocks = first["reprojection_error_px"], first["blocks"]
    number = blocks if isinstance(blocks, int) else len(blocks)
    print(f"\n{photos}: {used} of {total} photos, {number} block(s), {error} px")
    print("| stage | CPU s | CPU s a photo | peak MB so far |\n|---|---|---|---|")
    stages = {
        s: statistics.median(r["cpu_seconds_of_stage"][s] for r in runs)
        for s in first["cpu_seconds_of_stage"]
    }
    for stage, cpu in stages.items():
        peak = max(r["peak_memory_mb_of_stage"].get(stage, 0.0) for r in runs)
        print(f"| {stage} | {cpu:.1f} | {cpu / total:.4f} | {peak:.0f} |")
    cpu, peak = statistics.median(r["cpu"] for r in runs), max(r["peak"] for r in runs)
    wall = statistics.median(r["wall"] for r in runs)
    print(f"| all | {cpu:.1f} | {cpu / total:.4f} | {peak:.0f} |")
    print(f"wall {wall:.0f} s, {len(runs)} run(s)")
    return total, stages | {"all": cpu}


def exponents(found: list[tuple[int, dict[str, float]]]) -> None:
    """Prints how each stage's time grows with the number of photos."""
    numbers = np.log([n for n, _ in found])
    print("\n| stage | exponent |\n|---|---|")
    for stage in found[0][1]:
        seconds = np.log([max(s.get(stage, 0.0), 1e-3) for _, s in found])
        print(f"| {stage} | {np.polyfit(numbers, seconds, 1)[0]:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", type=Path, nargs="+")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder in which the last map stays")
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    asked, words = parser.parse_args(sys.argv[1:split]), sys.argv[split + 1 :]
    print(machine())
    found = [
        table(photos, [one_run(photos, words, asked.keep) for _ in range(asked.runs)])
        for photos in asked.photos
    ]
    if len(found) > 1:
        exponents(found)


if __name__ == "__main__":
    main()
