"""How a camera exposes the rows of a photo: all at once, or one after the other."""

import csv
from functools import cache
from importlib.resources import files

from skyquilt.model.photo import Shutter

_GUESS_S, _GUESS_SIGMA_S = 0.030, 0.015
_UNKNOWN_SIGMA_S = 0.010
_TABLE_SHARE = 0.10
_OPTION_SHARE = 0.03


@cache
def _table() -> dict[str, tuple[tuple[float, float], ...]]:
    """Model in plain letters -> (megapixels below which the row applies, readout in s)."""
    text = files("skyquilt.photos").joinpath("shutters.csv").read_text("utf-8")
    table: dict[str, tuple[tuple[float, float], ...]] = {}
    for row in csv.DictReader(text.splitlines()):
        key = plain_model(row["model"])
        entry = (float(row["below_mp"] or "inf"), float(row["readout_ms"]) / 1000)
        table[key] = (*table.get(key, ()), entry)
    return table


def plain_model(text: str) -> str:
    """A camera model's name without case, spaces and signs, as tables are searched."""
    return "".join(c for c in text.lower() if c.isalnum())


def find_shutter(model: str, megapixels: float, rolling: bool | None) -> Shutter:
    """What is known of the shutter of a camera model.

    Args:
        model: as in EXIF.
        megapixels: of the photo as captured.
        rolling: what the sensor table says; None where it says nothing.

    The readout times of `shutters.csv` are those listed by OpenDroneMap (`rollingshutter.py`),
    measured by its users; they are taken to be right within a tenth.
    """
    if rolling is False:
        return Shutter(readout_s=0.0, sigma_s=0.0, source="global")
    for below, readout in _table().get(plain_model(model), ()):
        if megapixels < below:
            return Shutter(readout_s=readout, sigma_s=_TABLE_SHARE * readout, source="table")
    if rolling:
        return Shutter(readout_s=_GUESS_S, sigma_s=_GUESS_SIGMA_S, source="guess")
    return Shutter(readout_s=0.0, sigma_s=_UNKNOWN_SIGMA_S, source="unknown")


def stated_shutter(kind: str | None, readout_ms: float | None) -> Shutter | None:
    """The shutter that a user states by `--shutter` and `--shutter-readout`; None for neither."""
    if readout_ms is None:
        if kind == "rolling":
            return Shutter(readout_s=_GUESS_S, sigma_s=_GUESS_SIGMA_S, source="guess")
        return None if kind != "global" else Shutter(readout_s=0.0, sigma_s=0.0, source="option")
    seconds = readout_ms / 1000
    return Shutter(readout_s=seconds, sigma_s=_OPTION_SHARE * seconds, source="option")
