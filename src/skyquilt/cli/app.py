"""The commands, one file each."""

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from skyquilt.cli import calibrate as calibrate_command
from skyquilt.cli import compare as compare_command
from skyquilt.cli import depth as depth_command
from skyquilt.cli import export as export_command
from skyquilt.cli import fly as fly_command
from skyquilt.cli import inspect as inspect_command
from skyquilt.cli import live as live_command
from skyquilt.cli import mosaic as mosaic_command
from skyquilt.cli import plan as plan_command
from skyquilt.cli import register as register_command
from skyquilt.cli import simulate as simulate_command
from skyquilt.cli import spectral_bench as spectral_bench_command
from skyquilt.cli import strip_test as strip_test_command
from skyquilt.cli import view as view_command
from skyquilt.cli.idle import Checked
from skyquilt.errors import UsageError
from skyquilt.version import __version__

EXIT_CODES = (
    "Exit codes: 0 done, 1 other errors, 2 wrong options, 3 no readable photo, 4 photos cannot be"
    " aligned,"
    " 5 output cannot be written, 6 malformed side file, 7 refused with a reason, 130 interrupted."
)


class Commands(TyperGroup):
    """The commands; photos in place of one are told what maps them."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """The command that the first word names, as the base class has it.

        Raises:
            UsageError: the word is no command, but a path that exists.
        """
        word = args[0]
        if self.get_command(ctx, word) is None and Path(word).exists():
            raise UsageError(f"{word} is no command; to map photos: skyquilt mosaic {word} -o OUT")
        return super().resolve_command(ctx, args)


app = typer.Typer(
    cls=Commands, no_args_is_help=True, add_completion=True, pretty_exceptions_enable=False
)
app.command("mosaic", cls=Checked, epilog=EXIT_CODES)(mosaic_command.command)
app.command("compare", cls=Checked, epilog=EXIT_CODES)(compare_command.command)
app.command("export", cls=Checked, epilog=EXIT_CODES)(export_command.command)
app.command("live", cls=Checked, epilog=EXIT_CODES)(live_command.command)
app.command("view", cls=Checked, epilog=EXIT_CODES)(view_command.command)
app.command("fly", cls=Checked, epilog=EXIT_CODES)(fly_command.command)
app.add_typer(plan_command.app, name="plan", epilog=EXIT_CODES)
app.command("inspect", cls=Checked, epilog=EXIT_CODES)(inspect_command.command)
app.command("register", cls=Checked, epilog=EXIT_CODES)(register_command.command)
app.command("depth", cls=Checked, epilog=EXIT_CODES)(depth_command.command)
app.command("calibrate", cls=Checked, epilog=EXIT_CODES)(calibrate_command.command)
app.command("spectral-bench", cls=Checked, epilog=EXIT_CODES)(spectral_bench_command.command)
app.command("simulate", cls=Checked, epilog=EXIT_CODES)(simulate_command.command)
app.command("strip-test", cls=Checked, epilog=EXIT_CODES)(strip_test_command.command)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"skyquilt {__version__}")
        raise typer.Exit


@app.callback(epilog=EXIT_CODES)
def skyquilt(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Drone photos to a georeferenced, orthorectified mosaic."""
