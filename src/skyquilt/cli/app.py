"""The commands, one file each."""

import typer

from skyquilt.cli import inspect as inspect_command
from skyquilt.cli import mosaic as mosaic_command
from skyquilt.cli import simulate as simulate_command

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
app.command("mosaic")(mosaic_command.command)
app.command("inspect")(inspect_command.command)
app.command("simulate")(simulate_command.command)
