"""The workflow of `strip-test`: Y Figures 4.5 and 6.5 reproduced with simulated strips."""

import json
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from skyquilt.engine.folder import make_folder
from skyquilt.errors import OutputError, UsageError
from skyquilt.model.event import Event, Result, StageFinished, StageProgress, StageStarted
from skyquilt.outside import remove_file
from skyquilt.papers.strip_chain import VARIANTS, calibrated, chained
from skyquilt.papers.strip_page import strip_page
from skyquilt.raster.atomic import write_text
from skyquilt.simulate import StripSettings, fly_strip
from skyquilt.version import __version__

FILES = ("strip.json", "report.html")


def iter_strip_test(
    output: Path,
    settings: StripSettings | None = None,
    *,
    flights: int = 5,
    overwrite: bool = False,
) -> Iterator[Event]:
    """Simulates strips with different seeds, mosaics each in nine variants, writes strip.json and
    report.html; yields events.

    Raises:
        UsageError: invalid settings.
        OutputError: the folder already contains a result, or cannot be written.
        RefusedError: two photos of a strip cannot be registered.
    """
    settings = (settings or StripSettings()).checked()
    if not 1 <= flights <= 100:
        raise UsageError(f"flights must be 1 to 100, not {flights}")
    output = Path(output)
    _make_room(output, overwrite)
    begun = time.perf_counter(), time.process_time()
    yield StageStarted(stage="strip", total=flights * len(VARIANTS))
    etas, rms = np.zeros((flights, len(VARIANTS), settings.photos)), []
    for k in range(flights):
        flown = replace(settings, seed=settings.seed + k)
        strip = fly_strip(flown)
        cameras = calibrated(strip, flown)
        rms.append({order: error for order, (_, error) in cameras.items()})
        for j, variant in enumerate(VARIANTS):
            etas[k, j] = chained(strip, flown, cameras[variant.distortion][0], variant)
            done = k * len(VARIANTS) + j + 1
            yield StageProgress(stage="strip", done=done, total=flights * len(VARIANTS))
    seconds, cpu = time.perf_counter() - begun[0], time.process_time() - begun[1]
    yield StageFinished(
        stage="strip", seconds=round(seconds, 3), cpu_seconds=round(cpu, 3), reused=False
    )
    found = _figures(settings, etas, rms, cpu)
    write_text(output / "report.html", strip_page(found))
    write_text(output / "strip.json", json.dumps(found, indent=1))
    yield Result(output=output, metrics=found)


def _make_room(output: Path, overwrite: bool) -> None:
    """Creates the folder, and removes a former result."""
    make_folder(output)
    try:
        taken = [name for name in FILES if (output / name).exists()]
        if taken and not overwrite:
            raise OutputError(
                f"{output} already holds {taken[0]}; add --overwrite to replace it, or choose"
                " another folder"
            )
        for name in reversed(taken):
            remove_file(output / name)
    except OSError as error:
        raise OutputError(
            f"cannot write to {output}: {error.strerror or error}; choose another folder"
        ) from error


def _figures(
    settings: StripSettings, etas: np.ndarray, rms: list[dict[str, float]], cpu: float
) -> dict[str, Any]:
    """The content of strip.json: eta (4.7) of each photo's board per variant, median over the
    flights, and the ends.
    """
    variants = [
        {
            **asdict(variant),
            "calibration_rms_px": round(float(np.median([r[variant.distortion] for r in rms])), 4),
            "eta": [None if np.isnan(v) else round(float(v), 4) for v in np.median(etas[:, j], 0)],
            "eta_end": [round(float(e[np.isfinite(e)][-1]), 4) for e in etas[:, j]],
        }
        for j, variant in enumerate(VARIANTS)
    ]
    return {
        "version": __version__,
        "flights": len(etas),
        "settings": asdict(settings),
        "variants": variants,
        "cpu_seconds": round(cpu, 2),
    }
