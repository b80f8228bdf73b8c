"""Does a plan of 1,000 points slow the live map down? The same photos, in turn without and with it.

python benchmarks/live_plan.py PHOTOS [ROUNDS]

Prints the median and the 90th percentile of the time from the arrival of a photo to its place on
the drawn map, with the server in its own process as `skyquilt live` runs it.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from shapely import box

from skyquilt.alignment.priors import utm_epsg
from skyquilt.live.fill import known_plan
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.photos.survey import read_survey
from skyquilt.planning.plan_file import write_plan
from skyquilt.planning.records import Drone, PicturePoint, Plan, Proof, Sortie, Waypoint
from skyquilt.planning.site import in_zone, make_site
from skyquilt.planning.view import find_view
from skyquilt.server.access import Guard
from skyquilt.server.server_process import ServerConfig, ServerProcess


def plan_around(photos: Path, path: Path) -> None:
    """A plan of 1,000 points over the place of some photos."""
    survey = read_survey(photos)
    first = next(p for p in survey.photos if p.position is not None).position
    assert first is not None
    crs = utm_epsg(first.latitude_deg, first.longitude_deg)
    x, y = in_zone(crs, np.array([[first.longitude_deg, first.latitude_deg]]))[0]
    points = tuple(
        PicturePoint(id=k + 1, x=x - 160 + 8 * (k % 40), y=y - 125 + 10 * (k // 40), z=60.0,
                     ground=0.0, yaw=0.0)
        for k in range(1000)
    )  # fmt: skip
    drone = Drone(name="one", start=(x, y), landing=(x, y), view=find_view("FC6310"))
    way = tuple(Waypoint(x=p.x, y=p.y, z=p.z, time_s=3.0 * p.id, point=p.id) for p in points)
    proof = Proof(views=6, cell_m=1.0, cells=1, least=6, median=6.0, missing_m2=0.0,
                  closed_m2=0.0, gsd_cm=(1.0, 1.0), overlap=0.8)  # fmt: skip
    write_plan(path, Plan(
        site=make_site(box(x - 160, y - 125, x + 160, y + 125), (), crs), drones=(drone,),
        points=points, sorties=(Sortie(drone=0, number=1, way=way),), options={}, terrain=False,
        proof=proof,
    ))  # fmt: skip


def latencies(photos: list[Path], folder: Path, plan: Path | None) -> list[float]:
    """Seconds from the arrival of each photo to the end of its drawing; one a second arrives."""
    settings = LiveSettings()
    live = LiveMap(folder, settings)
    found = []
    try:
        if plan is not None:
            known_plan(folder, plan)
        with ServerProcess(asked=ServerConfig(folder=folder, settings=settings, guard=Guard())):
            for path in photos:
                began = time.perf_counter()
                live.intake.take_file(path, "a")
                while (update := live.work()) is not None:
                    if update.what == "drawn":
                        break
                found.append(time.perf_counter() - began)
                for _ in live.drain():
                    pass
                time.sleep(max(0.0, 1.0 - (time.perf_counter() - began)))
    finally:
        live.close()
    return found


def main() -> None:
    folder, rounds = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 2
    photos = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg"))[:12]
    times: dict[str, list[float]] = {"without": [], "with": []}
    with tempfile.TemporaryDirectory() as top:
        plan = Path(top) / "plan.json"
        plan_around(folder, plan)
        assert len(json.loads(plan.read_text())["points"]) == 1000
        for number in range(rounds):
            for word in ("without", "with") if number % 2 == 0 else ("with", "without"):
                out = Path(top) / f"{word}-{number}"
                times[word] += latencies(photos, out, plan if word == "with" else None)
    for word, found in times.items():
        median, late = np.percentile(found, [50, 90])
        print(f"{word:8s} {len(found)} photos: median {median:.3f} s, 90 % within {late:.3f} s")
    ratio = np.median(times["with"]) / np.median(times["without"])
    print(f"ratio of medians {ratio:.3f}")


if __name__ == "__main__":
    main()
