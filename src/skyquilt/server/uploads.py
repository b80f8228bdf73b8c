"""Uploads that survive a lost connection: parts are appended at the offset that the server
knows.
"""

import json
import os
import re
import secrets
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

OLD_S = 24 * 3600
"""Unfinished uploads are dropped after so long."""
_ID = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True, kw_only=True)
class Upload:
    """An upload under way."""

    id: str
    """Its name in addresses."""
    name: str
    """The photo's name."""
    source: str
    """Who sends it."""
    size: int
    """Bytes when it is whole."""
    offset: int
    """Bytes that are here."""


class Uploads:
    """Uploads under way, on disk."""

    def __init__(self, folder: Path, *, most: int) -> None:
        """They wait in `folder`; at most `most` at a time."""
        self.folder, self.most = folder, most
        folder.mkdir(parents=True, exist_ok=True)
        for path in folder.glob("*.json"):
            if time.time() - path.stat().st_mtime > OLD_S:
                self.drop(path.stem)

    def begin(self, name: str, source: str, size: int) -> Upload | None:
        """A new one; None where too many are under way."""
        if len(list(self.folder.glob("*.json"))) >= self.most:
            return None
        number = secrets.token_hex(16)
        (self.folder / f"{number}.part").touch()
        record = json.dumps({"name": name, "source": source, "size": size})
        (self.folder / f"{number}.json").write_text(record, encoding="utf-8")
        return Upload(id=number, name=name, source=source, size=size, offset=0)

    def get(self, number: str) -> Upload | None:
        """One by its id; None where there is none."""
        if not _ID.fullmatch(number):
            return None
        try:
            record = json.loads((self.folder / f"{number}.json").read_text(encoding="utf-8"))
            offset = self.path(number).stat().st_size
        except (OSError, ValueError):
            return None
        return Upload(
            id=number,
            name=record["name"],
            source=record["source"],
            size=record["size"],
            offset=offset,
        )

    def path(self, number: str) -> Path:
        """Where its bytes lie."""
        return self.folder / f"{number}.part"

    def append(self, upload: Upload, data: bytes) -> int:
        """Adds bytes; returns the new offset. OSError where the disk is full: then nothing of them
        counts.
        """
        path = self.path(upload.id)
        before = path.stat().st_size
        try:
            with path.open("ab") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            with suppress(OSError):
                os.truncate(path, before)
            raise
        return before + len(data)

    def drop(self, number: str) -> None:
        """Forgets one."""
        for ending in (".part", ".json"):
            with suppress(OSError):
                (self.folder / f"{number}{ending}").unlink()
