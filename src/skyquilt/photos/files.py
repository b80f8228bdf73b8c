"""Which files of a folder are photos."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from skyquilt.errors import UsageError

_PHOTO_ENDINGS = frozenset({".jpg", ".jpeg", ".tif", ".tiff", ".png"})
_RUN_MARK = "run.toml"
_RUN_STATE = ".skyquilt"
_SIDE_NAMES = frozenset({"geo.txt", "gcp_list.txt"})


@dataclass(frozen=True, kw_only=True)
class FoundFiles:
    """What lies in the input."""

    photos: tuple[tuple[str, Path], ...]
    """Name in the survey and file, sorted by name."""
    ignored: tuple[str, ...]
    """Names of all other files."""
    geo: Path | None
    """A `geo.txt` that lies at the top."""
    runs: tuple[str, ...]
    """Folders of earlier runs, left alone."""


def find_files(source: Path | Sequence[Path]) -> FoundFiles:
    """Photos by their endings below a folder, or among files given one by one.

    Hidden files and folders are passed over, and so are folders of earlier runs (they hold
    `run.toml`, or `.skyquilt` while they are under way). Raises `UsageError` where something named
    does not exist.
    """
    if isinstance(source, (str, Path)) and Path(source).is_dir():
        return _in_folder(Path(source))
    paths = [Path(source)] if isinstance(source, (str, Path)) else [Path(p) for p in source]
    for path in paths:
        if not path.exists():
            raise UsageError(f"{path} does not exist; give a folder of photos.")
    return _listed(paths)


def _in_folder(folder: Path) -> FoundFiles:
    runs: list[str] = []
    files = [(_text(p.relative_to(folder).as_posix()), p) for p in _walk(folder, runs, folder)]
    geo = next((p for name, p in files if name.lower() == "geo.txt"), None)
    return _sorted(files, geo, tuple(sorted(runs)))


def _walk(folder: Path, runs: list[str], top: Path) -> Iterator[Path]:
    for where, folders, files in os.walk(folder):
        here = Path(where)
        if here != top and (_RUN_MARK in files or _RUN_STATE in folders):
            runs.append(_text(here.relative_to(top).as_posix()))
            folders.clear()
            continue
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        yield from (here / f for f in files if not f.startswith("."))


def _listed(paths: Sequence[Path]) -> FoundFiles:
    """Files keep their bare names where these differ, else their path below the common folder."""
    files: list[Path] = []
    for path in paths:
        files += [p for _, p in _in_folder(path).photos] if path.is_dir() else [path]
    unique = list(dict.fromkeys(p.absolute() for p in files))
    top = Path(os.path.commonpath([p.parent for p in unique])) if unique else Path()
    bare = len({p.name for p in unique}) == len(unique)
    return _sorted(
        [(_text(p.name if bare else p.relative_to(top).as_posix()), p) for p in unique], None, ()
    )


def _text(name: str) -> str:
    """A name that can be written to any file: Linux allows bytes in names that are no text."""
    return name.encode("utf-8", "backslashreplace").decode()


def _sorted(
    files: Sequence[tuple[str, Path]], geo: Path | None, runs: tuple[str, ...]
) -> FoundFiles:
    photos = sorted((n, p) for n, p in files if p.suffix.lower() in _PHOTO_ENDINGS)
    known = {n for n, _ in photos}
    ignored = sorted(n for n, p in files if n not in known and p.name.lower() not in _SIDE_NAMES)
    return FoundFiles(photos=tuple(photos), ignored=tuple(ignored), geo=geo, runs=runs)
