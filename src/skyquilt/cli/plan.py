"""`skyquilt plan`: picture-points and routes for an area, and checks of missions."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from skyquilt.cli.idle import Checked
from skyquilt.cli.interrupt import ends_at_once
from skyquilt.cli.options import Json, Overwrite, Quiet, in_percent, mode_of

if TYPE_CHECKING:
    from skyquilt.model.event import Result
    from skyquilt.planning.check import Verdict

CAMERA = "A model such as FC6310, a cameras.json, or a photo taken with the camera."
TERRAIN = "Heights of the ground, or of the surface with its obstacles (GeoTIFF)."


class PlanGroup(TyperGroup):
    """`plan AREA` plans, `plan check FILE` checks."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Puts the name of the main command before its arguments."""
        if args and args[0] not in self.commands and args[0] != "--help":
            args = ["area", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(cls=PlanGroup, no_args_is_help=True, add_completion=False)


@app.callback()
def plan() -> None:
    """Plan a mission: `plan AREA -o PLAN`; `plan check FILE` checks one."""


@app.command("area", cls=Checked)
def command(
    area: Annotated[
        Path,
        typer.Argument(
            help="Areas (GeoJSON, KML, KMZ, GeoPackage, Shapefile), or the folder of a run: what is"
            " missing there."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the plan.")],
    camera: Annotated[str | None, typer.Option(help=CAMERA)] = None,
    gsd: Annotated[float | None, typer.Option(help="Ground size of a pixel in cm.")] = None,
    height: Annotated[float | None, typer.Option(help="Height above the ground in m.")] = None,
    overlap: Annotated[
        float, typer.Option(help="Overlap along the lines, percent.", callback=in_percent)
    ] = 80,
    sidelap: Annotated[
        float, typer.Option(help="Overlap between the lines, percent.", callback=in_percent)
    ] = 70,
    views: Annotated[
        int | None,
        typer.Option(help="Photos that see each cell.", show_default="as the overlaps give"),
    ] = None,
    width: Annotated[float | None, typer.Option(help="Width of corridors (lines) in m.")] = None,
    keep_out: Annotated[Path | None, typer.Option(help="Areas that no drone may enter.")] = None,
    drones: Annotated[int, typer.Option(help="Number of drones alike.")] = 1,
    start: Annotated[
        str | None,
        typer.Option(help="Their start: LATITUDE,LONGITUDE.", show_default="rim of the area"),
    ] = None,
    fleet: Annotated[Path | None, typer.Option(help="Drones one by one (fleet.toml).")] = None,
    terrain: Annotated[Path | None, typer.Option(help=TERRAIN)] = None,
    clearance: Annotated[
        float, typer.Option(help="Distance from keep-out areas and above the surface in m.")
    ] = 10,
    separation: Annotated[float, typer.Option(help="Distance between drones in m.")] = 20,
    wind: Annotated[
        str | None, typer.Option(help="SPEED,FROM in m/s and degrees, such as 5,270.")
    ] = None,
    deadline: Annotated[float | None, typer.Option(help="Latest landing, minutes.")] = None,
    seconds: Annotated[float, typer.Option(help="Time to search for routes.")] = 12,
    base: Annotated[
        Path | None, typer.Option(help="An old map to draw below the plan's page.")
    ] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Picture-points, routes and mission files for an area."""
    with ends_at_once():
        from skyquilt.cli.progress import show
        from skyquilt.planning.settings import PlanSettings
        from skyquilt.planning.workflow import Order, iter_plan

    mode = mode_of(quiet=quiet, json=json)
    speed, from_deg = _wind(wind)
    settings = PlanSettings(
        gsd_cm=gsd,
        height_m=height,
        overlap=overlap,
        sidelap=sidelap,
        views=views,
        width_m=width,
        clearance_m=clearance,
        separation_m=separation,
        wind_ms=speed,
        wind_from_deg=from_deg,
        deadline_s=None if deadline is None else 60 * deadline,
        seconds=seconds,
    )
    order = Order(
        area=area,
        settings=settings,
        camera=camera,
        keep_out=keep_out,
        terrain=terrain,
        drones=drones,
        start=start,
        fleet=fleet,
        base=base,
    )
    show(iter_plan(order, output, overwrite=overwrite), mode=mode, summary=summary)


def _wind(text: str | None) -> tuple[float, float]:
    from skyquilt.errors import UsageError
    from skyquilt.outside import plain, real

    if text is None:
        return 0.0, 0.0
    speed, _, direction = text.partition(",")
    found = real(speed, 0, 60), real(direction or "0", -360, 360)
    if found[0] is None or found[1] is None:
        raise UsageError(f"--wind takes SPEED,FROM such as 5,270, not '{plain(text, 60)}'")
    return found[0], found[1]


def summary(result: "Result") -> str:
    """A plan in a few lines."""
    m = result.metrics
    proof = m["proof"]
    seen = (
        f"every cell has {proof['views']} views or more (least {proof['least']})"
        if proof["missing_m2"] <= 0
        else f"{proof['missing_m2']:.0f} m2 have fewer than {proof['views']} views"
    )
    bound = m["seconds"] / max(m["bound_s"], 1e-9)
    return "\n".join((
        f"{m['points']} photos in {m['sorties']} sorties of {m['drones']} drones; {seen}",
        f"last landing after {m['seconds'] / 60:.1f} min, at most {bound:.2f} times the best"
        " possible",
        f"plan:   {result.output / 'plan.json'}",
        f"files:  {', '.join(m['files'][:4])}{' ...' * (len(m['files']) > 4)}",
        f"report: {result.output / 'plan.html'}",
    ))  # fmt: skip


@app.command("check", cls=Checked)
def check(
    file: Annotated[Path, typer.Argument(help="plan.json, .plan, .waypoints or .kmz.")],
    area: Annotated[Path | None, typer.Option(help="Areas that it has to cover.")] = None,
    camera: Annotated[str | None, typer.Option(help=CAMERA)] = None,
    terrain: Annotated[Path | None, typer.Option(help=TERRAIN)] = None,
    views: Annotated[int | None, typer.Option(help="Photos that have to see each cell.")] = None,
    width: Annotated[float | None, typer.Option(help="Width of corridors (lines) in m.")] = None,
    clearance: Annotated[float, typer.Option(help="Height above the surface in m.")] = 10,
    json: Json = False,
) -> None:
    """Coverage, overlap, ground size and conflicts of a mission, ours or another program's."""
    with ends_at_once():
        from skyquilt.planning.check_file import check_file

    verdict = check_file(
        file, area=area, camera=camera, terrain=terrain, views=views, width_m=width,
        clearance=clearance,
    )  # fmt: skip
    if json:
        from dataclasses import asdict
        from json import dumps

        typer.echo(dumps(asdict(verdict)))
    else:
        typer.echo(verdict_text(verdict))


def verdict_text(verdict: "Verdict") -> str:
    """A check in a few lines."""
    found = [f"photos:      {verdict.photos}"]
    proof = verdict.proof
    if proof is not None:
        found += [
            f"coverage:    least {proof.least} views of {proof.views} asked for, median"
            f" {proof.median:g}; {proof.missing_m2:.0f} m2 have fewer",
            f"overlap:     least {100 * proof.overlap:.0f} % of consecutive photos",
            f"ground size: {proof.gsd_cm[0]:.2f} to {proof.gsd_cm[1]:.2f} cm",
        ]
    else:
        found.append("coverage:    give --camera to see coverage, overlap and ground size")
    found += [f"conflict:    {text}" for text in verdict.conflicts] or ["conflicts:   none"]
    return "\n".join(found)
