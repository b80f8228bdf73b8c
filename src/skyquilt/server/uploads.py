"""Unfinished uploads, stored on disk. Bytes are appended at the offset that the server knows."""

import asyncio
import json
import re
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from skyquilt.outside import put_in_place
from skyquilt.server.access import Guard

SWEEP_S = 60.0
"""Longest time in s between searches for expired uploads."""
_ID = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True, kw_only=True)
class Upload:
    """An unfinished upload, or one whose photo was accepted."""

    id: str
    """Its identifier in URLs."""
    name: str
    """The photo's name."""
    source: str
    """The sender."""
    size: int
    """Size of the complete file in bytes."""
    client: str = ""
    """The address that began it."""
    metadata: str = ""
    """`Upload-Metadata` as the client sent it."""
    outcome: dict[str, str] = field(default_factory=dict)
    """Headers that report the result; empty until the photo is accepted."""


class Uploads:
    """All uploads of one survey. Except for `begin`, it must be used only from the server's event
    loop.
    """

    def __init__(self, folder: Path, guard: Guard) -> None:
        """Uploads are stored in `folder`."""
        self.folder, self.guard = folder, guard
        self._written: set[str] = set()
        self._clients: dict[str, str] = {}
        self._lock = threading.Lock()
        self.sweep()

    def begin(
        self, name: str, source: str, size: int, client: str = "", metadata: str = ""
    ) -> Upload | None:
        """Creates an upload; None if this client has too many, or all clients together.

        Raises OSError where it cannot be stored, as while the survey's folder is gone.
        """
        self.folder.mkdir(exist_ok=True)
        with self._lock:
            active = self._active()
            if len(active) >= self.guard.most_uploads or (
                active.count(client) >= self.guard.most_uploads_each
            ):
                return None
            upload = Upload(
                id=secrets.token_hex(16),
                name=name,
                source=source,
                size=size,
                client=client,
                metadata=metadata,
            )
            self._clients[upload.id] = client
            self.path(upload).touch()
            self._record(upload)
        return upload

    def _active(self) -> list[str]:
        """Clients of the uploads that are in progress: those that are written, and those begun or
        continued a short time ago.
        """
        now, found = time.time(), {}
        for path in self.folder.glob("*.part"):
            if path.stem in self._written or (
                now - self.guard.upload_idle_s < _changed(path) <= now + 1
            ):
                if path.stem not in self._clients:
                    known = self.get(path.stem)
                    self._clients[path.stem] = known.client if known else ""
                found[path.stem] = self._clients[path.stem]
        self._clients = found
        return list(found.values())

    def get(self, number: str) -> Upload | None:
        """An upload by its id; None if it does not exist or has expired."""
        if not _ID.fullmatch(number):
            return None
        try:
            upload = Upload(**json.loads((self.folder / f"{number}.json").read_bytes()))
            if not upload.outcome and self.path(upload).stat().st_size > upload.size:
                raise ValueError("it has more bytes than were announced")
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError):
            if number not in self._written:
                self.drop(number)
            return None
        if self.expires(upload) < time.time() and number not in self._written:
            self.drop(number)
            return None
        return upload

    def path(self, upload: Upload) -> Path:
        """Path of the file with its bytes."""
        return self.folder / f"{upload.id}.part"

    def offset(self, upload: Upload) -> int:
        """Number of bytes received."""
        return upload.size if upload.outcome else self.path(upload).stat().st_size

    def expires(self, upload: Upload) -> float:
        """Time (Unix time) at which it will be deleted unless more bytes arrive."""
        return self._last(upload.id) + self.guard.upload_keep_s

    def accept(self, upload: Upload, outcome: dict[str, str]) -> None:
        """Marks the upload as accepted. Its bytes are deleted; its record is kept until it expires,
        for a client that missed the last response.
        """
        self._record(Upload(**{**asdict(upload), "outcome": outcome}))
        self.path(upload).unlink(missing_ok=True)

    @contextmanager
    def writing(self, number: str) -> Iterator[bool]:
        """Locks an upload for one writer; False if another one holds the lock."""
        if number in self._written:
            yield False
            return
        self._written.add(number)
        try:
            yield True
        finally:
            self._written.discard(number)

    def drop(self, number: str) -> None:
        """Deletes an upload."""
        for ending in (".part", ".json", ".new"):
            with suppress(OSError):
                (self.folder / f"{number}{ending}").unlink()

    def sweep(self) -> None:
        """Deletes expired uploads, and files that a crash left while an upload was created."""
        old = time.time() - self.guard.upload_keep_s
        empty = time.time() - self.guard.upload_empty_s
        for number in {path.stem for path in self.folder.glob("*.*")} - self._written:
            last = self._last(number)
            if last < old or (last < empty and self._bytes(number) == 0):
                self.drop(number)

    def _bytes(self, number: str) -> int:
        """Number of bytes of an upload; -1 if it has no file, since its photo was accepted."""
        try:
            return (self.folder / f"{number}.part").stat().st_size
        except OSError:
            return -1

    async def sweeping(self) -> None:
        """Calls `sweep` at intervals until it is cancelled."""
        while True:
            await asyncio.sleep(
                min(SWEEP_S, self.guard.upload_keep_s / 4, self.guard.upload_empty_s / 4)
            )
            self.sweep()

    def _last(self, number: str) -> float:
        """When its data last changed (Unix time)."""
        return max(_changed(self.folder / f"{number}{ending}") for ending in (".part", ".json"))

    def _record(self, upload: Upload) -> None:
        path = self.folder / f"{upload.id}.json"
        partial = path.with_suffix(".new")
        partial.write_text(json.dumps(asdict(upload)), encoding="utf-8")
        put_in_place(partial, path)


def _changed(path: Path) -> float:
    """When a file was last written (Unix time); 0 if it does not exist."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
