"""Builds the wheel, installs it in a fresh environment of every Python from 3.11 on that this
machine has, and uses it there: a simulated flight is mapped, and shown by `view` and `live`. For
Windows and macOS it only looks whether every package has a wheel.

python .ci/wheels.py [--ends]: with `--ends`, of the Pythons only the oldest and the newest.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LEAST, TRIED = (3, 11), range(11, 16)
PLATFORMS, MINORS = ("win_amd64", "macosx_14_0_arm64"), (11, 12, 13)
Version = tuple[int, int]


def pythons() -> dict[Version, Path]:
    """The interpreters by version, one for each: those on the PATH, and those of pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    places = [Path(sys.executable), *sorted(pyenv.glob("*/bin/python"), reverse=True)]
    places += [Path(p) for p in (shutil.which(f"python3.{k}") for k in TRIED) if p]
    found: dict[Version, Path] = {}
    for place in places:
        said = subprocess.run(
            [place, "-c", "import sys; print(*sys.version_info[:2])"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        words = said.stdout.split()
        if said.returncode == 0 and len(words) == 2:
            version = (int(words[0]), int(words[1]))
            if version >= LEAST:
                found.setdefault(version, place)
    return dict(sorted(found.items()))


def run(*words: object, **options: object) -> str:
    """What a command prints; its whole output where it fails."""
    done = subprocess.run(
        [str(w) for w in words], capture_output=True, text=True, check=False, **options
    )
    if done.returncode:
        sys.exit(f"{' '.join(map(str, words))}\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
    return done.stdout


def answers(*words: object) -> None:
    """Starts a server, asks for its page and its description, and ends it."""
    server = subprocess.Popen([str(w) for w in words], stdout=subprocess.PIPE, text=True)
    try:
        line = server.stdout.readline() if server.stdout else ""
        address = re.search(r"http://\S+", line)
        if address is None:
            sys.exit(f"{words[1]} told no address: {line}")
        for path, word in (("", "<title>"), ("info", '"layers"'), ("static/viewer.js", "use")):
            with urllib.request.urlopen(address.group() + path, timeout=20) as page:
                if word not in page.read().decode():
                    sys.exit(f"{words[1]}: /{path} has no {word}")
    finally:
        server.terminate()
        server.wait(20)


def used(python: Path, wheel: Path, folder: Path) -> str:
    """Installs the wheel for one interpreter and uses it; what it says of itself."""
    run(python, "-m", "venv", folder / "venv")
    here = folder / "venv" / "bin"
    pip = [here / "python", "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    run(*pip, "--no-compile", "--constraint", ROOT / "constraints.txt", f"{wheel}[live]")
    skyquilt, away = here / "skyquilt", {"cwd": folder}
    run(skyquilt, "simulate", "flight", "--photos", "4", "--size", "640x480", "--quiet", **away)
    run(skyquilt, "mosaic", "flight/photos", "-o", "out", "--gsd", "30", "--quiet", **away)
    answers(skyquilt, "view", folder / "out", "--port", "0")
    answers(skyquilt, "live", folder / "inbox", "-o", folder / "survey", "--port", "0")
    where = run(here / "python", "-c", "import skyquilt; print(skyquilt.__file__)", **away)
    if not Path(where.strip()).is_relative_to(folder):
        sys.exit(f"not the wheel was used, but {where}")
    return run(skyquilt, "--version").strip()


def found(platform: str, minor: int, wheel: Path, folder: Path) -> None:
    """Looks whether all that the wheel needs can be installed elsewhere without a compiler. What a
    package needs on that system alone is not looked for: pip asks for this one.
    """
    run(
        sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet",
        "--dry-run", "--ignore-installed", "--only-binary=:all:", "--platform", platform,
        "--python-version", f"3.{minor}", "--target", folder / "nothing",
        "--constraint", ROOT / "constraints.txt", f"{wheel}[live]",
    )  # fmt: skip


def main() -> None:
    """Prints a line for each version of Python."""
    ends = "--ends" in sys.argv[1:]
    there, minors = pythons(), MINORS[:: len(MINORS) - 1] if ends else MINORS
    if ends:
        there = {version: there[version] for version in (min(there), max(there))}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        words = ["-m", "pip", "--disable-pip-version-check", "wheel", "--quiet", "--no-deps"]
        run(sys.executable, *words, "--no-build-isolation", "-w", folder, ROOT)
        (wheel,) = folder.glob("*.whl")
        sys.stdout.write(f"{wheel.name}\n")
        for minor in TRIED:
            version = (3, minor)
            if version not in there:
                sys.stdout.write(f"Python 3.{minor}: not on this machine, or not tried\n")
                continue
            place = folder / f"3.{minor}"
            place.mkdir()
            said = used(there[version], wheel, place)
            sys.stdout.write(f"Python 3.{minor}: {said} installed; mosaic, view, live work\n")
            sys.stdout.flush()
            shutil.rmtree(place)
        for platform in PLATFORMS:
            for minor in minors:
                found(platform, minor, wheel, folder)
            told = f" {'and' if ends else 'to'} 3.".join((str(minors[0]), str(minors[-1])))
            sys.stdout.write(f"{platform}: wheels for Python 3.{told}\n")


if __name__ == "__main__":
    main()
