"""`skyquilt fly`: replays a flight into a live map."""

from pathlib import Path
from typing import Annotated

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import Quiet
from skyquilt.outside import plain


def command(
    flight: Annotated[
        Path, typer.Argument(metavar="FLIGHT", help="Folder of a simulated flight, or of photos.")
    ],
    to: Annotated[str, typer.Option("--to", help="Watched folder, or address of the live map.")],
    rate: Annotated[float, typer.Option(help="Photos per second, all drones together.")] = 1.0,
    drones: Annotated[int, typer.Option(help="Drones that share the flight.")] = 1,
    loss: Annotated[
        float, typer.Option(help="Share of photos that never arrive, 0 to 0.95.")
    ] = 0.0,
    reorder: Annotated[float, typer.Option(help="Share of photos that arrive late, 0 to 1.")] = 0.0,
    previews: Annotated[
        bool, typer.Option("--previews", help="Send small previews first, full photos later.")
    ] = False,
    burst: Annotated[
        float | None,
        typer.Option(help="Photos per second during a burst of half a minute in the middle."),
    ] = None,
    token: Annotated[
        str | None, typer.Option(envvar="SKYQUILT_TOKEN", help="Secret of the live map.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of losses and order.")] = 0,
    quiet: Quiet = False,
) -> None:
    """Send the photos of a flight as drones in the air would: in real time, with losses, out of
    order, previews first.
    """
    with ends_at_once():
        from skyquilt.live.replay_flight import FlySettings, fly
    settings = FlySettings(
        rate=rate,
        drones=drones,
        loss=loss,
        reorder=reorder,
        previews=previews,
        burst=burst,
        seed=seed,
    )
    count = 0
    for sent in fly(flight, to, settings, token):
        count += 1
        if not quiet:
            said = plain(f"{sent.name}  {sent.answer}")
            typer.echo(f"{sent.at_s:8.1f} s  drone {sent.drone}  {said}")
    if not quiet:
        typer.echo(f"{count} files sent")
