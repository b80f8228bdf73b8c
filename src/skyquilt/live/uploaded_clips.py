"""Clips that were uploaded, and the positions beside them.

They are kept in the survey's folder until their frames are accepted as photos, then they are
deleted. Names that senders give are kept as text only; a clip and its positions belong together by
the sender and the name without its extension.
"""

import hashlib
import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from skyquilt.errors import OutputError
from skyquilt.live.inbox import SEEN, is_clip, synced
from skyquilt.live.photo_intake import Accepted, Intake, Refused, shown_name, shown_source
from skyquilt.outside import open_regular, put_in_place, read_bounded, remove_folder
from skyquilt.video.container import is_video
from skyquilt.video.tracks import TRACK_ENDINGS

if TYPE_CHECKING:
    from skyquilt.live.clip_intake import Taking

WAITING = "waiting"
"""Folder, in that of clips, of those whose frames are not accepted yet."""
MOST_WAITING = 100
"""Largest number of clips, or of positions without one, that wait."""
PATIENCE_S = 10.0
"""A clip waits so long for its positions, in s."""
KEEP_S = 24 * 3600.0
"""Positions wait so long for their clip, in s."""
SCAN_S = 0.5
_ABOUT = "about.json"


@dataclass(frozen=True, kw_only=True)
class Waiting:
    """A clip, or positions of one, that is stored durably and waits for the mapping."""

    name: str
    """Its name."""


def bring_clip(intake: Intake, file: Path, name: str, source: str) -> Waiting | Refused:
    """Takes a complete upload over, by renaming its file, which is on the disk already.

    Raises:
        OutputError: the disk is full.
    """
    name, source = shown_name(name), shown_source(source)
    folder = _waiting(intake)
    path = Path(name)
    home = folder / _key(source, path.stem)
    try:
        with open_regular(file) as head:
            if is_clip(path) and not is_video(head.read(400)):
                return intake.refuse(name, source, "its content is no video of a known kind")
        if not home.is_dir() and len(_homes(folder)) >= MOST_WAITING:
            return intake.refuse(
                name, source, f"{MOST_WAITING} clips are waiting already; send it again later"
            )
        home.mkdir(parents=True, exist_ok=True)
        if is_clip(path):
            _record(home / _ABOUT, {"name": name, "source": source})
        put_in_place(file, home / f"clip{path.suffix.lower()}")
        synced(home)
        synced(folder)
    except OSError as error:
        raise OutputError(f"cannot keep {name}: {error.strerror or error}") from error
    return Waiting(name=name)


@dataclass(kw_only=True)
class UploadedClips:
    """Accepts the frames of uploaded clips, a piece of work at a time."""

    intake: Intake
    """Accepts the photos."""
    growing: "dict[Path, Taking | None]" = field(default_factory=dict)
    """Clips whose frames are not all accepted; None before work on one began."""
    _due: float = 0.0

    def look(self) -> Iterator[Accepted | Refused]:
        """Works for a short time on the first clip.

        Raises:
            OutputError: the disk is full; the clip stays and is taken later.
        """
        now = time.monotonic()
        if now >= self._due:
            self._scan()
            self._due = now + SCAN_S
        for home, begun in self.growing.items():
            clip = _clip_in(home)
            if clip is None or (begun is None and not _ready(home, clip)):
                continue
            from skyquilt.live.clip_intake import advanced, take_clip  # most surveys have none

            about = _about(home)
            taking = begun or take_clip(self.intake, clip, about["source"], about["name"])
            self.growing[home] = None  # begun anew if this fails
            found, whole = advanced(taking)
            self.growing[home] = taking
            if whole:
                del self.growing[home]
                remove_folder(home)
            yield from found
            return

    def _scan(self) -> None:
        homes = _homes(_waiting(self.intake))
        for home in homes:
            if _clip_in(home) is not None:
                self.growing.setdefault(home, None)
            elif _age(home) > KEEP_S:
                remove_folder(home)
        for gone in self.growing.keys() - set(homes):
            del self.growing[gone]


def _waiting(intake: Intake) -> Path:
    return intake.inbox.folder.parent / SEEN / WAITING


def _key(source: str, stem: str) -> str:
    return hashlib.blake2b(f"{source}\0{stem.lower()}".encode(), digest_size=16).hexdigest()


def _homes(folder: Path) -> list[Path]:
    """Folders of clips that wait, the oldest first."""
    try:
        found = [p for p in folder.iterdir() if p.is_dir()]
    except FileNotFoundError:
        return []
    return sorted(found, key=lambda p: (-_age(p), p.name))


def _clip_in(home: Path) -> Path | None:
    try:
        return next((p for p in sorted(home.iterdir()) if is_clip(p)), None)
    except OSError:
        return None


def _ready(home: Path, clip: Path) -> bool:
    """Whether positions are beside a clip, or it has waited for them."""
    positions = any(p.suffix.lower() in TRACK_ENDINGS for p in home.iterdir())
    return positions or _age(home) > PATIENCE_S or _age(clip) > KEEP_S


def _age(path: Path) -> float:
    """Time in s since a folder changed."""
    try:
        return max(time.time() - path.stat().st_mtime, 0.0)
    except OSError:
        return 0.0


def _about(home: Path) -> dict[str, str]:
    try:
        said = json.loads(read_bounded(home / _ABOUT, 100_000))
        return {"name": shown_name(str(said["name"])), "source": shown_source(str(said["source"]))}
    except (OSError, ValueError, LookupError, TypeError):
        return {"name": "clip", "source": "upload"}


def _record(path: Path, said: dict[str, str]) -> None:
    partial = path.with_suffix(".new")
    with partial.open("w", encoding="utf-8") as file:
        json.dump(said, file)
        file.flush()
        os.fsync(file.fileno())
    put_in_place(partial, path)
