"""Accepts photos: checks them, stores them durably and detects duplicates."""

import json
import re
import time
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from skyquilt.engine.error_log import log_error
from skyquilt.errors import OutputError, UnreadablePhotoError
from skyquilt.live.failures import of_the_system
from skyquilt.live.inbox import Arrived, Inbox, belongs_to_clip, gone, is_clip
from skyquilt.live.ledger import Ledger, hit
from skyquilt.live.settings import LiveSettings
from skyquilt.model.bands import canonical
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.outside import open_regular, plain
from skyquilt.photos.headers import unread_by_name
from skyquilt.photos.left_out import AS_MANY, IS_MAP
from skyquilt.photos.read import read_photo, rejected
from skyquilt.video.srt import MOST_TELEMETRY_BYTES

NAME = 200
"""Largest number of characters of a name that are kept."""
MORE = 2
"""Another band is shown where more than so many times as many files are of it as of the one shown;
of photos in colours as many are enough as for a batch map.
"""
BAND, OTHER_BAND = "band", "other band due"
"""Names in the ledger: the band that the map shows, empty for photos in colours; whether the map
must be begun again with it.
"""


@dataclass(frozen=True, kw_only=True)
class Accepted:
    """A photo that is stored durably."""

    id: int
    """Its number."""
    name: str
    """Its name."""
    duplicate: bool = False
    """True if the same file was received before."""
    kept: str = ""
    """Why the map does not show it, and it is kept for the final map only; empty for others."""


@dataclass(frozen=True, kw_only=True)
class Refused:
    """A file that was not accepted. Its truth value is False."""

    name: str
    """Its name."""
    reason: str
    """The reason, as a phrase."""

    def __bool__(self) -> bool:
        return False


def shown_name(name: str) -> str:
    """A name for display: the last part of a path, without control characters, of limited length.
    It is never used as a path.
    """
    return shown_source(re.split(r"[\\/]", name)[-1]) or "photo"


def shown_source(source: str) -> str:
    """What names a drone, for display: as `shown_name`, but a path stays whole, since the cards of
    all drones end alike.
    """
    return "".join(c if unicodedata.category(c)[0] != "C" else "?" for c in source[:NAME])


