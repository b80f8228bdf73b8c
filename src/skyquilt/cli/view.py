"""`skyquilt view`: the viewer on a finished run, or on a survey that was or is being mapped
live.
"""

import time
from pathlib import Path
from typing import Annotated

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.live import AllowHost, Host, MaxConnections, Port, PublicUrl, Token
from skyquilt.cli.options import MaxMemory
from skyquilt.outside import plain


def command(
    folder: Annotated[
        Path, typer.Argument(metavar="OUTPUT", help="Folder of a finished run or of a live survey.")
    ],
    port: Port = 8080,
    host: Host = "127.0.0.1",
    token: Token = None,
    base: Annotated[
        Path | None, typer.Option(help="An older orthophoto (GeoTIFF) to show below.")
    ] = None,
    photos: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the photos of a finished run, where they have moved.",
            show_default="where they were",
        ),
    ] = None,
    allow_host: AllowHost = None,
    public_url: PublicUrl = None,
    max_connections: MaxConnections = 200,
    max_memory: MaxMemory = None,
) -> None:
    """Show a map in a browser, with all photos that cover any point. The files are not changed."""
    with ends_at_once():
        from skyquilt.engine.memory_watch import ends_run, limit_bytes
        from skyquilt.server.access import Guard
        from skyquilt.server.server_thread import ServerThread
        from skyquilt.server.survey import open_survey
    guard = Guard(
        host=host,
        token=token,
        allow_hosts=tuple(allow_host or ()),
        public_url=public_url,
        most_connections=max_connections,
    )
    survey = open_survey(folder, base=base, photos=photos)
    watch = ends_run(limit_bytes(max_memory), "start it again with a larger --max-memory")
    with watch, ServerThread(survey=survey, guard=guard, folder=folder, port=port) as serving:
        typer.echo(f"{serving.url} shows {plain(str(folder))}; Ctrl-C ends")
        while True:  # on Windows Ctrl-C ends no other way of waiting
            time.sleep(60)
