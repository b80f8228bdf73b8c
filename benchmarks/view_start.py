"""How long `skyquilt view` takes until it answers its first request.

python benchmarks/view_start.py OUT [ROUNDS]

Prints the elapsed time, the CPU time, and how long the program waited for a core, which other work
on the machine causes. Linux only.
"""

import subprocess
import sys
import time
import urllib.request
from pathlib import Path


def start(output: str) -> tuple[float, float, float]:
    """Elapsed, computing and waiting seconds until the first answer."""
    began = time.perf_counter()
    command = [sys.executable, "-m", "skyquilt", "view", output, "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        address = process.stdout.readline().split()[0]
        urllib.request.urlopen(address).read()
        elapsed = time.perf_counter() - began
        tasks = Path(f"/proc/{process.pid}/task")
        rows = [(t / "schedstat").read_text().split() for t in tasks.iterdir()]
        first = (tasks / str(process.pid) / "schedstat").read_text().split()
        return elapsed, sum(int(r[0]) for r in rows) / 1e9, int(first[1]) / 1e9
    finally:
        process.terminate()
        process.wait()


def main() -> None:
    for _ in range(int(sys.argv[2]) if len(sys.argv) > 2 else 5):
        elapsed, computing, waiting = start(sys.argv[1])
        print(
            f"first answer after {elapsed:.2f} s: {computing:.2f} s of CPU, {waiting:.2f} s waiting"
            f" for a core, {elapsed - waiting:.2f} s otherwise"
        )


if __name__ == "__main__":
    main()
