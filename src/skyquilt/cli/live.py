"""`skyquilt live`: the map grows while the drones fly."""

from pathlib import Path
from typing import Annotated

import typer

from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import (
    VERTICAL_DATUMS,
    Features,
    Json,
    MaxMemory,
    MaxMp,
    MaxViewAngle,
    Quiet,
    Shutter,
    ShutterReadout,
    ThermalUnit,
    mode_of,
)
from skyquilt.outside import MOST_MP

Output = Annotated[
    Path,
    typer.Option("--output", "-o", help="Folder of the survey; an existing survey is continued."),
]
Port = Annotated[int, typer.Option(min=0, max=65535, help="Port of the viewer; 0 = a free one.")]
Host = Annotated[
    str, typer.Option(help="Address to listen on; other than local ones need --token.")
]
Token = Annotated[
    str | None,
    typer.Option(
        envvar="SKYQUILT_TOKEN", help="Secret that every request which changes something must hold."
    ),
]
AllowHost = Annotated[
    list[str] | None,
    typer.Option(
        help="A further name under which browsers may address the server (repeatable).",
        show_default="the address, the machine's name",
    ),
]
PublicUrl = Annotated[
    str | None,
    typer.Option(help="Address under which a reverse proxy shows the server: https://host/map/."),
]
MaxConnections = Annotated[int, typer.Option(min=4, max=900, help="Connections from one address.")]


def command(
    inbox: Annotated[
        list[Path],
        typer.Argument(help="Folders that photos are copied into; created where missing."),
    ],
    output: Output,
    port: Port = 8080,
    host: Host = "127.0.0.1",
    token: Token = None,
    gsd: Annotated[
        float | None,
        typer.Option(
            help="Ground size of a pixel of the growing map in cm.",
            show_default="three times the photos'",
        ),
    ] = None,
    crs: Annotated[
        str | None, typer.Option(help="CRS of the map.", show_default="local UTM")
    ] = None,
    reposition: Annotated[
        bool,
        typer.Option(
            "--reposition/--no-reposition",
            help="Whether later photos may change the poses of earlier ones.",
        ),
    ] = True,
    deterministic: Annotated[
        bool,
        typer.Option(
            "--deterministic",
            help="The same photos in the same order give the same poses, bit for bit; slower.",
        ),
    ] = False,
    finish: Annotated[
        bool,
        typer.Option(
            "--finish",
            help="End when no more photos arrive, with the final map in OUTPUT/finished.",
        ),
    ] = False,
    thermal_unit: ThermalUnit = None,
    band: Annotated[
        str | None,
        typer.Option(
            help="Band that the map shows, of cameras that write a file for each, e.g. nir.",
            show_default="of the first file, or of most",
        ),
    ] = None,
    shutter: Shutter = None,
    shutter_readout: ShutterReadout = None,
    vertical_datum: Annotated[
        str | None, typer.Option(help=VERTICAL_DATUMS, show_default="what the first photo states")
    ] = None,
    max_view_angle: MaxViewAngle = 70.0,
    base: Annotated[
        list[Path] | None,
        typer.Option(help="An older map (GeoTIFF, COG, MBTiles) to show below (repeatable)."),
    ] = None,
    layer: Annotated[
        list[Path] | None,
        typer.Option(
            help="Shapes to show over the map: GeoJSON, KML, GeoPackage, Shapefile (repeatable)."
        ),
    ] = None,
    plan: Annotated[
        Path | None,
        typer.Option(help="plan.json that is flown; kept in OUTPUT for the next start."),
    ] = None,
    fill: Annotated[
        bool, typer.Option("--fill", help="Plan what is missing when the flight has ended.")
    ] = False,
    features: Features = 1200,
    max_mb: Annotated[float, typer.Option(help="Largest photo file in MB.")] = 500,
    max_clip_mb: Annotated[float, typer.Option(help="Largest uploaded video in MB.")] = 8000,
    max_mp: MaxMp = MOST_MP,
    max_photos: Annotated[int, typer.Option(help="Largest number of photos accepted.")] = 100_000,
    max_connections: MaxConnections = 200,
    max_memory: MaxMemory = None,
    viewer_memory: Annotated[
        float,
        typer.Option(min=0.3, help="Resident memory in GB at which the viewer is started anew."),
    ] = 1.5,
    allow_host: AllowHost = None,
    public_url: PublicUrl = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Map photos as they arrive, and show the growing map in a browser.

    Photos arrive in the folders INBOX or over HTTP; accepted photos survive any crash.
    """
    with ends_at_once():
        from skyquilt.cli.progress import show_live
        from skyquilt.engine.memory_watch import (
            MEMORY_GB,
            OPEN_FILES,
            ends_run,
            enough_files,
            limit_bytes,
        )
        from skyquilt.errors import UsageError
        from skyquilt.live.fill import known_plan
        from skyquilt.live.folder_watch import apart, create_inbox
        from skyquilt.live.live_map import LiveMap
        from skyquilt.live.settings import LiveSettings
        from skyquilt.live.workflow import iter_live
        from skyquilt.server.access import Guard
        from skyquilt.server.layer_files import layer_of_file
        from skyquilt.server.server_process import ServerConfig, ServerProcess
        from skyquilt.settings import within
    mode = mode_of(quiet=quiet, json=json)
    enough_files(OPEN_FILES)
    within("--max-mb", max_mb, 0.01, 1e5, "MB")
    within("--max-clip-mb", max_clip_mb, 0.01, 1e6, "MB")
    within("--viewer-memory", viewer_memory, *MEMORY_GB, "GB")
    settings = LiveSettings(
        gsd_cm=gsd,
        crs=crs,
        reposition=reposition,
        deterministic=deterministic,
        thermal_unit=thermal_unit,
        band=band,
        shutter=shutter,
        shutter_readout_ms=shutter_readout,
        vertical_datum=vertical_datum,
        max_view_angle=max_view_angle,
        features=features,
        most_bytes=int(max_mb * 1e6),
        most_clip_bytes=int(max_clip_mb * 1e6),
        most_mp=max_mp,
        most_photos=max_photos,
    )
    guard = Guard(
        host=host,
        token=token,
        allow_hosts=tuple(allow_host or ()),
        public_url=public_url,
        most_connections=max_connections,
    )
    for folder in inbox:
        create_inbox(folder)
        apart(folder, output)
    live = LiveMap(output, settings)
    try:
        for path in layer or ():
            layer_of_file(live.ledger, path, guard.most_layers)
        if known_plan(output, plan) is None and fill:
            raise UsageError("--fill needs a plan; give --plan")
        asked = ServerConfig(
            folder=output,
            settings=settings,
            guard=guard,
            base=tuple(base or ()),
            most_memory=int(viewer_memory * 1e9),
        )
        advice = "no accepted photo is lost: the same command continues"
        with (
            ends_run(limit_bytes(max_memory), advice),
            ServerProcess(asked=asked, port=port) as serving,
        ):
            live.lock.tell(serving.url)
            events = iter_live(inbox, live, finish=finish, fill=fill)
            show_live(events, serving.url, mode=mode)
    finally:
        live.close()
