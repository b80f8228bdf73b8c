"""The workflow of two pictures: read, register, draw, report.

A is the reference; b_H_a takes its pixels to B's. A refusal is a result too: it is written down,
and raised.
"""

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt.coregistration.files import CONTRACT, draw, page
from skyquilt.coregistration.methods import RegisterSettings, registration_method
from skyquilt.coregistration.pictures import Source, common_parts, guess_of, open_picture
from skyquilt.coregistration.places import beside_m
from skyquilt.coregistration.stated_error import StatedError, state_error, tolerated
from skyquilt.engine.clock import cpu_seconds
from skyquilt.engine.folder import claimed
from skyquilt.errors import RefusedError
from skyquilt.model.event import Event, Note, Result, StageFinished, StageStarted
from skyquilt.model.photo import RejectedPhoto
from skyquilt.model.registration import Guess, Outcome, RefusedRegistration, Registration
from skyquilt.quality.registration_quality import spread_quality
from skyquilt.raster.atomic import write_text
from skyquilt.typed import as_path, instance
from skyquilt.version import __version__

FAR_M = 100.0
"""Distance in m of a map from its place that a note tells: more than any receiver is off."""
STAGES = ("read", "register", "draw")
"""Stages in order; a refusal has nothing to draw."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Told:
    """A registration in px of the files, with what it was made from."""

    outcome: Outcome
    stated: StatedError | None
    guess: Guess | None
    cpu_s: float
    beside_m: float | None = None
    """How far in m B lies beside its place by its own file."""


def iter_register(
    a: Path | str,
    b: Path | str,
    output: Path | str,
    settings: RegisterSettings | None = None,
    *,
    overwrite: bool = False,
) -> Iterator[Event]:
    """Registers picture B to picture A, telling its progress; the last event is the `Result`.

    Raises:
        RefusedError: there is no registration to be trusted; raised after the `Result`.
        SkyquiltError: anything else a user can correct.
    """
    settings = instance("settings", settings, RegisterSettings)
    a, b, output = as_path("a", a), as_path("b", b), as_path("output", output)
    opened = open_picture(Path(a)), open_picture(Path(b))
    with claimed(output, CONTRACT, overwrite=overwrite):
        yield StageStarted(stage="register", total=1)
        began, cpu = time.perf_counter(), cpu_seconds()
        told = _told(opened, settings)
        yield StageFinished(
            stage="register",
            seconds=round(time.perf_counter() - began, 3),
            cpu_seconds=round(cpu_seconds() - cpu, 3),
            reused=False,
        )
        record = as_record(told.outcome, settings.method, told.guess, told.stated)
        record |= {
            "a": str(a),
            "b": str(b),
            "beside_m": None if told.beside_m is None else round(told.beside_m, 2),
            "cpu_seconds": round(told.cpu_s, 3),
            "version": __version__,
        }
        if isinstance(told.outcome, Registration):
            if told.outcome.note:
                yield Note(text=told.outcome.note)
            yield from _drawn(output, opened, told.outcome)
        _write(output, record, opened, told.outcome)
    yield Result(output=output, metrics=record)
    if isinstance(told.outcome, RefusedRegistration):
        raise RefusedError(f"refused: {told.outcome.reason}")


def register(
    a: Path | str,
    b: Path | str,
    output: Path | str,
    settings: RegisterSettings | None = None,
    *,
    overwrite: bool = False,
) -> Result:
    """Registers picture B to picture A and returns when the files are written, refused or not.

    Raises:
        SkyquiltError: anything a user can correct. A refusal is part of the result.
    """
    for happened in iter_register(a, b, output, settings, overwrite=overwrite):
        if isinstance(happened, Result):
            return happened
    raise RuntimeError("the workflow ended without a result")


def outcome_of(a: Source, b: Source, method: str, guess: Guess | None) -> Outcome:
    """The registration of two opened pictures by a named method, in px of the files, with Q
    over A.
    """
    outcome = registration_method(method)(a.picture, b.picture, guess)
    if isinstance(outcome, RefusedRegistration):
        return outcome
    full_a, full_b = a.full_S_picture, b.full_S_picture
    matrix = full_b @ outcome.b_H_a @ np.linalg.inv(full_a)
    error = outcome.lens_error if _through_lens(a, b) else outcome.error
    error = error and error.seen_in(full_b)
    if outcome.model == "similarity" and not _similar(matrix):
        outcome = replace(outcome, model="affine")  # of files whose pixels are longer than wide
    if _same(a, b):
        outcome = replace(
            outcome,
            model="identity",
            note="A and B are the same picture: it lies on itself, unmoved.",
        )
        matrix = np.eye(3)
        error = error and replace(error, covariance=np.zeros((8, 8)), shared=0.0, departure=None)
    px_a, px_b = _scaled(outcome.px_a, full_a), _scaled(outcome.px_b, full_b)
    q = spread_quality(px_a, a.width, a.height, delta=0.1 * a.width)
    return replace(outcome, b_H_a=matrix / matrix[2, 2], px_a=px_a, px_b=px_b, q=q, error=error)


def _of_files(a: Source, b: Source, method: str, guess: Guess | None) -> Outcome:
    """The same of whole files; where a part of a large map is in the other one, the parts are
    tried first, at their own resolution.
    """
    parts = common_parts(a, b) if guess is not None else None
    if parts is not None and (near := guess_of(*parts)) is not None:
        found = outcome_of(*parts, method, near)
        if isinstance(found, Registration):
            return found
    return outcome_of(a, b, method, guess)


def within_tolerance(
    outcome: Outcome, a: Source, b: Source, tolerance_px: float | None
) -> tuple[Outcome, StatedError | None]:
    """The outcome, refused if its error over the picture is larger than tolerated, and what it
    states; None if it states nothing.
    """
    if isinstance(outcome, RefusedRegistration):
        return outcome, None
    stated = state_error(outcome, (a.height, a.width), (b.height, b.width), tolerance_px)
    bent = tolerance_px is None and _through_lens(a, b)
    return tolerated(outcome, stated, bent=bent), stated


def as_record(
    outcome: Outcome, method: str, guess: Guess | None, stated: StatedError | None
) -> dict[str, Any]:
    """What registration.json says."""
    shared = {
        "method": method,
        "guess": guess.source if guess else None,
        "evidence": dict(outcome.evidence),
        **_error_record(stated),
    }
    if isinstance(outcome, RefusedRegistration):
        return {
            "accepted": False,
            "model": None,
            "b_H_a": None,
            "inliers": outcome.inliers,
            "q": 0.0,
            "reason": outcome.reason,
            "residual_px": None,
            **shared,
        }
    return {
        "accepted": True,
        "model": outcome.model,
        "b_H_a": outcome.b_H_a.tolist(),
        "inliers": len(outcome.px_a),
        "q": round(outcome.q, 4),
        "reason": outcome.note,
        "residual_px": residual(outcome),
        **shared,
    }


def _error_record(stated: StatedError | None) -> dict[str, Any]:
    if stated is None:
        return {"error_px": None, "tolerance_px": None, "error_corners": [], "valid_area": None}
    corners = np.c_[stated.corners_a, stated.corners_px]
    return {
        "error_px": round(stated.error_px, 3),
        "tolerance_px": round(stated.tolerance_px, 3),
        "error_corners": np.round(corners, 3).tolist(),
        "valid_area": {
            "share": round(stated.valid_share, 4),
            "polygon": np.round(stated.valid_a, 2).tolist(),
        },
    }


def residual(outcome: Registration) -> float | None:
    """RMS distance in px of B between the inliers and where the transform puts them; None without
    inliers.
    """
    if not len(outcome.px_a):
        return None
    there = np.c_[outcome.px_a, np.ones(len(outcome.px_a))] @ outcome.b_H_a.T
    off = there[:, :2] / there[:, 2:] - outcome.px_b
    return round(float(np.sqrt((off**2).sum(1).mean())), 3)


def _told(
    opened: tuple[Source | RejectedPhoto, Source | RejectedPhoto], settings: RegisterSettings
) -> _Told:
    since = cpu_seconds()
    for name, one in zip("AB", opened, strict=True):
        if isinstance(one, RejectedPhoto):
            reason = f"picture {name} ({one.name}) cannot be used: {one.reason}"
            refusal = RefusedRegistration(reason=reason)
            return _Told(outcome=refusal, stated=None, guess=None, cpu_s=0.0)
    a, b = opened
    assert isinstance(a, Source) and isinstance(b, Source)
    guess = guess_of(a, b) if settings.use_metadata else None
    outcome, stated = within_tolerance(
        _of_files(a, b, settings.method, guess), a, b, settings.tolerance_px
    )
    beside = None
    if isinstance(outcome, Registration) and a.place and b.place:
        beside = beside_m(a.place, b.place, outcome.b_H_a)
        if beside is not None and beside > FAR_M and not outcome.note:
            outcome = replace(
                outcome,
                note=f"By what the files say the maps lie {_length(beside)} apart; the registration"
                " is by their pictures alone, so check that both show the same place.",
            )
    return _Told(
        outcome=outcome, stated=stated, guess=guess, cpu_s=cpu_seconds() - since, beside_m=beside
    )


def _through_lens(a: Source, b: Source) -> bool:
    return a.through_lens or b.through_lens


def _length(metres: float) -> str:
    return f"{metres / 1000:.1f} km" if metres >= 1000 else f"{metres:.0f} m"


def _similar(matrix: np.ndarray) -> bool:
    """Whether a transform keeps shapes, mirrored or not."""
    x, y = matrix[:2, 0], matrix[:2, 1]
    size = max(float(x @ x), float(y @ y))
    return abs(float(x @ x - y @ y)) < 0.01 * size and abs(float(x @ y)) < 0.01 * size


def _same(a: Source, b: Source) -> bool:
    va, vb = a.picture.values, b.picture.values
    if va.shape != vb.shape or not np.array_equal(a.full_S_picture, b.full_S_picture):
        return False
    return np.array_equal(va, vb, equal_nan=va.dtype.kind == "f")


def _scaled(px: np.ndarray, full: np.ndarray) -> np.ndarray:
    return np.asarray(px @ full[:2, :2].T + full[:2, 2])


def _drawn(
    output: Path,
    opened: tuple[Source | RejectedPhoto, Source | RejectedPhoto],
    outcome: Registration,
) -> Iterator[Event]:
    a, b = opened
    assert isinstance(a, Source) and isinstance(b, Source)
    began, cpu = time.perf_counter(), cpu_seconds()
    yield StageStarted(stage="draw", total=1)
    draw(output, a, b, outcome)
    yield StageFinished(
        stage="draw",
        seconds=round(time.perf_counter() - began, 3),
        cpu_seconds=round(cpu_seconds() - cpu, 3),
        reused=False,
    )


def _write(
    output: Path,
    record: dict[str, Any],
    opened: tuple[Source | RejectedPhoto, Source | RejectedPhoto],
    outcome: Outcome,
) -> None:
    write_text(output / "report.html", page(record, opened, outcome))
    write_text(output / "registration.json", json.dumps(record, indent=1, allow_nan=False) + "\n")
