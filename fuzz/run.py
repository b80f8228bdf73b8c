"""Fuzzes all readers with atheris, or one of them.

python -m fuzz.run --seconds 10              every target for so long
python -m fuzz.run --minutes 5               all targets together for so long
python -m fuzz.run --seeds                   every seed once, without fuzzing
python -m fuzz.run jpeg --seconds 60
python -m fuzz.run --minutes 1 --seed 1      the same inputs every time, as far as the time goes

An input on which a target fails is kept in fuzz/found; once the reader is mended, it belongs into
fuzz/seeds as a regression test.
"""

import argparse
import io
import os
import random
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import redirect_stderr
from pathlib import Path

HERE = Path(__file__).parent
SLOW_S, MEMORY_MB = 10, 2500
JOBS = 2
"""Targets that are fuzzed at a time."""
START_S = 0.5
"""Time in s that a target takes to start and to end."""


def seeds() -> int:
    """Runs every seed once; returns how many failed."""
    from fuzz.targets import TARGETS, prepare

    failed = count = 0
    for name, target in TARGETS.items():
        prepare(name)
        for number, data in enumerate(target.seeds()):
            began = time.monotonic()
            try:
                target.run(data)
            except Exception:
                failed += 1
                print(f"{name}, seed {number}:\n{traceback.format_exc()}")
            if time.monotonic() - began > SLOW_S:
                failed += 1
                print(f"{name}, seed {number}: {time.monotonic() - began:.1f} s")
            count += 1
    print(f"{count} seeds of {len(TARGETS)} targets, {failed} failed")
    return failed


def fuzz_one(name: str, seconds: float, corpus: Path, seed: int | None) -> None:
    """Fuzzes one target in this process; atheris ends it. With a seed the inputs are repeatable."""
    import atheris

    from fuzz.mutations import mutated
    from fuzz.targets import TARGETS, prepare

    target = TARGETS[name]
    prepare(name)
    corpus.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(target.seeds()):
        (corpus / f"seed{number}").write_bytes(data)

    def structured(data: bytes, most: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if rng.random() < 0.3:
            return atheris.Mutate(data, most)
        return mutated(bytes(data) or rng.choice(target.seeds()), rng)[:most]

    found = HERE / "found"
    found.mkdir(exist_ok=True)
    options = [
        sys.argv[0],
        str(corpus),
        f"-max_total_time={max(1, round(seconds))}",
        f"-timeout={SLOW_S}",
        f"-rss_limit_mb={MEMORY_MB}",
        "-max_len=700000",
        f"-artifact_prefix={found}/{name}-",
    ]
    if seed is not None:
        options.append(f"-seed={seed}")
    atheris.Setup(options, target.run, custom_mutator=structured)
    atheris.Fuzz()


def instrumented() -> list[str]:
    """Imports what is fuzzed, for this process and its copies; names of the targets."""
    import atheris

    told = redirect_stderr(io.StringIO())  # a line for each module
    with told, atheris.instrument_imports(include=["skyquilt"]):
        from fuzz.targets import TARGETS
    return list(TARGETS)


def forked(name: str, seconds: float, corpora: Path, seed: int | None) -> int:
    """Fuzzes one target in a copy of this process, whose number is returned; what it says goes to
    `NAME.log` in the folder. The copy has the instrumented readers already: to import them takes
    longer than CI fuzzes one of them.
    """
    child = os.fork()
    if child:
        return child
    # the fuzzer ends without Python's clean-up: what targets write goes with the corpora
    tempfile.tempdir = os.environ["TMPDIR"] = str(corpora)
    log = os.open(corpora / f"{name}.log", os.O_WRONLY | os.O_CREAT)
    for stream in (1, 2):
        os.dup2(log, stream)
    fuzz_one(name, seconds, corpora / name, seed)
    sys.exit()  # and not os._exit: an input that ends the process is kept as it exits


def fuzz(names: list[str], seconds: float, corpora: Path, seed: int | None) -> Iterator[str]:
    """Fuzzes targets, some at a time; yields those that failed."""
    waiting, running = names[::-1], dict[int, tuple[str, float]]()
    while waiting or running:
        while waiting and len(running) < JOBS:
            name = waiting.pop()
            running[forked(name, seconds, corpora, seed)] = name, time.monotonic()
        child, status = os.wait()
        name, began = running.pop(child)
        took = f"{time.monotonic() - began:.0f} s"
        said = (corpora / f"{name}.log").read_text(errors="replace")
        if status == 0:
            runs = [line for line in said.splitlines() if line.startswith("Done ")]
            print(f"{name}: {(runs or [''])[-1]} ({took} in all)", flush=True)
        else:
            print(f"{name}: failed ({took})\n{said[-5500:]}", flush=True)
            yield name


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("target", nargs="?")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--seeds", action="store_true")
    asked = parser.parse_args()
    if asked.seeds:
        return min(seeds(), 1)
    if asked.seed is not None and os.environ.get("PYTHONHASHSEED") != "0":
        again = [sys.executable, "-m", "fuzz.run", *sys.argv[1:]]
        os.execve(sys.executable, again, {**os.environ, "PYTHONHASHSEED": "0"})
    names = instrumented()
    names = [asked.target] if asked.target else names
    seconds = asked.seconds or 60 * (asked.minutes or 5) * JOBS / len(names) - START_S
    corpora = Path(tempfile.mkdtemp(prefix="skyquilt-corpus-"))
    failed = list(fuzz(names, max(1.0, seconds), corpora, asked.seed))
    shutil.rmtree(corpora, ignore_errors=True)
    print(
        f"{len(names)} targets, {len(failed)} failed: {', '.join(failed)}" if failed else "all held"
    )
    return min(len(failed), 1)


if __name__ == "__main__":
    sys.exit(main())
