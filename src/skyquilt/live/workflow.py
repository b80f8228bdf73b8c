"""The live workflow as events: folders are watched, photos mapped, and the final map made on
request.
"""

import sqlite3
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from skyquilt.engine.error_log import NAME as ERRORS
from skyquilt.engine.error_log import log_error
from skyquilt.errors import OutputError, SkyquiltError
from skyquilt.live.events import Update
from skyquilt.live.fill import iter_fill
from skyquilt.live.final_map import iter_finish
from skyquilt.live.folder_watch import Watch
from skyquilt.live.ledger import Ledger
from skyquilt.live.live_map import PHOTOS, LiveMap
from skyquilt.live.photo_intake import Refused
from skyquilt.live.settings import LiveSettings
from skyquilt.live.uploaded_clips import UploadedClips
from skyquilt.model.event import Event, Note, Result
from skyquilt.outside import is_folder

IDLE_S = 0.01
"""Pause in s between checks when there is nothing to do."""
OVER_S = 60.0
"""Without `finish`: the flight is over, as far as a follow-up is concerned, after so many seconds
without a photo.
"""
FULL_S = 2.0
"""Pause in s when the disk is full."""
GONE_S = 120.0
"""The map ends where its folder has been gone for this time in s; a network disk comes back
before.
"""
INTERRUPTED = "the final map was interrupted; asked for again, it goes on where it stopped"
STEADY_S = 5.0
"""With `finish`: if no photo arrives for this time in s, the flight is over."""


def iter_live(
    folders: Sequence[Path],
    live: LiveMap,
    *,
    finish: bool = False,
    fill: bool = False,
    stop: threading.Event | None = None,
) -> Iterator[Event | Update]:
    """Maps photos as they arrive in folders or otherwise in `live`, until `stop`.

    `finish`: makes the final map and ends when no photo has arrived for some seconds; `fill`: plans
    what is missing when the flight has ended. Every pause and refusal is reported.

    Raises:
        UsageError: a folder is missing. OutputError: the survey's folder was removed or replaced.
    """
    stop = stop or threading.Event()
    if live.ledger.meta("finish") == "running":
        _ended(live, "failed", INTERRUPTED)
    watches: list[Watch | UploadedClips] = [Watch(folder=f, intake=live.intake) for f in folders]
    watches.append(UploadedClips(intake=live.intake))
    busy_since = time.monotonic()
    filled = not fill
    away, failing = set[Path](), ""
    there = time.monotonic()
    while not stop.is_set():
        there = _still_there(live, there)
        try:
            yield from _away(folders, away, live.ledger)
            yield from _taken(watches)
            update = live.work()
        except (OutputError, sqlite3.Error) as error:
            if str(error) != failing:  # once, however long a disk is full
                failing = str(error)
                with suppress(OutputError, sqlite3.Error):  # for the page, where there is room
                    live.ledger.tell("note", {"text": failing})
                yield Note(text=failing, warning=True)
            stop.wait(FULL_S)
            continue
        failing = ""
        if update is not None:
            busy_since = time.monotonic()
            filled = filled and not (fill and update.what == "placed")
            yield update
            continue
        growing = any(w.growing for w in watches) or live.background.busy
        over = STEADY_S if finish else OVER_S
        if not filled and not growing and time.monotonic() - busy_since > over:
            filled = True
            yield from iter_fill(live.folder, live.ledger, live.folder / PHOTOS)
        if finish and not growing and time.monotonic() - busy_since > STEADY_S:
            yield from _finished(live, live.settings)
            return
        if live.ledger.meta("finish") == "asked" and not growing:
            yield from _finished(live, live.settings)
        stop.wait(IDLE_S)


def _still_there(live: LiveMap, since: float) -> float:
    """When the survey's folder was seen last, in monotonic seconds; `since`: before now.

    Raises:
        OutputError: it has been gone for long, or is another one: what is written to the files that
            are open would be lost.
    """
    now, known = time.monotonic(), live.ledger.in_place
    if known is False or (known is None and now - since > GONE_S):
        raise OutputError(
            f"{live.folder} was removed or replaced while the map grew there, and what it held is"
            " gone; the same command begins again, with the photos that are in their folders"
        )
    return now if known else since


def _away(folders: Sequence[Path], away: set[Path], ledger: Ledger) -> Iterator[Event]:
    """Tells once where a folder of photos is gone, such as one on a disk or in a network, and when
    it is back; `away` are those that were gone.
    """
    for folder in folders:
        if is_folder(folder) == (folder not in away):
            continue
        away ^= {folder}
        text = f"{folder} is there again"
        if folder in away:
            text = f"{folder} cannot be found or read; no photo arrives from there until it is back"
        ledger.tell("note", {"text": text})
        yield Note(text=text, warning=folder in away)


def _taken(watches: Sequence[Watch | UploadedClips]) -> Iterator[Event]:
    for watch in watches:
        for done in watch.look():
            if isinstance(done, Refused):
                yield Note(text=f"{done.name} was left out: {done.reason}", warning=True)


def _finished(live: LiveMap, settings: LiveSettings) -> Iterator[Event]:
    """Makes the final map; a failure is reported and the live map continues."""
    live.ledger.put_meta("finish", "running")
    live.ledger.tell("finish", {"state": "running", "text": "the final map is being made"})
    try:
        for happened in iter_finish(live.folder, settings):
            yield happened
            if isinstance(happened, Result):
                _ended(live, "done", "the final map is ready, beside the live one")
    except Exception as error:  # the live map goes on, whatever happens to the final one
        if not isinstance(error, SkyquiltError):
            log_error(live.folder, "the final map", error)
            error = SkyquiltError(f"{type(error).__name__}, see {ERRORS}")
        _ended(live, "failed", f"no final map: {error}")
        yield Note(text=f"no final map: {error}", warning=True)


def _ended(live: LiveMap, state: str, text: str) -> None:
    """Records how the final map ended, unless it was asked for again meanwhile: then it is due."""
    if live.ledger.meta("finish") == "running":
        live.ledger.put_meta("finish", state)
    live.ledger.tell("finish", {"state": state, "text": text})
