"""The plan of a live survey in its folder, and its follow-up when the flight has ended."""

import shutil
from collections.abc import Iterator
from pathlib import Path

from skyquilt.engine.error_log import log_error
from skyquilt.errors import RefusedError, SkyquiltError
from skyquilt.live.ledger import Ledger
from skyquilt.live.mission import Mission
from skyquilt.live.plan_folders import next_folder
from skyquilt.model.event import Event, Note, Result
from skyquilt.planning.missing import PLAN
from skyquilt.planning.plan_file import read_plan
from skyquilt.planning.records import Plan
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.workflow import Order, iter_plan
from skyquilt.raster.atomic import mended


def known_plan(folder: Path, given: Path | None = None) -> Plan | None:
    """The plan that a survey follows: a new one is copied into its folder, where the next start
    finds it.

    Raises:
        SideFileError: the file is no plan. OutputError: it cannot be copied.
    """
    kept = Path(folder) / PLAN
    if given is not None:
        plan = read_plan(given)
        if given.resolve() != kept.resolve():
            with mended(kept):
                kept.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(given, kept)
        return plan
    return read_plan(kept) if kept.is_file() else None


def iter_fill(folder: Path, ledger: Ledger, photos: Path) -> Iterator[Event]:
    """Plans what the flight has left open, by the photos so far; a note where nothing is
    missing.
    """
    try:
        plan = known_plan(folder)
        if plan is None:
            raise RefusedError("no follow-up: this survey has no plan")
        mission = Mission(folder=Path(folder), plan=plan)
        state = mission.look(ledger, photos)
        mission.write(state)
        output = next_folder(folder, "fill")
        order = Order(area=Path(folder), settings=PlanSettings(height_m=1.0))
        for happened in iter_plan(order, output):
            if isinstance(happened, Note):
                yield happened
            if isinstance(happened, Result):
                text = f"{happened.metrics['points']} photos close what is missing: {output}"
                ledger.tell("plan", {"state": "ready", "name": output.name, "text": text})
                yield Note(text=text)
    except RefusedError as error:
        ledger.tell("plan", {"state": "complete", "text": str(error)})
        yield Note(text=str(error))
    except Exception as error:  # the live map goes on, whatever happens to a plan
        if not isinstance(error, SkyquiltError):
            log_error(Path(folder), "the follow-up plan", error)
        yield Note(text=f"no follow-up plan: {error}", warning=True)
