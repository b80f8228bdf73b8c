"""Fuzzes all readers with atheris, or one of them.

python -m fuzz.run --seconds 10              every target for so long
python -m fuzz.run --minutes 5               all targets together for so long
python -m fuzz.run --seeds                   every seed once, without fuzzing
python -m fuzz.run jpeg --seconds 60
python -m fuzz.run --minutes 2 --seed 1      the same inputs every time, as far as the time goes

An input on which a target fails is kept in fuzz/found; once the reader is mended, it belongs into
fuzz/seeds as a regression test.
"""

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).parent
SLOW_S, MEMORY_MB = 10, 2500
JOBS = 2
"""Targets that are fuzzed at a time."""
START_S = 4.0
"""Time in s that a target takes to start."""


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

    with atheris.instrument_imports(include=["skyquilt"]):
        from fuzz.targets import TARGETS, prepare
    from fuzz.mutations import mutated

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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("target", nargs="?")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--seeds", action="store_true")
    parser.add_argument("--corpus", type=Path)
    asked = parser.parse_args()
    if asked.seeds:
        return min(seeds(), 1)
    if asked.corpus:
        fuzz_one(asked.target, asked.seconds, asked.corpus, asked.seed)
        return 0
    names = [asked.target] if asked.target else _names()
    seconds = asked.seconds or 60 * (asked.minutes or 5) * JOBS / len(names) - START_S
    seconds = max(1.0, seconds)
    corpora = Path(tempfile.mkdtemp(prefix="skyquilt-corpus-"))

    def one(name: str) -> bool:
        command = [sys.executable, "-m", "fuzz.run", name, "--seconds", str(seconds)]
        if asked.seed is not None:
            command += ["--seed", str(asked.seed)]
        # the fuzzer ends without Python's clean-up: what targets write goes with the corpora
        env = {**os.environ, "TMPDIR": str(corpora)}
        if asked.seed is not None:
            env["PYTHONHASHSEED"] = "0"
        began = time.monotonic()
        done = subprocess.run(
            [*command, "--corpus", str(corpora / name)],
            env=env,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
        )
        took = f"{time.monotonic() - began:.0f} s"
        if done.returncode == 0:
            runs = [line for line in done.stderr.splitlines() if line.startswith("Done ")]
            print(f"{name}: {(runs or [''])[-1]} ({took} in all)", flush=True)
        else:
            print(
                f"{name}: failed ({took})\n{done.stdout[-1500:]}{done.stderr[-4000:]}", flush=True
            )
        return done.returncode == 0

    with ThreadPoolExecutor(JOBS) as pool:
        held = list(pool.map(one, names))
    failed = [name for name, good in zip(names, held, strict=True) if not good]
    shutil.rmtree(corpora, ignore_errors=True)
    print(
        f"{len(names)} targets, {len(failed)} failed: {', '.join(failed)}" if failed else "all held"
    )
    return min(len(failed), 1)


def _names():
    from fuzz.targets import TARGETS

    return list(TARGETS)


if __name__ == "__main__":
    sys.exit(main())
