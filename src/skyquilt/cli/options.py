"""Options that several commands share, each defined once, and what `--quiet`, `--verbose` and
`--json` together mean.
"""

from pathlib import Path
from typing import Annotated, Literal

import typer

from skyquilt.errors import UsageError

Mode = Literal["quiet", "normal", "verbose", "json"]

Photos = Annotated[Path, typer.Argument(help="Folder of photos and videos (subfolders included).")]
PhotoPaths = Annotated[
    list[Path],
    typer.Argument(help="Folder of photos and videos (subfolders included); or several, or files."),
]
Output = Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")]
Gsd = Annotated[
    float | None,
    typer.Option(help="Ground size of a map pixel in cm.", show_default="that of the photos"),
]
Crs = Annotated[
    str | None, typer.Option(help="Output CRS, e.g. EPSG:32633.", show_default="local UTM")
]
Cameras = Annotated[Path | None, typer.Option(help="Calibrations (cameras.json).")]
Repair = Annotated[
    bool, typer.Option("--repair-metadata/--trust-metadata", help="Whether metadata may be wrong.")
]
Features = Annotated[int, typer.Option(help="Features per photo.")]
SHUTTERS = "How photos are exposed: global (all rows at once) or rolling (one after the other)."
SHUTTER_UNSAID = "as metadata and the table of cameras say"
Shutter = Annotated[str | None, typer.Option(help=SHUTTERS, show_default=SHUTTER_UNSAID)]
READOUTS = "Time in ms in which a rolling shutter reads a photo out."
READOUT_UNSAID = "as the table says"
ShutterReadout = Annotated[float | None, typer.Option(help=READOUTS, show_default=READOUT_UNSAID)]
VERTICAL_DATUMS = "Zero of heights: ellipsoid, egm96 (sea level), takeoff."
MaxViewAngle = Annotated[
    float, typer.Option(help="Largest angle from the vertical, in degrees, that photos show.")
]
Jobs = Annotated[int, typer.Option(help="Threads; 0 = all processors.")]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace the results of another run in OUTPUT.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Print more: the time of every stage.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object per event.")]

MAX_MP = "Largest area of a photo in megapixels; larger ones are left out."
MaxMp = Annotated[float, typer.Option(help=MAX_MP)]
MAX_MEMORY = "Resident memory in GB at which the program ends with a sentence."
MAX_MEMORY_UNSAID = "nine tenths of the machine's"
MaxMemory = Annotated[
    float | None, typer.Option(min=0.1, help=MAX_MEMORY, show_default=MAX_MEMORY_UNSAID)
]

THERMAL_UNITS = (
    "Unit of single-band TIFFs: auto (they are thermal; the unit is read from the file or derived"
    " from the values), celsius, kelvin, decikelvin, centikelvin,"
    " decicelsius, centicelsius, fahrenheit, counts."
)
UNIT_UNSAID = "auto for files of thermal cameras or with a stated unit"
ThermalUnit = Annotated[str | None, typer.Option(help=THERMAL_UNITS, show_default=UNIT_UNSAID)]


def mode_of(*, quiet: bool, json: bool, verbose: bool | None = None) -> Mode:
    """How much a command prints; `verbose` is None where there is no such option.

    Raises:
        UsageError: more than one was given.
    """
    if quiet + json + bool(verbose) > 1:
        names = "--quiet and --json" if verbose is None else "--quiet, --verbose and --json"
        raise UsageError(f"{names} exclude one another")
    return "quiet" if quiet else "json" if json else "verbose" if verbose else "normal"


def parse_bounds(text: str | None) -> tuple[float, float, float, float] | None:
    """Four numbers separated by commas.

    Raises:
        UsageError: they are not.
    """
    if text is None:
        return None
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UsageError(
            f"--bounds is west,south,east,north, four numbers; got {text!r}"
        ) from error
    return west, south, east, north


def in_percent(option: typer.CallbackParam, value: float | None) -> float | None:
    """The value of an option in percent, which is no share of 1.

    Raises:
        UsageError: it lies between 0 and 1.
    """
    if value is not None and 0 < value < 1:
        raise UsageError(f"{option.opts[0]} is in percent: {100 * value:g}, not {value:g}")
    return value


def source_of(paths: list[Path]) -> Path | list[Path]:
    """The one folder or file that is given, or all of them."""
    return paths[0] if len(paths) == 1 else paths
