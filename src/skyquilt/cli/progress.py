"""Events on a terminal: a bar per stage with the time left, JSON lines, or silence."""

import json
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from skyquilt.model.event import Event, Note, Result, StageFinished, StageProgress, StageStarted
from skyquilt.outside import shown

if TYPE_CHECKING:
    from rich.console import Console

    from skyquilt.live.events import Update
    from skyquilt.runs.export import Export


def show_live(events: Iterable["Event | Update"], url: str, *, mode: str) -> None:
    """Consumes the events; mode `normal`, `quiet` or `json`."""
    from skyquilt.live.events import Update  # not loaded for `mosaic`

    if mode == "json":
        _line({"event": "ServerThread", "url": url})
    elif mode == "normal":
        sys.stdout.write(f"{url} shows the map; Ctrl-C ends, the same command continues\n")
        sys.stdout.flush()  # into a log too, before the first photo arrives
    for happened in events:
        if mode == "json":
            _line(
                {"event": "Update", **asdict(happened)}
                if isinstance(happened, Update)
                else as_record(happened)
            )
        elif mode == "normal" and (text := sentence(happened)):
            sys.stdout.write(shown(text) + "\n")
        sys.stdout.flush()


def _line(record: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(record, default=str) + "\n")
    sys.stdout.flush()


def sentence(happened: "Event | Update") -> str:
    """The line to print for an event; empty for events that are not printed."""
    from skyquilt.live.events import Update

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


def show(
    events: Iterable[Event], *, mode: str, summary: Callable[[Result], str] | None = None
) -> None:
    """Consumes the events of a workflow and reports them: mode `normal`, `verbose`, `quiet` or
    `json`.

    `summary` puts the result in a few lines; that of a mosaic if none is given.
    """
    if mode == "json":
        for happened in events:
            sys.stdout.write(json.dumps(as_record(happened), default=str) + "\n")
            sys.stdout.flush()
    elif mode == "quiet":
        for _ in events:
            pass
    else:
        _bars(events, summary or mosaic_summary, verbose=mode == "verbose")


def as_record(happened: Event) -> dict[str, Any]:
    """The event with its name, ready for JSON."""
    if isinstance(happened, Result):
        return {
            "event": "Result",
            "output": str(happened.output),
            "metrics": dict(happened.metrics),
        }
    return {"event": type(happened).__name__, **asdict(happened)}


def _bars(events: Iterable[Event], summary: Callable[[Result], str], *, verbose: bool) -> None:
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_terminal:
        result = _on_terminal(events, console, verbose=verbose)
    else:
        from skyquilt.cli.progress_lines import ProgressLines

        with ProgressLines(write=_error_line, verbose=verbose) as lines:
            result = lines.follow(events)
    Console().print(shown(summary(result)), markup=False, highlight=False, soft_wrap=True)


def _error_line(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def _on_terminal(events: Iterable[Event], console: "Console", *, verbose: bool) -> Result:
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description:<9}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[what]}"),
    )
    with Progress(*columns, console=console) as progress:
        tasks: dict[str, Any] = {}
        for happened in events:
            if isinstance(happened, StageStarted):
                tasks[happened.stage] = progress.add_task(happened.stage, total=None, what="")
            elif isinstance(happened, StageProgress):
                progress.update(
                    tasks[happened.stage],
                    completed=happened.done,
                    total=happened.total,
                    what=happened.what,
                )
            elif isinstance(happened, StageFinished):
                progress.update(tasks[happened.stage], completed=1, total=1, what="")
                if verbose:
                    progress.console.print(times(happened))
            elif isinstance(happened, Note):
                progress.console.print(
                    shown(happened.text),
                    style="yellow" if happened.warning else None,
                    markup=False,
                    highlight=False,
                    soft_wrap=True,
                )
            elif isinstance(happened, Result):
                result = happened
    return result


def show_exports(exports: "Iterable[Export]", *, mode: str) -> None:
    """Reports each export when it is written."""
    for done in exports:
        if mode == "json":
            _line({"event": "Export", "path": str(done.path), "note": done.note})
        elif mode != "quiet":
            note = f" ({done.note})" if done.note else ""
            sys.stdout.write(f"export: {done.path}{note}\n")
            sys.stdout.flush()


def times(happened: StageFinished) -> str:
    """A finished stage in a line."""
    how = " (from an earlier run)" if happened.reused else ""
    return f"{happened.stage}: {happened.seconds:.2f} s, {happened.cpu_seconds:.2f} s of CPU{how}"


def mosaic_summary(result: Result) -> str:
    """A summary of a mosaic in a few lines."""
    m = result.metrics
    lines = [
        f"{m['photos_used']} of {m['photos_total']} photos in {len(m['blocks'])} block(s),"
        f" method {m['method']}: {m['why']}",
        f"map: {m['size_px'][0]} x {m['size_px'][1]} px at {m['gsd_m'] * 100:g} cm,"
        f" {m['crs'] or 'not georeferenced'}",
    ]
    if m["reprojection_error_px"]:
        seam = m["seam_disparity_px"]
        lines.append(
            f"reprojection error {m['reprojection_error_px']['mean']:.2f} px, seams"
            f" {seam['median']} px"
            f" (median; {seam['measured']} of {seam['attempted']} measured)"
        )
    for rejected in (m["photos_rejected"], m.get("thermal", {}).get("photos_rejected", {})):
        lines += [f"left out: {name}: {reason}" for name, reason in list(rejected.items())[:10]]
    lines += [f"warning: {told}" for told in m.get("warnings", [])]
    if m["metadata_conflicts"]:
        lines.append(
            f"contradictions between metadata and images: {len(m['metadata_conflicts'])}, see the"
            " report"
        )
    lines.append(
        f"{m['seconds']['total']:.1f} s, {m['cpu_seconds']:.1f} s of CPU, {m['peak_memory_mb']} MB"
    )
    lines += [f"map:    {result.output / 'mosaic.tif'}", f"report: {result.output / 'report.html'}"]
    return "\n".join(lines)
