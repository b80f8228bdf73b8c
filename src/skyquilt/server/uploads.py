"""Uploads under way, on disk: bytes are appended at the offset that the server knows."""

import asyncio
import json
import re
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from skyquilt.server.guard import Guard

SWEEP_S = 60.0
"""Between looks for expired uploads, at most."""
_ID = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True, kw_only=True)
class Upload:
    """An upload under way, or one whose photo was accepted."""

    id: str
    """Its name in addresses."""
    name: str
    """The photo's name."""
    source: str
    """Who sends it."""
    size: int
    """Bytes when it is whole."""
    metadata: str = ""
    """`Upload-Metadata` as the client sent it."""
    outcome: dict[str, str] = field(default_factory=dict)
    """Headers that tell what became of the photo; empty until it is accepted."""


class Uploads:
    """All uploads of one survey. To be used from the server's event loop alone, but for `begin`."""

    def __init__(self, folder: Path, guard: Guard) -> None:
        """They wait in `folder`."""
        self.folder, self.guard = folder, guard
        self._written: set[str] = set()
        self.sweep()

    def begin(self, name: str, source: str, size: int, metadata: str = "") -> Upload | None:
        """A new one; None where too many are under way."""
        self.folder.mkdir(parents=True, exist_ok=True)
        idle = time.time() - self.guard.upload_idle_s
        if sum(_changed(path) > idle for path in self.folder.glob("*.part")) >= (
            self.guard.most_uploads
        ):
            return None
        upload = Upload(
            id=secrets.token_hex(16), name=name, source=source, size=size, metadata=metadata
        )
        self.path(upload).touch()
        self._record(upload)
        return upload

    def get(self, number: str) -> Upload | None:
        """One by its id; None where there is none, or none any more."""
        if not _ID.fullmatch(number):
            return None
        try:
            upload = Upload(**json.loads((self.folder / f"{number}.json").read_bytes()))
        except (OSError, ValueError, TypeError):
            return None
        if self.expires(upload) < time.time() and number not in self._written:
            self.drop(number)
            return None
        return upload

    def path(self, upload: Upload) -> Path:
        """Where its bytes lie."""
        return self.folder / f"{upload.id}.part"

    def offset(self, upload: Upload) -> int:
        """Bytes that are here."""
        return upload.size if upload.outcome else self.path(upload).stat().st_size

    def expires(self, upload: Upload) -> float:
        """When it will be dropped, unless more comes (Unix time)."""
        return self._last(upload.id) + self.guard.upload_keep_s

    def accept(self, upload: Upload, outcome: dict[str, str]) -> None:
        """Its photo is safe: the bytes go; the record stays until it expires, for a client that
        missed the last answer.
        """
        self._record(Upload(**{**asdict(upload), "outcome": outcome}))
        self.path(upload).unlink(missing_ok=True)

    @contextmanager
    def writing(self, number: str) -> Iterator[bool]:
        """Holds an upload for one writer; false where another one has it."""
        if number in self._written:
            yield False
            return
        self._written.add(number)
        try:
            yield True
        finally:
            self._written.discard(number)

    def drop(self, number: str) -> None:
        """Forgets one."""
        for ending in (".part", ".json", ".new"):
            with suppress(OSError):
                (self.folder / f"{number}{ending}").unlink()

    def sweep(self) -> None:
        """Drops what has expired, and what a crash left of uploads as they began."""
        old = time.time() - self.guard.upload_keep_s
        for number in {path.stem for path in self.folder.glob("*.*")} - self._written:
            if self._last(number) < old:
                self.drop(number)

    async def sweeping(self) -> None:
        """Sweeps now and then, until it is cancelled."""
        while True:
            await asyncio.sleep(min(SWEEP_S, self.guard.upload_keep_s / 4))
            self.sweep()

    def _last(self, number: str) -> float:
        """When something of it last came (Unix time)."""
        return max(_changed(self.folder / f"{number}{ending}") for ending in (".part", ".json"))

    def _record(self, upload: Upload) -> None:
        path = self.folder / f"{upload.id}.json"
        partial = path.with_suffix(".new")
        partial.write_text(json.dumps(asdict(upload)), encoding="utf-8")
        partial.replace(path)


def _changed(path: Path) -> float:
    """When a file was last written (Unix time); long ago where there is none."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
