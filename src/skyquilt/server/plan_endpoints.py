"""Endpoints of the plan: its points as they turn, coverage, and new plans, each computed in a
process of its own.
"""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import HTTPException, Query, Request
from fastapi.responses import FileResponse, JSONResponse, Response
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from skyquilt.errors import OutputError
from skyquilt.live.ledger import Ledger
from skyquilt.live.plan_folders import PLANS, next_folder
from skyquilt.outside import plain
from skyquilt.server.access import Context, blocks_of
from skyquilt.server.layer_endpoints import LayerError, checked
from skyquilt.server.survey import LiveSurvey

if TYPE_CHECKING:
    from skyquilt.server.mission_watch import MissionWatch  # only for live surveys

MOST_RUNNING = 1
"""Plans that are computed at a time."""
AREAS = "areas"
"""Key of the areas that were drawn, in the ledger."""
MOST_PLANS = 200
"""Plans that a survey keeps."""
PATIENCE_S = 600.0
"""Time in s after which a computation is ended."""
Metres = Annotated[float | None, Query(ge=2, le=10_000)]
Percent = Annotated[float, Query(ge=0, le=97)]


class PlanEndpoints:
    """Endpoints of the plan; without a watch (a finished run) there is none."""

    def __init__(self, context: Context, folder: Path, watch: "MissionWatch | None") -> None:
        self.context, self.folder, self.watch = context, folder, watch
        self._running: subprocess.Popen[str] | None = None

    def _watching(self) -> "MissionWatch":
        if self.watch is None:
            raise HTTPException(404, "this survey is finished; only a live one knows a plan")
        return self.watch

    def plan(self) -> dict[str, Any]:
        """The plan and the state of its points."""
        from skyquilt.planning.plan_file import as_record  # `view` has no plan

        watch = self._watching()
        if watch.plan is None:
            return {"plan": None, "drones": [], "states": {}, "plans": self._names()}
        state = watch.state
        return {
            "plan": _drawn(as_record(watch.plan)),
            "states": dict(state.points) if state else {},
            "drones": list(state.drones) if state else [],
            "unsharp": sorted(state.unsharp) if state else [],
            "plans": self._names(),
        }

    def coverage(self) -> dict[str, Any]:
        """How much of the area has its views; the picture is at `/coverage.png`."""
        state = self._watching().state
        if state is None or state.cover is None or state.counts is None:
            return {"bounds": None, "share": 0.0, "views": state.views if state else 0}
        inside = state.counts[state.cover.inside]
        return {
            "bounds": list(state.cover.bounds),
            "share": round(state.share, 5),
            "missing_m2": round(state.missing_m2, 1),
            "views": state.views,
            "least": int(inside.min(initial=10**6)) if inside.size else 0,
            "cell_m": round(state.cover.ground_m, 3),
        }

    def coverage_picture(self) -> Response:
        """The number of views as a picture in Web Mercator: red none, orange too few, green
        enough.
        """
        from skyquilt.planning.ground_cover import picture_of  # `view` has no plan

        state = self._watching().state
        if state is None or state.cover is None or state.counts is None:
            raise HTTPException(404, "there is no coverage yet")
        png = picture_of(state.cover, state.counts, state.views)
        return Response(png, media_type="image/png", headers={"Cache-Control": "no-store"})

    def missing(self, request: Request) -> JSONResponse:
        """Plans what the photos so far leave open, for the same drones."""
        writer, watch = self.context.writing(request), self._watching()
        if watch.plan is None:
            raise HTTPException(409, "this survey has no plan; start 'skyquilt live' with --plan")
        self._free()
        watch.step(writer.ledger, now=True)
        output = self._room("fill")
        return self._started(writer.ledger, output, [str(self.folder), "-o", str(output)])

    def areas(self) -> dict[str, Any]:
        """The areas that were drawn in a browser, as GeoJSON; keep-out areas with `keep_out`."""
        self._watching()
        survey = self.context.survey
        kept = survey.ledger.meta(AREAS) if isinstance(survey, LiveSurvey) else None
        return dict(kept or {"type": "FeatureCollection", "features": []})

    async def areas_put(self, request: Request) -> dict[str, Any]:
        """Keeps the areas that were drawn (GeoJSON) in place of those kept before."""
        writer = self.context.writing(request)
        areas = await self._drawn_areas(request)
        try:
            await run_in_threadpool(_keep_areas, writer.ledger, areas)
        except OutputError as error:
            raise HTTPException(507, str(error)) from error
        return {"areas": len(areas["features"])}

    async def _drawn_areas(self, request: Request) -> dict[str, Any]:
        """The body as GeoJSON."""
        guard, data = self.context.guard, bytearray()
        try:
            async for block in blocks_of(request, guard.upload_stall_s):
                data += block
                if len(data) > guard.most_layer_bytes:
                    raise HTTPException(413, f"areas may have {guard.most_layer_bytes} bytes")
            return await run_in_threadpool(checked, bytes(data))
        except (ClientDisconnect, TimeoutError) as error:
            raise HTTPException(408, "the connection was lost; send the areas again") from error
        except LayerError as error:
            raise HTTPException(422, f"these are no areas: {error}") from error

    async def new(
        self,
        request: Request,
        camera: Annotated[str, Query(max_length=60, pattern=r"^[\w.+ -]+$")],
        height: Metres = None,
        gsd: Annotated[float | None, Query(gt=0, le=1000)] = None,
        overlap: Percent = 80.0,
        sidelap: Percent = 70.0,
        views: Annotated[int | None, Query(ge=1, le=200)] = None,
        drones: Annotated[int, Query(ge=1, le=50)] = 1,
        width: Annotated[float | None, Query(gt=0, le=10_000)] = None,
    ) -> JSONResponse:
        """Plans areas that were drawn: GeoJSON, keep-out areas with a property `keep_out`."""
        writer = self.context.writing(request)
        if "/" in camera or ".." in camera:
            raise HTTPException(422, "the camera is a model such as FC6310")
        areas = await self._drawn_areas(request)
        self._free()
        output = self._room("plan")
        try:
            output.parent.mkdir(exist_ok=True)
            drawn = output.parent / f"{output.name}.geojson"
            drawn.write_text(json.dumps(areas), encoding="utf-8")
        except OSError as error:
            raise HTTPException(507, f"the areas cannot be kept: {error.strerror}") from error
        words = [str(drawn), "-o", str(output), "--camera", camera, "--drones", str(drones),
                 "--overlap", str(overlap), "--sidelap", str(sidelap)]  # fmt: skip
        for name, value in (("height", height), ("gsd", gsd), ("views", views), ("width", width)):
            words += [f"--{name}", str(value)] if value is not None else []
        return self._started(writer.ledger, output, words)

    def plan_file(self, name: str, file: str) -> FileResponse:
        """A file of a plan that was made here."""
        known = {p.name: p for p in self._folders()}
        files = {p.name: p for p in known[name].iterdir() if p.is_file()} if name in known else {}
        if file not in files:
            raise HTTPException(404, "there is no such file")
        return FileResponse(files[file], filename=None if file.endswith(".html") else file)

    def _folders(self) -> list[Path]:
        top = self.folder / PLANS
        return sorted(p for p in top.iterdir() if p.is_dir()) if top.is_dir() else []

    def _names(self) -> list[dict[str, Any]]:
        """Finished plans with their files."""
        return [
            {"name": p.name, "files": sorted(f.name for f in p.iterdir() if f.is_file())}
            for p in self._folders()
            if (p / "plan.html").is_file()
        ]

    def _free(self) -> None:
        if self._running is not None and self._running.poll() is None:
            raise HTTPException(409, "a plan is being computed; wait for it")

    def _room(self, word: str) -> Path:
        if len(self._folders()) >= MOST_PLANS:
            raise HTTPException(429, f"there are {MOST_PLANS} plans already")
        return next_folder(self.folder, word)

    def _started(self, ledger: Ledger, output: Path, words: list[str]) -> JSONResponse:
        """Starts the computation and tells its end as an event."""
        code = "from skyquilt.cli.main import run; run()"
        command = [sys.executable, "-c", code, "plan", *words, "--quiet"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONIOENCODING": "utf-8"}
        process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            env=environment,
        )
        self._running = process
        ledger_folder = self.folder

        def wait() -> None:
            try:
                said = process.communicate(timeout=PATIENCE_S)[1]
            except subprocess.TimeoutExpired:
                process.kill()
                said = "it took too long"
            own = Ledger(ledger_folder, write=True)
            try:
                if process.returncode == 0:
                    text = f"{output.name} is ready"
                    own.tell("plan", {"state": "ready", "name": output.name, "text": text})
                else:
                    text = plain(said.strip().split("\n")[-1].removeprefix("skyquilt: "), 400)
                    own.tell("plan", {"state": "refused", "name": output.name, "text": text})
            except OutputError:
                pass  # the disk is full: the mapping reports it
            finally:
                own.close()

        threading.Thread(target=wait, daemon=True, name="planning").start()
        ledger.tell("plan", {"state": "planning", "name": output.name})
        return JSONResponse({"state": "planning", "name": output.name}, 202)


def _keep_areas(ledger: Ledger, areas: dict[str, Any]) -> None:
    ledger.put_meta(AREAS, areas)
    ledger.tell("areas", {"areas": len(areas["features"])})


def _drawn(record: dict[str, Any]) -> dict[str, Any]:
    """What a map needs of a plan."""
    on = {row[4]: s["drone"] for s in record["sorties"] for row in s["way"] if row[4] is not None}
    return {
        "area": record["area"],
        "keep_out": record["keep_out"],
        "points": [
            [p["id"], p["longitude"], p["latitude"], on.get(p["id"], 0)] for p in record["points"]
        ],
        "ways": [[row[:2] for row in s["way"]] for s in record["sorties"]],
        "seconds": record["seconds"],
    }
