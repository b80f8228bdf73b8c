"""The command line: one command per file, errors as sentences, exit codes as documented."""

import os
import sys

import typer

from skyquilt.cli import inspect as inspect_command
from skyquilt.cli import mosaic as mosaic_command
from skyquilt.cli import simulate as simulate_command
from skyquilt.errors import SkyquiltError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
app.command("mosaic")(mosaic_command.command)
app.command("inspect")(inspect_command.command)
app.command("simulate")(simulate_command.command)


def run() -> None:
    """Entry point; a mendable error is one sentence on standard error and its own exit code."""
    # threads work on photos, not inside one product of matrices: it would only spin
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        app()
    except SkyquiltError as error:
        sys.stderr.write(f"skyquilt: {error}\n")
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        sys.stderr.write("skyquilt: interrupted; run the same command again to resume\n")
        sys.exit(130)
