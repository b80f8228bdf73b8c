"""A folder that photos are copied into: each is taken when it is complete."""

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from skyquilt.errors import UsageError
from skyquilt.live.closed_files import ClosedFiles
from skyquilt.live.crash_points import hit
from skyquilt.live.inbox import ending_of
from skyquilt.live.photo_intake import Accepted, Intake, Refused
from skyquilt.model.photo import RejectedPhoto
from skyquilt.photos.read import read_photo

ENDINGS = (".jpg", ".jpeg", ".tif", ".tiff", ".png")
PARTIAL = (".part", ".partial", ".tmp", ".crdownload", ".filepart")
QUIET_S = 0.04
"""A file whose end was not told is taken when it has not grown for so long."""
SCAN_S = 0.05
"""Between looks at the whole folder where the system does not tell of files that are complete."""
SCAN_TOLD_S = 1.0
"""The same where it does: it does not tell of files that other machines write into a shared folder.
"""
SHARE = 0.02
"""Of the time that looking may take, however many files there are."""
PATIENCE_S = 4.0
"""A file that is cut off is refused when it has not grown for so long; it is looked at again when
it changes.
"""
Stamp = tuple[int, int]
"""Size and time of change of a file."""


@dataclass(kw_only=True)
class Growing:
    """A file that is not taken yet."""

    stamp: Stamp
    """How it is."""
    since: float
    """When it was first seen so, monotonic seconds."""
    closed: bool = False
    """Whether its writer has closed it since."""


@dataclass(kw_only=True)
class Watch:
    """Looks into a folder and all below it; survives restarts by what the ledger has seen."""

    folder: Path
    """The folder."""
    intake: Intake
    """Where photos go."""
    growing: dict[str, Growing] = field(default_factory=dict)
    """Files that are not taken yet, by path."""
    _due: float = 0.0

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            raise UsageError(
                f"{self.folder} is no folder; make it, or name the one that photos are copied into"
            )
        known = self.intake.ledger.rows("select path, size, mtime from seen")
        self._seen = {str(p): (int(s), int(m)) for p, s, m in known}
        self._closed = ClosedFiles(folder=self.folder)

    def look(self) -> Iterator[Accepted | Refused]:
        """Takes every file that is complete now, in order of names.

        Raises:
            OutputError: the disk is full; the file stays and is taken later.
        """
        now = (
            time.monotonic()
        )  # one moment for all, so that files that came together are taken in order
        self._note(now)
        for key in sorted(self.growing, key=Path):
            known = self.growing[key]
            if not known.closed and now - known.since < QUIET_S:
                continue
            reason = self._unfinished(Path(key))
            if reason and now - known.since < PATIENCE_S:
                continue
            yield self._take(Path(key), key, known, reason)

    def _note(self, now: float) -> None:
        """Files that are new or have grown, and those whose writers have closed them."""
        closed, everything = self._closed.look()
        for path, stamp in self._candidates(closed, everything=everything, now=now):
            key = str(path)
            if stamp is None or self._seen.get(key) == stamp:
                self.growing.pop(key, None)
                continue
            known = self.growing.get(key)
            if known is None or known.stamp != stamp:
                known = self.growing[key] = Growing(stamp=stamp, since=now)
            known.closed |= key in closed

    def _take(self, path: Path, key: str, known: Growing, reason: str) -> Accepted | Refused:
        source = path.parent.relative_to(self.folder).as_posix()
        source = self.folder.name if source == "." else source
        if reason:
            done: Accepted | Refused = self.intake.refuse(path.name, source, reason)
        else:
            done = self.intake.take_file(path, source)
        self.growing.pop(key, None)
        self._seen[key] = known.stamp
        with self.intake.ledger.change() as db:
            db.execute("insert or replace into seen values (?, ?, ?)", (key, *known.stamp))
        hit("folder seen")
        return done

    def _candidates(
        self, closed: set[str], *, everything: bool, now: float
    ) -> list[tuple[Path, Stamp | None]]:
        """Files to look at, with what tells that they have changed; None where they are gone."""
        known = {p for p in map(Path, closed | self.growing.keys()) if _photo_name(p.name)}
        if everything or now >= self._due:
            known.update(self._files())
            took = time.monotonic() - now
            self._due = now + max(SCAN_TOLD_S if self._closed.told else SCAN_S, took / SHARE)
        return [(path, _stamp(path)) for path in known]

    def _files(self) -> Iterator[Path]:
        for top, folders, names in os.walk(self.folder):
            folders[:] = [f for f in folders if not f.startswith(".")]
            yield from (Path(top) / name for name in names if _photo_name(name))

    @staticmethod
    def _unfinished(path: Path) -> str:
        """Why a file cannot be taken (yet); empty where it can."""
        try:
            with path.open("rb") as file:
                head = file.read(8)
        except OSError as error:
            return f"it cannot be read ({error.strerror or error})"
        if not head:
            return "it is empty (0 bytes)"
        if ending_of(head) is None:
            return "it is neither JPEG, TIFF nor PNG inside, whatever its name says"
        photo = read_photo(path)
        return photo.reason if isinstance(photo, RejectedPhoto) else ""


def _photo_name(name: str) -> bool:
    low = name.lower()
    return not low.startswith(".") and low.endswith(ENDINGS) and not low.endswith(PARTIAL)


def _stamp(path: Path) -> Stamp | None:
    """Size and time of change; None where the file is gone."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns
