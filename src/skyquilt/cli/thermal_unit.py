"""The option `--thermal-unit`, alike in every command that reads photos."""

from typing import Annotated

import typer

MEANING = (
    "What values of single-band TIFFs mean: auto (they are thermal; the unit is stated in them or found from the"
    " values), celsius, kelvin, decikelvin, centikelvin, counts."
)
UNSAID = "files of thermal cameras, or that state a unit, are read as auto"
ThermalUnit = Annotated[str | None, typer.Option(help=MEANING, show_default=UNSAID)]
