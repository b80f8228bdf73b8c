"""A folder that photos are copied into: each is taken when it is complete."""

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from skyquilt.errors import UsageError
from skyquilt.model.photo import RejectedPhoto
from skyquilt.photos.read import read_photo
from skyquilt.pipelines.live.intake import Accepted, Intake, Refused
from skyquilt.run.inbox import ending_of
from skyquilt.run.write_points import reached

ENDINGS = (".jpg", ".jpeg", ".tif", ".tiff", ".png")
PARTIAL = (".part", ".partial", ".tmp", ".crdownload", ".filepart")
QUIET_S = 0.04
"""A file whose data end is taken when it has not grown for so long."""
PATIENCE_S = 4.0
"""A file that is cut off is refused when it has not grown for so long; it is looked at again when it changes."""


@dataclass(kw_only=True)
class Growing:
    """A file that is not taken yet."""

    stamp: tuple[int, int]
    """Size and time of change."""
    since: float
    """When it was first seen so, monotonic seconds."""
    refused: bool = False
    """Already refused in this form."""


@dataclass(kw_only=True)
class Watch:
    """Looks into a folder and all below it; survives restarts by what the ledger has seen."""

    folder: Path
    """The folder."""
    intake: Intake
    """Where photos go."""
    growing: dict[str, Growing] = field(default_factory=dict)
    """Files that are not taken yet, by path."""

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            raise UsageError(
                f"{self.folder} is no folder; make it, or name the one that photos are copied into"
            )
        known = self.intake.ledger.rows("select path, size, mtime from seen")
        self._seen = {str(p): (int(s), int(m)) for p, s, m in known}

    def look(self) -> Iterator[Accepted | Refused]:
        """Takes every file that is complete now, in order of names.

        Raises:
            OutputError: the disk is full; the file stays and is taken later.
        """
        now = time.monotonic()  # one moment for all, so that files that came together are taken in order
        for path, stamp in sorted(self._files()):
            key = str(path)
            if self._seen.get(key) == stamp:
                continue
            known = self.growing.get(key)
            if known is None or known.stamp != stamp:
                self.growing[key] = Growing(stamp=stamp, since=now)
                continue
            if known.refused or now - known.since < QUIET_S:
                continue
            reason = self._unfinished(path)
            if reason and now - known.since < PATIENCE_S:
                continue
            yield self._take(path, key, known, reason)

    def _take(self, path: Path, key: str, known: Growing, reason: str) -> Accepted | Refused:
        source = path.parent.relative_to(self.folder).as_posix()
        source = self.folder.name if source == "." else source
        if reason:
            known.refused = True
            done: Accepted | Refused = self.intake.refuse(path.name, source, reason)
        else:
            done = self.intake.take_file(path, source)
        self.growing.pop(key, None)
        self._seen[key] = known.stamp
        with self.intake.ledger.change() as db:
            db.execute("insert or replace into seen values (?, ?, ?)", (key, *known.stamp))
        reached("folder seen")
        return done

    def _files(self) -> Iterator[tuple[Path, tuple[int, int]]]:
        for top, folders, names in os.walk(self.folder):
            folders[:] = [f for f in folders if not f.startswith(".")]
            for name in names:
                low = name.lower()
                if low.startswith(".") or not low.endswith(ENDINGS) or low.endswith(PARTIAL):
                    continue
                path = Path(top) / name
                try:
                    status = path.stat()
                except OSError:
                    continue
                yield path, (status.st_size, status.st_mtime_ns)

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
