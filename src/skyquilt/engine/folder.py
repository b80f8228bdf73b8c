"""The run folder: who may write there, what may be resumed, and errors such as a full disk."""

import errno
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from skyquilt.engine import error_log
from skyquilt.engine.lock import FolderLock
from skyquilt.errors import OutputError, RefusedError
from skyquilt.outside import (
    in_use,
    open_regular,
    plain,
    put_in_place,
    read_bounded,
    remove_file,
    remove_folder,
)
from skyquilt.version import __version__

CONTRACT = (
    "mosaic.tif",
    "provenance.tif",
    "views.tif",
    "surface.tif",
    "cameras.json",
    "shots.geojson",
    "reconstruction.json",
    "footprints.geojson",
    "metrics.json",
    "report.html",
    "run.toml",
)
"""Files of a finished run."""
STATE, EXPORTS, LOCK = ".skyquilt", "export", "run.lock"
UNFINISHED, PROBE = "unfinished", ".probe"
"""What stands in a folder of results while a command without a run works there, and a file by which
is seen whether it can be written.
"""
FILES = {
    "mosaic.tif": "map",
    "thermal.tif": "thermal map",
    "bands.tif": "all bands",
    "infrared.tif": "colour infrared",
    "ndvi.tif": "NDVI",
    "ndre.tif": "NDRE",
    "gndvi.tif": "GNDVI",
    "dsm.tif": "heights",
    "hillshade.tif": "relief",
    "dtm.tif": "bare ground",
    "contours.gpkg": "contour lines",
    "surface.tif": "ground drawn on",
    "views.tif": "photos per place",
    "provenance.tif": "photo shown",
    "shots.geojson": "positions of photos",
    "footprints.geojson": "footprints",
    "cameras.json": "cameras",
    "reconstruction.json": "poses and tie points",
    "metrics.json": "all figures",
    "run.toml": "settings",
}
"""Files of a run, in the order of the links."""
THERMAL_FILE = "thermal.tif"
ADDED = (THERMAL_FILE, "bands.tif", "infrared.tif", "ndvi.tif", "ndre.tif", "gndvi.tif")
"""Those that are added to a finished run."""
LASTING = tuple(name for name in FILES if name not in ("metrics.json", *ADDED))
"""Those that nothing changes once the run is finished."""
PART, PARTS = 1 << 14, 256
"""Bytes of a part of a file, and how many parts tell whether it is whole."""


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """An opened output folder."""

    path: Path
    """The folder."""
    key: str
    """Identifies what the run is made from: inputs and settings."""
    lock: FolderLock
    """Held until the run is finished, or its process ends."""

    @property
    def store(self) -> Path:
        """Folder of intermediate results."""
        return self.path / STATE / "store"

    def mark(self, state: str) -> None:
        """Records the state of the run, `running` or `done`, and what finished files hold."""
        target = self.path / STATE / "run.json"
        partial = target.with_suffix(".partial")
        record: dict[str, object] = {"key": self.key, "state": state, "version": __version__}
        try:
            if state == "done":
                record["files"] = {n: s for n in LASTING if (s := stamp(self.path / n))}
            target.parent.mkdir(parents=True, exist_ok=True)  # removed by somebody while it ran
            partial.write_text(json.dumps(record), encoding="utf-8")
            put_in_place(partial, target)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise refusal(self.path, error) from error

    def finish(self) -> None:
        """Records that the run is done, and lets others write to the folder.

        Raises:
            OutputError: files that it had written are gone.
        """
        gone = [name for name in CONTRACT if not (self.path / name).is_file()]
        self.mark("running" if gone else "done")
        self.lock.close()
        if gone:
            raise OutputError(
                f"{', '.join(gone)} in {self.path} disappeared while the run worked; let nothing"
                " else change that folder, and run the same command again to make what is missing"
            )

    @property
    def done(self) -> bool:
        """Whether a run with the same key was finished before."""
        known = _known(self.path)
        return (known.key, known.state) == (self.key, "done") and not self.changed

    @property
    def changed(self) -> tuple[str, ...]:
        """Files of a finished run that are gone, or do not hold what was written."""
        return changed(self.path) if _known(self.path).state == "done" else ()


