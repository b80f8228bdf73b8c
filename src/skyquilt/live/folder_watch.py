"""Watches a folder into which photos are copied, and accepts each photo when it is complete."""

import os
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from skyquilt.errors import UnreadablePhotoError, UsageError
from skyquilt.live.clip_intake import Taking, advanced, take_clip, unfinished_clip
from skyquilt.live.closed_files import ClosedFiles
from skyquilt.live.inbox import is_clip
from skyquilt.live.ledger import hit
from skyquilt.live.photo_intake import Accepted, Intake, Refused
from skyquilt.model.photo import RejectedPhoto
from skyquilt.outside import PHOTO_ENDINGS, hidden, is_folder, open_regular, same_folder, walk
from skyquilt.photos.found_files import OTHER_PICTURES, RUN_MARKS
from skyquilt.photos.headers import HEAD_BYTES, kind_of
from skyquilt.photos.read import read_photo

PARTIAL = (".part", ".partial", ".tmp", ".crdownload", ".filepart")
QUIET_S = 0.04
"""If the system does not report that a file was closed, the file is taken when it has not grown for
this time, in s.
"""
SCAN_S = 0.05
"""Time in s between scans of the whole folder if the system does not report closed files."""
SCAN_TOLD_S = 1.0
"""The same if it does. Scans are still needed, since files that other machines write into a shared
folder are not reported.
"""
SHARE = 0.02
"""Largest share of the time that may be spent on scans, however many files there are."""
PATIENCE_S = 4.0
"""A truncated file is refused when it has not grown for this time, in s. It is checked again when
it changes.
"""
CARD, ON_CARD = "DCIM", re.compile(r"[1-9]\d\d\w{5}")
"""The folder of a camera's card, and the folders in it."""
REMOVED = "it was removed before it was read; copy it again"
Stamp = tuple[int, int]
"""Size and modification time of a file."""


@dataclass(kw_only=True)
class Growing:
    """A file that is not taken yet."""

    stamp: Stamp
    """Its size and modification time."""
    since: float
    """When it was first seen with this stamp, in monotonic seconds."""
    closed: bool = False
    """Whether it was closed after writing since then."""


