"""Tables 6.4 and 6.5 of the thesis for any list of pairs, with a comparison to the true
registration, which the thesis did not have.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt import registry
from skyquilt.coregistration.error_field import overlap_corners
from skyquilt.coregistration.pictures import guess_of, open_picture
from skyquilt.coregistration.stated_error import StatedError
from skyquilt.coregistration.workflow import outcome_of, within_tolerance
from skyquilt.engine.clock import Clock, cpu_seconds
from skyquilt.engine.folder import claimed
from skyquilt.geometry.transforms import transfer
from skyquilt.model.event import Event, Note, Result, StageFinished, StageProgress, StageStarted
from skyquilt.model.photo import RejectedPhoto
from skyquilt.model.registration import Matrix, RefusedRegistration, Registration
from skyquilt.papers.bench_page import bench_page
from skyquilt.papers.pair_list import Pair, overlap_error, read_pairs
from skyquilt.raster.atomic import write_text
from skyquilt.settings import one_of
from skyquilt.version import __version__

CONTRACT = ("bench.json", "report.html")
"""Files of a finished run."""
DEFAULT = ("auto", "sift", "surf", "usurf", "rfae", "surf+rfae")
"""Methods compared by default: the default method and the columns of Tables 6.4 and 6.5."""
STAGE = "pairs"


def iter_spectral_bench(
    pairs: Path | str,
    output: Path | str,
    methods: Sequence[str] = DEFAULT,
    *,
    overwrite: bool = False,
) -> Iterator[Event]:
    """Registers every pair of a list by every method; the last event is the `Result`.

    Raises:
        UsageError: an unknown method.
        SideFileError: a malformed list.
        OutputError: the output cannot be written.
    """
    output = Path(output)
    for name in methods:
        one_of("--method", name, registry.names("registration"))
    listed = read_pairs(Path(pairs))
    with claimed(output, CONTRACT, overwrite=overwrite):
        began, total = Clock.now(), len(listed) * len(methods)
        yield StageStarted(stage=STAGE, total=total)
        rows: list[dict[str, Any]] = []
        for pair in listed:
            for method in methods:
                rows.append(judged(pair, method))
                yield StageProgress(stage=STAGE, done=len(rows), total=total)
        seconds, cpu = Clock.now()
        yield StageFinished(
            stage=STAGE,
            seconds=round(seconds - began[0], 3),
            cpu_seconds=round(cpu - began[1], 3),
            reused=False,
        )
        for line in totals(rows, methods):
            yield Note(text=line)
        record = {
            "pairs": rows,
            "methods": list(methods),
            "list": str(pairs),
            "version": __version__,
        }
        write_text(output / "report.html", bench_page(record))
        write_text(output / "bench.json", json.dumps(record, indent=1, allow_nan=False) + "\n")
    yield Result(output=output, metrics=record)


def judged(pair: Pair, method: str) -> dict[str, Any]:
    """One row of bench.json: a pair registered by a method and compared with the truth."""
    since = cpu_seconds()
    outcome, stated, shapes = _registered(pair, method)
    spent = round(cpu_seconds() - since, 3)
    row = {"class": pair.kind, "source": pair.source, "method": method}
    if isinstance(outcome, RefusedRegistration):
        return row | {
            "accepted": False,
            "right": False,
            "error_px": None,
            "corner_px": None,
            "stated_px": stated and round(stated.error_px, 3),
            "q": 0.0,
            "inliers": outcome.inliers,
            "seconds": spent,
            "reason": outcome.reason,
        }
    error = min(overlap_error(outcome.b_H_a, pair.b_H_a, *shapes), 1e6)
    return row | {
        "accepted": True,
        "right": error < pair.tolerance_px,
        "error_px": round(error, 3),
        "corner_px": round(min(corner_error(outcome.b_H_a, pair.b_H_a, *shapes), 1e6), 3),
        "stated_px": stated and round(stated.error_px, 3),
        "q": round(outcome.q, 4),
        "inliers": len(outcome.px_a),
        "seconds": spent,
        "reason": outcome.note,
    }


def totals(rows: Sequence[dict[str, Any]], methods: Sequence[str]) -> list[str]:
    """A sentence per method."""
    lines = []
    for method in methods:
        of = [r for r in rows if r["method"] == method]
        accepted, right = sum(r["accepted"] for r in of), sum(r["right"] for r in of)
        time = sum(r["seconds"] for r in of) / len(of)
        lines.append(
            f"{method}: {accepted} of {len(of)} accepted, {right} right, {accepted - right} wrong;"
            f" {time:.2f} s of CPU a pair"
        )
    return lines


def corner_error(
    b_H_a: Matrix, truth: Matrix, shape_a: tuple[int, int], shape_b: tuple[int, int]
) -> float:
    """Largest distance in px of b between the positions by two transforms, over the corners of the
    part of a (H, W) that b (H, W) covers: what a stated error is compared with.
    """
    corners = overlap_corners(b_H_a, shape_a, shape_b)
    apart = transfer(np.asarray(truth @ np.linalg.inv(b_H_a), np.float64), corners) - corners
    distance = float(np.linalg.norm(apart, axis=1).max())
    return distance if np.isfinite(distance) else float("inf")


def _registered(
    pair: Pair, method: str
) -> tuple[
    Registration | RefusedRegistration, StatedError | None, tuple[tuple[int, int], tuple[int, int]]
]:
    opened = [open_picture(path) for path in (pair.a, pair.b)]
    a, b = opened
    for name, one in zip("AB", opened, strict=True):
        if isinstance(one, RejectedPhoto):
            refusal = RefusedRegistration(
                reason=f"picture {name} ({one.name}) cannot be used: {one.reason}"
            )
            return refusal, None, ((0, 0), (0, 0))
    assert not isinstance(a, RejectedPhoto) and not isinstance(b, RejectedPhoto)
    found, stated = within_tolerance(outcome_of(a, b, method, guess_of(a, b)), a, b, None)
    return found, stated, ((a.height, a.width), (b.height, b.width))