class Intake:
    """Accepts all photos, whatever their source. Can be used from several threads."""

    def __init__(self, ledger: Ledger, inbox: Inbox, settings: LiveSettings) -> None:
        self.ledger, self.inbox, self.settings = ledger, inbox, settings

    def most_bytes(self, name: str) -> int:
        """The largest size of an upload of this name in bytes."""
        if is_clip(Path(name)):
            return self.settings.most_clip_bytes
        return MOST_TELEMETRY_BYTES if belongs_to_clip(name) else self.inbox.most_bytes

    def unread(self, name: str, source: str) -> Refused | None:
        """Refuses a file by its name, before any of it is sent: a raw picture beside each photo is
        five times as large.
        """
        reason = unread_by_name(name)
        return self.refuse(name, source, reason) if reason else None

    def take(self, blocks: Iterable[bytes], name: str, source: str) -> Accepted | Refused:
        """Accepts a file's bytes; when this returns `Accepted`, no crash can lose the photo.

        Raises:
            OutputError: the disk is full, or the survey's folder gone; this photo was not accepted,
            and no accepted photo is lost.
        """
        name, source = shown_name(name), shown_source(source)
        if self._full():
            return self.refuse(
                name, source, f"this map takes {self.settings.most_photos} photos at most"
            )
        try:
            arrived = self.inbox.bring(blocks)
        except UnreadablePhotoError as error:
            return self.refuse(name, source, str(error))
        try:
            return self._enter(arrived, name, source)
        except OutputError:
            raise
        except Exception as error:  # whatever it is, it concerns this photo alone
            if system := of_the_system(error):
                raise system from error
            gone(arrived.path)
            log_error(self.ledger.path.parent, name, error)
            return self.refuse(name, source, rejected(name, error).reason)

    def take_file(self, path: Path, source: str) -> Accepted | Refused:
        """Accepts a copy of a file that is complete.

        Raises:
            FileNotFoundError: it is gone. OutputError: as `take`.
        """
        try:
            with open_regular(path) as file:
                return self.take(iter(lambda: file.read(1 << 20), b""), path.name, source)
        except FileNotFoundError:
            raise
        except OSError as error:
            reason = f"it cannot be read ({error.strerror or error})"
            return self.refuse(path.name, source, reason)

    def _full(self) -> bool:
        found = self.ledger.row("select count(*) from photo")
        return found is not None and found[0] >= self.settings.most_photos

    def refuse(self, name: str, source: str, reason: str) -> Refused:
        """Records a refused file and reports it."""
        name, source, reason = shown_name(name), shown_source(source), plain(reason, 500)
        self.ledger.refuse(name, source, reason)
        return Refused(name=name, reason=reason)

    def _enter(self, arrived: Arrived, name: str, source: str) -> Accepted | Refused:
        if arrived.anew:
            self.ledger.forget_refused(arrived.digest)
        known = self.ledger.row("select id, name from photo where digest = ?", arrived.digest)
        if known is not None:
            return Accepted(id=int(known[0]), name=str(known[1]), duplicate=True)
        photo = read_photo(
            arrived.path,
            name=name,
            thermal_unit=self.settings.thermal_unit,
            most_mp=self.settings.most_mp,
        )
        if isinstance(photo, RejectedPhoto):
            self.inbox.check()
            gone(arrived.path)
            if photo.trace:
                log_error(self.ledger.path.parent, f"{name}: {photo.reason}", photo.trace)
            return self.refuse(name, source, photo.reason)
        if photo.placed:
            gone(arrived.path)
            return self.refuse(name, source, IS_MAP)
        try:
            return self._row(arrived, photo, name, source)
        except OutputError:
            gone(arrived.path)
            raise

    def _row(self, arrived: Arrived, photo: Photo, name: str, source: str) -> Accepted | Refused:
        shot = shot_of(photo)
        with self.ledger.change() as db:
            known = self.ledger.row("select id, name from photo where digest = ?", arrived.digest)
            if known is not None:
                return Accepted(id=int(known[0]), name=str(known[1]), duplicate=True)
            same = self.ledger.rows(
                "select id, name, width from photo where shot = ? and (width != ? or (name = ? and"
                " source = ?)) and state not in ('superseded', 'refused')",
                shot,
                photo.width,
                name,
                source,
            )  # smaller ones, and the same file before it was written anew
            larger = next((n for _, n, w in same if w > photo.width), None)
            if larger is not None:
                gone(arrived.path)
                return self.refuse(
                    name, source, f"it is a smaller copy of {larger}, which was already received"
                )
            kept = self._of_other_band(photo)
            for number, _, _ in same:  # what the map does not know gives way at once
                db.execute(
                    "update photo set state = 'superseded' where id = ? and state = 'kept'",
                    (number,),
                )
            cursor = db.execute(
                "insert into photo(digest, name, source, file, bytes, received, shot, width, state,"
                " reason, about)"
                " values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (
                    arrived.digest,
                    name,
                    source,
                    arrived.path.name,
                    arrived.size,
                    time.time(),
                    shot,
                    photo.width,
                    "kept" if kept else "received",
                    kept,
                    json.dumps({"preview": [int(i) for i, _, _ in same]}),
                ),
            )
            number = int(cursor.lastrowid or 0)
            if photo.in_colours or photo.shows_a_band:
                db.execute("insert into band values (?, ?)", (number, _band(photo)))
            self.ledger.taken_after_all(name, source)
            said = {"id": number, "name": name, "source": source, "state": "received"}
            self.ledger.tell("photo", said | ({"state": "kept", "reason": kept} if kept else {}))
        hit("photo row committed")
        return Accepted(id=number, name=name, kept=kept)

    def _of_other_band(self, photo: Photo) -> str:
        """The reason why the map does not show a photo, which shows another band than it does, or
        colours; empty for others. It shows the band that is asked for, or what came first, until
        there is more of another: a map of all would be a patchwork of them.
        """
        if not (photo.in_colours or photo.shows_a_band):
            return ""
        asked = self.settings.band
        shown = self.ledger.meta(BAND) if asked is None else canonical(asked.lower())
        own = _band(photo)
        if shown is None:
            shown = own
            self.ledger.put_meta(BAND, shown)
            if shown:
                text = f"files of the band {shown} came first: the map shows it"
                text = f"{text}, and those of other bands are kept for the final map (--band)"
                self.ledger.tell("note", {"text": text})
        elif asked is None and own != shown and self._overtakes(own, str(shown)):
            shown = own
            self.ledger.put_meta(BAND, shown)
            self.ledger.put_meta(OTHER_BAND, True)
        return of_other_band(own, str(shown))

    def _overtakes(self, band: str, shown: str) -> bool:
        """Whether the map is better of a band, of which another file has come, than of what it
        shows.
        """
        query = "select count(*) from band where name = ?"
        own, others = (self.ledger.rows(query, name)[0][0] for name in (band, shown))
        if not band:
            return bool(own + 1 >= AS_MANY * others)
        return bool(own + 1 > MORE * (others if shown else others / AS_MANY))


def _band(photo: Photo) -> str:
    """The band that a photo shows, empty for colours."""
    return photo.band_name if photo.shows_a_band else ""


def of_other_band(band: str, shown: str) -> str:
    """Why a map of the band `shown` does not show a file of a band, either empty for photos in
    colours; empty if it does.
    """
    if band == shown:
        return ""
    own = f"it shows the band {band}" if band else "it is in colours"
    instead = f"the band {shown}" if shown else "the photos in colours"
    return f"{own}; the map shows {instead} (--band), and the final map may use it"


def shot_of(photo: Photo) -> str:
    """A key that a preview and the full photo of one shot share; empty for photos without capture
    time.
    """
    if photo.time is None or photo.position is None:
        return photo.digest
    size = f"{photo.width}x{photo.height}"
    camera = " ".join(part for part in photo.camera_key.split() if part != size)
    shape = round(photo.width / photo.height, 1)
    place = f"{photo.position.latitude_deg:.7f} {photo.position.longitude_deg:.7f}"
    return f"{camera}|{photo.band_name or photo.band}|{shape}|{photo.time.isoformat()}|{place}"