def create_inbox(folder: Path) -> None:
    """Creates a folder for photos where it is missing.

    Raises:
        UsageError: it cannot be created, or is a file.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = "is a file" if folder.is_file() else f"cannot be created ({error.strerror or error})"
        raise UsageError(f"{folder} {why}; name a folder for the photos") from error


def apart(inbox: Path, output: Path) -> None:
    """Refuses a folder of photos that is the folder of the survey.

    Raises:
        UsageError: it is.
    """
    if same_folder(inbox, output):
        raise UsageError(
            f"{output} is the folder of the photos, and the map that grows there would be taken for"
            f" one; choose another folder for the survey, such as {output / 'map'}"
        )


@dataclass(kw_only=True)
class Watch:
    """Watches a folder and its subfolders. The ledger stores which files were seen, so that a
    restart continues.
    """

    folder: Path
    """The folder."""
    intake: Intake
    """Accepts the photos."""
    growing: dict[str, Growing] = field(default_factory=dict)
    """Files that are not taken yet, by path."""
    _clips: dict[str, tuple[Stamp, Taking]] = field(default_factory=dict)
    _vanished: set[str] = field(default_factory=set)
    """Paths of files that were closed after writing and are gone: removed, or renamed."""
    _closed_folders: dict[Path, str] = field(default_factory=dict)
    _due: float = 0.0

    def __post_init__(self) -> None:
        if not is_folder(self.folder):
            raise UsageError(
                f"{self.folder} is not a folder; make it, or name the folder for the photos"
            )
        apart(self.folder, self.intake.ledger.path.parent)
        known = self.intake.ledger.rows("select path, size, mtime from seen")
        self._seen = {str(p): (int(s), int(m)) for p, s, m in known}
        self._closed = ClosedFiles(folder=self.folder)

    def look(self) -> Iterator[Accepted | Refused]:
        """Takes every file that is complete now, ordered by name.

        Raises:
            OutputError: the disk is full; the file stays and is taken later.
        """
        now = (
            time.monotonic()
        )  # one time for all, so that files that arrived together are taken in order
        told = set(self._closed_folders)
        self._note(now)
        for path in sorted(self._closed_folders.keys() - told):
            reason = f"this folder cannot be read ({self._closed_folders[path]})"
            yield self.intake.refuse(path.name, self.folder.name, reason)
        for key in sorted(self._vanished & self._closed.removed, key=Path):
            self._vanished.discard(key)
            source = drone_of(Path(key).parent, self.folder)
            yield self.intake.refuse(Path(key).name, source, REMOVED)
        for key in sorted(self.growing, key=Path):
            known = self.growing[key]
            if not known.closed and now - known.since < QUIET_S:
                continue
            try:
                patient = now - known.since < PATIENCE_S
                begun = self._clips.get(key, (None,))[0] == known.stamp
                reason = "" if begun else self._unfinished(Path(key), patient=patient)
                if reason and patient:
                    continue
                yield from self._take(Path(key), key, known, reason)
            except FileNotFoundError:  # removed since it was seen
                self.growing.pop(key, None)
                self._clips.pop(key, None)
                self._vanished.add(key)

    def _note(self, now: float) -> None:
        """Records files that are new or have grown, and files that were closed after writing."""
        closed, everything = self._closed.look()
        for path, stamp in self._candidates(closed, everything=everything, now=now):
            key = str(path)
            if stamp is None or self._seen.get(_stored(key)) == stamp:
                self.growing.pop(key, None)
                if stamp is None and key in closed and _stored(key) not in self._seen:
                    self._vanished.add(key)
                continue
            self._vanished.discard(key)
            known = self.growing.get(key)
            if known is None or known.stamp != stamp:
                known = self.growing[key] = Growing(stamp=stamp, since=now)
            known.closed |= key in closed

    def _take(
        self, path: Path, key: str, known: Growing, reason: str
    ) -> Iterator[Accepted | Refused]:
        source = drone_of(path.parent, self.folder)
        done: list[Accepted | Refused] = []
        if reason:
            done.append(self.intake.refuse(path.name, source, reason))
        elif is_clip(path):
            found, whole = self._advanced(path, key, known, source)
            if not whole:
                yield from found
                return
            done += found
        else:
            done.append(self.intake.take_file(path, source))
        self.growing.pop(key, None)
        self._seen[_stored(key)] = known.stamp
        with self.intake.ledger.change() as db:
            row = (_stored(key), *known.stamp)
            db.execute("insert or replace into seen values (?, ?, ?)", row)
        hit("folder seen")
        yield from done  # recorded first: who asks for one result only has it recorded

    def _advanced(
        self, path: Path, key: str, known: Growing, source: str
    ) -> tuple[list[Accepted | Refused], bool]:
        """Works on a clip for a short time; results, and whether that was all."""
        stamp, taking = self._clips.pop(key, (known.stamp, None))
        if taking is None or stamp != known.stamp:  # new, or written anew since
            taking = take_clip(self.intake, path, source)
        found, whole = advanced(taking)
        if not whole:
            self._clips[key] = known.stamp, taking
        return found, whole

    def _candidates(
        self, closed: set[str], *, everything: bool, now: float
    ) -> list[tuple[Path, Stamp | None]]:
        """Files to check, with their stamp; None if the file no longer exists."""
        reported = {p for p in map(Path, closed) if _photo_name(p.name) and not self._of_a_run(p)}
        known = reported | set(map(Path, self.growing))
        if not is_folder(self.folder):
            self._due = 0.0  # what was reported while it is away is looked for when it is back
        elif everything or now >= self._due:
            began = time.thread_time()  # a busy machine is no reason to look less often
            known.update(self._files())
            took = time.thread_time() - began
            self._due = now + max(SCAN_TOLD_S if self._closed.told else SCAN_S, took / SHARE)
        return [(path, _stamp(path)) for path in known]

    def _files(self) -> Iterator[Path]:
        for here, folders, names in walk(self.folder, self._cannot):
            if here != self.folder and not RUN_MARKS.isdisjoint((*names, *folders)):
                folders.clear()
                continue
            yield from (here / name for name in names if _photo_name(name))

    def _of_a_run(self, path: Path) -> bool:
        """Whether a file lies in the folder of a run or of a live map, such as this one's: the map
        that grows there is no photo.
        """
        for folder in path.parents:
            if folder == self.folder or self.folder not in folder.parents:
                return False
            if any((folder / mark).exists() for mark in RUN_MARKS):
                return True
        return False

    def _cannot(self, folder: Path, error: OSError) -> None:
        if is_folder(folder):  # not one that is gone by now
            self._closed_folders[folder] = error.strerror or str(error)

    def _unfinished(self, path: Path, *, patient: bool) -> str:
        """Why a file cannot be taken (yet); empty where it can. Raises `FileNotFoundError`."""
        if is_clip(path):
            return unfinished_clip(path, patient=patient)
        most = self.intake.settings.most_bytes
        try:
            with open_regular(path) as file:
                if os.fstat(file.fileno()).st_size > most:
                    return f"it has more than {most / 1e6:g} MB (--max-mb)"
                head = file.read(HEAD_BYTES)
        except FileNotFoundError:
            raise
        except OSError as error:
            return f"it cannot be read ({error.strerror or error})"
        try:
            kind_of(head)
        except UnreadablePhotoError as error:
            return str(error)
        photo = read_photo(path, most_mp=self.intake.settings.most_mp)
        return photo.reason if isinstance(photo, RejectedPhoto) else ""


def drone_of(folder: Path, inbox: Path) -> str:
    """The drone whose photos lie in a folder: the way to it from the inbox, or else the inbox's
    name. The folders of a camera's card do not count: a drone begins one after another, and those
    of all drones have the same names.
    """
    way, to_inbox = (_without_card(f.absolute().parts) for f in (folder, inbox))
    return "/".join(way[len(to_inbox) :]) or to_inbox[-1]


def _without_card(parts: Sequence[str]) -> list[str]:
    """Parts of a path without `DCIM` and `100MEDIA` in it (the standard DCF, JEITA CP-3461)."""
    return [
        part
        for above, part in pairwise(("", *parts))
        if part.upper() != CARD and not (above.upper() == CARD and ON_CARD.fullmatch(part))
    ]


def _stored(key: str) -> str:
    """A path as the ledger stores it: names may hold bytes that are no valid text."""
    return os.fsencode(key).decode("utf-8", "backslashreplace")


def _photo_name(name: str) -> bool:
    low = name.lower()
    # pictures that are not read are refused with a reason, as raw ones beside photos are not
    taken = low.endswith((*PHOTO_ENDINGS, *OTHER_PICTURES)) or is_clip(Path(low))
    return not hidden(low) and taken and not low.endswith(PARTIAL)


def _stamp(path: Path) -> Stamp | None:
    """Size and modification time; None if the file no longer exists."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns
