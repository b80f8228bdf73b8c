"""`skyquilt mosaic` with control points, in a process of its own, into a folder beside the run."""

import json
import os
import subprocess
import sys
import threading
import tomllib
from pathlib import Path
from typing import Any

from skyquilt.errors import SideFileError
from skyquilt.outside import plain, read_bounded
from skyquilt.runs.layers import figures_of
from skyquilt.server.control_list import FOLDER
from skyquilt.settings import MosaicSettings

LOG = "mosaic.log"
ENDING = "-control"
"""Added to the name of the run's folder for that of the new one."""
WORDS = {
    "gsd_cm": "gsd", "shutter_readout_ms": "shutter-readout", "feather_px": "feather",
    "contours_m": "contours", "height_m": "height", "heading_deg": "heading",
}  # fmt: skip
"""Names of options that differ from those of their settings."""
TAKEN = (
    "gsd_cm", "method", "geo", "cameras", "distances", "sequence", "features", "detector",
    "matcher", "estimator", "transform", "distortion", "shutter", "shutter_readout_ms",
    "height_m", "surface",
    "vertical_datum", "boundary", "blend", "feather_px", "max_view_angle", "compress", "quality",
    "contours_m", "thermal_unit", "max_mp", "seed", "heading_deg",
)  # fmt: skip
"""Settings of the run that are taken over."""
SWITCHES = {"repair": "trust-metadata", "balance": "no-balance"}


def options_of(folder: Path) -> list[str]:
    """The options that made a run, from its run.toml, as far as they differ from the defaults.

    Raises:
        SideFileError: the file cannot be read.
    """
    try:
        settings = tomllib.loads(read_bounded(folder / "run.toml").decode())["settings"]
    except (OSError, ValueError, KeyError, RecursionError) as error:
        raise SideFileError(f"{folder / 'run.toml'} cannot be read; make the map again") from error
    usual = MosaicSettings().as_table()
    words = [
        f"--{WORDS.get(k, k.replace('_', '-'))}={settings[k]}"
        for k in TAKEN
        if k in settings and settings[k] != usual.get(k)
    ]
    words += [f"--{word}" for k, word in SWITCHES.items() if settings.get(k) is False]
    if settings.get("dtm") is True:
        words.append("--dtm")
    for key, word in (("bounds", "bounds"), ("lever_arm", "lever-arm")):
        if isinstance(settings.get(key), list):
            words.append(f"--{word}={','.join(str(v) for v in settings[key])}")
    return words


class ControlRun:
    """One run at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.output = self.folder.with_name(self.folder.name + ENDING)
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()

    def start(self, photos: Path, gcp: Path, crs: str) -> bool:
        """Starts the run; False if one is running.

        Raises:
            SideFileError: the run's settings cannot be read.
        """
        words = [
            sys.executable, "-m", "skyquilt", "mosaic", str(photos.resolve()),
            f"--output={self.output}", f"--gcp={gcp}", f"--crs={crs}", "--overwrite", "--json",
            *options_of(self.folder),
        ]  # fmt: skip
        with self._lock:
            if self._process is not None and self._process.poll() is None:
                return False
            with (self.folder / FOLDER / LOG).open("wb") as log:
                self._process = subprocess.Popen(
                    words,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env={**os.environ, "PYTHONIOENCODING": "utf-8"},  # as it is read
                )
        return True

    def state(self) -> dict[str, Any]:
        """What a client is shown: `state` (none, running, done, failed), the stage, the reason of a
        failure, and the residuals.
        """
        if self._process is None:
            return {"state": "none"}
        lines = self._log()
        code = self._process.poll()
        if code is None:
            stages = [e["stage"] for e in lines if isinstance(e, dict) and "stage" in e]
            return {"state": "running", "stage": stages[-1] if stages else "start"}
        if code:
            said = [line for line in lines if isinstance(line, str) and line.strip()]
            return {"state": "failed", "text": plain(said[-1], 400) if said else f"code {code}"}
        figures = figures_of(self.output)
        return {
            "state": "done",
            "folder": str(self.output),
            "control": figures.get("control", []),
            "height_offset_m": figures.get("control_height_offset_m"),
        }

    def _log(self) -> list[Any]:
        try:
            text = read_bounded(self.folder / FOLDER / LOG)[-20_000:].decode("utf-8", "replace")
        except OSError:
            return []
        found: list[Any] = []
        for line in text.splitlines():
            try:
                found.append(json.loads(line) if line.startswith("{") else line)
            except ValueError:
                continue
        return found