def changed(path: Path) -> tuple[str, ...]:
    """Files of the finished run in a folder that are gone, or do not hold what was written: a copy
    that was cut off, a disk that lost power, a program that wrote into them.
    """
    known = _known(path).files
    names = dict.fromkeys((*CONTRACT, *known))
    found = {name: stamp(path / name) for name in names}
    return tuple(n for n, now in found.items() if not now or known.get(n, now) != now)


def stamp(path: Path) -> str:
    """Size and hash of a file; of a large one, of parts spread over it. Empty where there is
    none.
    """
    try:
        with open_regular(path) as file:
            size = file.seek(0, os.SEEK_END)
            apart = max(PART, (size - PART) // (PARTS - 1))
            content = hashlib.blake2b(digest_size=16)
            for place in range(0, size, apart):
                file.seek(place)
                content.update(file.read(PART))
            file.seek(max(0, size - PART))
            content.update(file.read(PART))
    except OSError:
        return ""
    return f"{size} {content.hexdigest()}"


def stamps(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """What tells each of these files of a folder from another one."""
    return {name: stamp(folder / name) for name in names}


def as_written(folder: Path, files: object) -> bool:
    """Whether files are as their `stamps` say; False where there are none."""
    return isinstance(files, dict) and bool(files) and files == stamps(folder, files)


@dataclass(frozen=True, kw_only=True)
class _Known:
    """What a folder's run.json says; empty where there is none that can be read."""

    key: str = ""
    state: str = ""
    version: str = ""
    files: Mapping[str, str] = field(default_factory=dict)
    """Stamps of a finished run's files."""


def _known(path: Path) -> _Known:
    try:
        found = json.loads(read_bounded(path / STATE / "run.json"))
        files = {n: str(s) for n, s in dict(found.get("files", {})).items() if n in LASTING}
        words = {k: str(found[k]) for k in ("key", "state")}
        return _Known(**words, version=str(found.get("version", "")), files=files)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return _Known()


def open_run(
    path: Path, key: str, *, overwrite: bool, again: bool = False, grows: bool = False
) -> RunFolder:
    """Opens a folder for a run: new, empty, the same run again (resumed), or overwritten.

    With `again`, another run's results may be replaced, but nothing is written among other files.
    With `grows`, the files of the run that is there stay until they are replaced: it is continued,
    or shown meanwhile.

    Raises:
        OutputError: it holds something else, another run works in it, or it cannot be written.
    """
    _refuse_file(path)
    was = _known(path)
    try:
        taken = (
            path.is_dir()
            and any(p.name != STATE or was.key for p in path.iterdir())
            and was.key != key
        )
        if taken and not overwrite and not ((again or grows) and was.key):
            raise OutputError(
                f"{path} already holds {_other(was)}; add --overwrite to replace its results,"
                " or choose another folder"
            )
        (path / STATE).mkdir(parents=True, exist_ok=True)
        lock = FolderLock(path, f"{STATE}/{LOCK}", "run")
        if taken and grows:
            remove_folder(path / EXPORTS)
        elif taken:
            _remove_files(path)
        probe = path / STATE / "probe"
        probe.write_bytes(b"x")
        probe.unlink()
    except OSError as error:
        raise refusal(path, error) from error
    folder = RunFolder(path=path, key=key, lock=lock)
    if was.state != "done" or was.key != key:
        folder.mark("running")
    return folder


def remove_run(path: Path) -> None:
    """Removes what a run wrote to its folder, and the folder if nothing else is in it; a folder
    without a run stays.

    Raises:
        OutputError: another run works in it, or it cannot be removed.
    """
    if not _known(path).key:
        return
    lock = FolderLock(path, f"{STATE}/{LOCK}", "run")
    try:
        _remove_files(path)
        lock.close()
        remove_folder(path / STATE, whole=True)
    except OSError as error:
        raise refusal(path, error) from error
    with suppress(OSError):  # it holds files of others
        path.rmdir()


def _remove_files(path: Path) -> None:
    for name in (*CONTRACT, *FILES, error_log.NAME):  # none may stay beside another map
        remove_file(path / name)
    remove_folder(path / EXPORTS)  # of the map that is replaced


def _other(was: _Known) -> str:
    """What a folder holds that is not this run."""
    if not was.key:
        return "other files"
    if was.version == __version__:
        return "another run (other photos or other settings)"
    its = f"version {plain(was.version, 40)}" if was.version else "an earlier version"
    return f"a run of {its} of Skyquilt, and this is version {__version__}"


@contextmanager
def claimed(
    path: Path, names: Sequence[str], *, overwrite: bool, folders: Sequence[str] = ()
) -> Iterator[None]:
    """Creates the folder, or removes the files `names` of an earlier run from it; other files stay.
    Inside, no other run writes to the folder. What a run leaves there that did not get to its end
    (a full disk, an interrupt, a loss of power) is replaced by the next one. `folders`: those that
    the command makes.

    Raises:
        OutputError: the folder holds files and `overwrite` is not set, is a file, cannot be
            written, or another run works in it.
    """
    check_room(path, names, overwrite=overwrite, folders=folders)
    try:
        (path / STATE).mkdir(exist_ok=True)
    except OSError as error:
        raise refusal(path, error) from error
    lock = FolderLock(path, f"{STATE}/{LOCK}", "run")
    unfinished = path / STATE / UNFINISHED
    try:
        try:
            _refuse_files(path, (*names, *folders), overwrite)  # of a run that ended just now
            for name in [*names, *(_parts_of(path, names) if unfinished.exists() else ())]:
                remove_file(path / name)
            unfinished.touch()
        except OSError as error:
            raise refusal(path, error) from error
        ended = False
        try:
            yield
            ended = True
        except RefusedError:
            ended = True  # a refusal is a result, with its files
            raise
        finally:
            with suppress(OSError):  # somebody removed the folder
                if ended or all(p.name == STATE for p in path.iterdir()):
                    remove_file(unfinished)
    finally:
        lock.remove()


def check_room(
    path: Path, names: Sequence[str], *, overwrite: bool, folders: Sequence[str] = ()
) -> None:
    """Creates the folder and checks that a command may write its results there, before it computes
    them for long; parameters and errors as those of `claimed`.
    """
    _refuse_file(path)
    try:
        _refuse_files(path, (*names, *folders), overwrite)
        path.mkdir(parents=True, exist_ok=True)
        probe = path / PROBE
        probe.write_bytes(b"x")
        probe.unlink()
    except OSError as error:
        raise refusal(path, error) from error


def make_folder(path: Path) -> None:
    """Creates a folder for results where it is missing.

    Raises:
        OutputError: it, or a folder above it, is a file or a link to nowhere, or cannot be written.
    """
    _refuse_file(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refusal(path, error) from error


def _refuse_file(path: Path) -> None:
    place = path
    while not os.path.lexists(place) and place != place.parent:
        place = place.parent
    if os.path.lexists(place) and not place.is_dir():
        what = "a file" if place.exists() else "a link that leads nowhere"
        why = "the output is a folder" if place == path else f"{path} cannot be below it"
        raise OutputError(f"{place} is {what}; {why}; choose another output folder")


def _refuse_files(path: Path, names: Sequence[str], overwrite: bool) -> None:
    if overwrite or not path.is_dir():
        return
    held = {p.name for p in path.iterdir()} - {STATE, PROBE}
    ours = (path / STATE / UNFINISHED).exists() and held <= {*names, *_parts_of(path, names)}
    if held and not ours:
        raise OutputError(
            f"{path} already holds files; add --overwrite to replace its results, or choose"
            " another folder"
        )


def _parts_of(path: Path, names: Sequence[str]) -> list[str]:
    """Files in a folder of which a run was writing these when it was stopped (`a.tif.partial`)."""
    begun = tuple(f"{name}." for name in names)
    return [p.name for p in path.iterdir() if p.name.startswith(begun)]


FULL = (errno.ENOSPC, errno.EDQUOT)


def refusal(path: Path, error: OSError) -> OutputError:
    """The error, with the next step: free disk space and resume, or choose another folder."""
    if error.errno in FULL:
        return OutputError(
            f"the disk is full: cannot write to {path}. Make room and run the same command again to"
            " resume"
        )
    if words := in_use(error, Path(error.filename or path)):
        return OutputError(words)
    return OutputError(
        f"cannot write to {path}: {error.strerror or error}; choose another output folder"
    )
