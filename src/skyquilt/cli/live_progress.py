"""Progress of a live survey on a terminal: a line per photo, notes, and the progress bars of the
final map.
"""

import json
import sys
from collections.abc import Iterable
from dataclasses import asdict

from skyquilt.cli.progress import as_record, mosaic_summary
from skyquilt.live.update import Update
from skyquilt.model.event import Event, Note, Result, StageStarted


def show_live(events: Iterable[Event | Update], url: str, *, mode: str) -> None:
    """Consumes the events; mode `normal`, `quiet` or `json`."""
    if mode == "json":
        _line({"event": "ServerThread", "url": url})
    elif mode == "normal":
        sys.stdout.write(f"{url} shows the map; Ctrl-C ends, the same command continues\n")
    for happened in events:
        if mode == "json":
            _line(
                {"event": "Update", **asdict(happened)}
                if isinstance(happened, Update)
                else as_record(happened)
            )
        elif mode == "normal" and (text := sentence(happened)):
            sys.stdout.write(text + "\n")
        sys.stdout.flush()


def _line(record: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(record, default=str) + "\n")
    sys.stdout.flush()


def sentence(happened: Event | Update) -> str:
    """The line to print for an event; empty for events that are not printed."""
    if isinstance(happened, Note):
        return happened.text
    if isinstance(happened, Result):
        return mosaic_summary(happened)
    if isinstance(happened, StageStarted):
        return f"final map: {happened.stage}"
    if isinstance(happened, Update) and happened.what in (
        "placed",
        "waiting",
        "refined",
        "loose",
        "refused",
        "closed",
    ):
        told = (
            f"photo {happened.photo} {happened.what}"
            if happened.photo is not None
            else happened.what
        )
        return f"{told}{': ' + happened.text if happened.text else ''}"
    return ""
