"""Options that have no effect beside others are refused: the rules of all commands but `mosaic`
and `compare`, whose settings have theirs (`skyquilt.effects`).

Only what was given counts, so an option may state its default.
"""

from pathlib import Path
from typing import Any

from typer.core import TyperCommand

from skyquilt.effects import Rule, Values, refuse_idle


def _what(values: Values) -> set[str]:
    return {word.strip() for word in str(values["what"]).split(",")}


def _only(values: Values, *kinds: str, but: str) -> str:
    """Why an option of an export does nothing where only these kinds are written."""
    what = _what(values)
    return f"--what {values['what']} {but}" if what and what <= set(kinds) else ""


def _layer(values: Values) -> str:
    return _only(values, "heights", "footprints", but="does not depend on it")


def _gsd(values: Values) -> str:
    return _only(values, "footprints", but="has no pixels")


def _crs(values: Values) -> str:
    if values["bounds"] is not None:
        return ""
    return _only(values, "kmz", "mbtiles", "tiles", but="has a system of its own")


def _known(values: Values) -> str:
    return "" if values["distances"] is None else "--distances judges in its place"


def _plane(values: Values) -> str:
    route, several = values["route"], len(values["photos"]) > 2
    whole = route == "reconstruction" or (route == "auto" and several)
    return "the heights of the whole adjustment ask for no dominant plane" if whole else ""


def _poses(values: Values) -> str:
    return "with --series views no frames are combined" if values["series"] == "views" else ""


def _folder(values: Values) -> str:
    return "" if "://" in str(values["to"]) else f"{values['to']} is a folder, which asks for none"


def _by_chance(values: Values) -> str:
    chance = values["loss"] or values["reorder"]
    return "" if chance else "without --loss and --reorder nothing is left to chance"


def _untold(values: Values) -> str:
    return "--no-focal leaves the focal length out" if values["no_focal"] else ""


def _no_dewarp(values: Values) -> str:
    return "" if values["dewarp"] else "it is said by the calibration of --dewarp"


def _no_thermal(values: Values) -> str:
    flown = values["thermal"] or (values["preset"] == "thermal" and values["thermal"] is None)
    return "" if flown else "there is no thermal flight; add --thermal"


def _plan(values: Values) -> str:
    return f"{Path(values['plan']).name} says it" if values["plan"] else ""


def _live(values: Values) -> str:
    from skyquilt.planning.missing import is_mission

    area = Path(values["area"])
    return f"{area} knows its plan, which is followed up" if is_mission(area) else ""


def _run(values: Values) -> str:
    area = Path(values["area"])
    return f"{area} is a folder of a run, which has no lines" if area.is_dir() else ""


def _fleet(values: Values) -> str:
    return f"{Path(values['fleet']).name} says it" if values["fleet"] else ""


def _alone(values: Values) -> str:
    one = values["fleet"] is None and values["drones"] == 1
    return "there is one drone; add --drones" if one else ""


def _own_plan(values: Values) -> str:
    file = Path(values["file"])
    if file.suffix.lower() != ".json":
        return ""
    return f"{file.name} is a plan with an area, cameras and clearance of its own"


def _unseen(values: Values) -> str:
    if values["camera"] or Path(values["file"]).suffix.lower() == ".json":
        return ""
    return "without --camera no views are counted"


def _no_area(values: Values) -> str:
    return "" if values["area"] else "it is that of lines in --area"


def _level(values: Values) -> str:
    return "" if values["terrain"] else "without --terrain no surface is known"


_OF_A_PLAN = (
    *("camera", "gsd", "height", "overlap", "sidelap", "views", "width", "keep_out", "drones"),
    *("start", "fleet", "clearance", "separation", "wind", "deadline", "seconds"),
)
_FLOWN = (
    *("photos", "overlap", "sidelap", "height", "heading", "speed", "stops", "fixed_yaw", "turns"),
    *("shutter_readout", "aspect", "fisheye", "field_of_view", "drones", "lose"),
)
RULES: dict[str, tuple[Rule, ...]] = {
    "export": (
        Rule(settings=("layer",), idle=_layer),
        Rule(settings=("gsd",), idle=_gsd),
        Rule(settings=("crs",), idle=_crs),
    ),
    "compare": (Rule(settings=("known",), idle=_known),),
    "depth": (Rule(settings=("relief",), idle=_plane),),
    "calibrate": (Rule(settings=("weights",), idle=_poses),),
    "fly": (Rule(settings=("token",), idle=_folder), Rule(settings=("seed",), idle=_by_chance)),
    "simulate": (
        Rule(settings=_FLOWN, idle=_plan),
        Rule(settings=("focal_error",), idle=_untold),
        Rule(settings=("aspect_untold",), idle=_no_dewarp),
        Rule(settings=("thermal_season", "thermal_hour"), idle=_no_thermal),
    ),
    "area": (
        Rule(settings=_OF_A_PLAN, idle=_live),
        Rule(settings=("width",), idle=_run),
        Rule(settings=("drones", "start"), idle=_fleet),
        Rule(settings=("separation",), idle=_alone),
    ),
    "check": (
        Rule(settings=("area", "camera", "width", "clearance"), idle=_own_plan),
        Rule(settings=("views",), idle=_unseen),
        Rule(settings=("width",), idle=_no_area),
        Rule(settings=("clearance",), idle=_level),
    ),
}
"""Rules by the name of the command."""


class Checked(TyperCommand):
    """A command that refuses options without effect before it begins."""

    def invoke(self, ctx: Any) -> Any:
        """Runs the command.

        Raises:
            UsageError: an option that was given has no effect.
        """
        refuse(ctx)
        return super().invoke(ctx)


def refuse(ctx: Any) -> None:
    """Refuses what was given and has no effect, of a command that was parsed.

    Raises:
        UsageError: an option has none.
    """
    sources = {name: ctx.get_parameter_source(name) for name in ctx.params}
    asked = {n for n, s in sources.items() if s is not None and s.name == "COMMANDLINE"}
    refuse_idle(RULES.get(str(ctx.command.name), ()), ctx.params, asked)
