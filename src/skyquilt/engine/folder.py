"""The run folder: who may write there, what may be resumed, and errors such as a full disk."""

import errno
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from skyquilt.engine import error_log
from skyquilt.engine.lock import FolderLock
from skyquilt.errors import OutputError
from skyquilt.outside import read_bounded

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
FILES = {
    "mosaic.tif": "map",
    "thermal.tif": "thermal map",
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
        """Records the state of the run: `running` or `done`."""
        target = self.path / STATE / "run.json"
        partial = target.with_suffix(".partial")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)  # removed by somebody while it ran
            partial.write_text(json.dumps({"key": self.key, "state": state}))
            partial.replace(target)
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
        return _state(self.path) == (self.key, "done") and all(
            (self.path / name).is_file() for name in CONTRACT
        )


def _state(path: Path) -> tuple[str, str]:
    try:
        found = json.loads(read_bounded(path / STATE / "run.json"))
        return str(found["key"]), str(found["state"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return "", ""


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
    known, state = _state(path)
    try:
        taken = (
            path.is_dir() and any(p.name != STATE or known for p in path.iterdir()) and known != key
        )
        if taken and not overwrite and not ((again or grows) and known):
            what = "another run (other photos or other settings)" if known else "other files"
            raise OutputError(
                f"{path} already holds {what}; add --overwrite to replace its results,"
                " or choose another folder"
            )
        (path / STATE).mkdir(parents=True, exist_ok=True)
        lock = FolderLock(path, f"{STATE}/{LOCK}", "run")
        if taken and not grows:
            for name in (*CONTRACT, error_log.NAME):
                (path / name).unlink(missing_ok=True)
        if taken:
            shutil.rmtree(path / EXPORTS, ignore_errors=True)  # of the map that is replaced
        probe = path / STATE / "probe"
        probe.write_bytes(b"x")
        probe.unlink()
    except OSError as error:
        raise refusal(path, error) from error
    folder = RunFolder(path=path, key=key, lock=lock)
    if state != "done" or known != key:
        folder.mark("running")
    return folder


@contextmanager
def claimed(path: Path, names: Sequence[str], *, overwrite: bool) -> Iterator[None]:
    """Creates the folder, or removes the files `names` of an earlier run from it; other files stay.
    Inside, no other run writes to the folder.

    Raises:
        OutputError: the folder holds files and `overwrite` is not set, is a file, cannot be
            written, or another run works in it.
    """
    _refuse_file(path)
    try:
        _refuse_files(path, overwrite)
        (path / STATE).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refusal(path, error) from error
    lock = FolderLock(path, f"{STATE}/{LOCK}", "run")
    try:
        try:
            _refuse_files(path, overwrite)  # of a run that ended just now
            for name in names:
                (path / name).unlink(missing_ok=True)
            probe = path / ".probe"
            probe.write_bytes(b"x")
            probe.unlink()
        except OSError as error:
            raise refusal(path, error) from error
        yield
    finally:
        lock.remove()


def _refuse_file(path: Path) -> None:
    if os.path.lexists(path) and not path.is_dir():
        what = "a file" if path.exists() else "a link that leads nowhere"
        raise OutputError(f"{path} is {what}; the output is a folder")


def _refuse_files(path: Path, overwrite: bool) -> None:
    if not overwrite and path.is_dir() and any(p.name != STATE for p in path.iterdir()):
        raise OutputError(
            f"{path} already holds files; add --overwrite to replace its results, or choose"
            " another folder"
        )


FULL = (errno.ENOSPC, errno.EDQUOT)


def refusal(path: Path, error: OSError) -> OutputError:
    """The error, with the next step: free disk space and resume, or choose another folder."""
    if error.errno in FULL:
        return OutputError(
            f"the disk is full: cannot write to {path}. Make room and run the same command again to"
            " resume"
        )
    return OutputError(
        f"cannot write to {path}: {error.strerror or error}; choose another output folder"
    )
