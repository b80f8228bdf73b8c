"""The whole loop of a mission: plan an area, fly it with losses, watch the map, plan what is
missing, fly that, and watch again.

python examples/05_plan_fly_watch_fill.py FOLDER

Two drones, a keep-out area, 8 % of the photos lost, 5 % blurred, wind. The flights are simulated,
so that in the end the true poses of all sharp photos tell whether every place has its views.
"""

import json
import sys
from pathlib import Path

import numpy as np
import rasterio
import rasterio.warp

from skyquilt.cli.main import app
from skyquilt.live.fill import iter_fill, known_plan
from skyquilt.live.live_map import PHOTOS, LiveMap
from skyquilt.live.mission import Mission
from skyquilt.planning.missing import planned_cover

SQUARE = [[13.1, 52.1], [13.1018, 52.1], [13.1018, 52.1009], [13.1, 52.1009], [13.1, 52.1]]
BARN = [[13.1008, 52.1004], [13.1011, 52.1004], [13.1011, 52.1005], [13.1008, 52.1004]]
CAMERA = {
    "all": {"projection_type": "perspective", "width": 800, "height": 600, "focal": 0.83}
}  # fmt: skip


def command(*words: object) -> None:
    """Runs a command of Skyquilt in this process."""
    app([str(w) for w in words], standalone_mode=False)


def area(path: Path) -> Path:
    """An area with a place to keep out of."""
    features = [
        {"type": "Feature", "properties": more, "geometry": {"type": "Polygon", "coordinates": [r]}}
        for r, more in ((SQUARE, {}), (BARN, {"keep_out": True}))
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def fly(plan: Path, folder: Path, *more: object) -> Path:
    """A simulated flight of a plan; returns its photos."""
    command("simulate", folder, "--plan", plan, "--gcp", 0, "--checks", 0, "--relief", 3,
            "--gps-noise", 1, "--seed", 5, "--wind", "3,240", "--quiet", "--overwrite",
            *more)  # fmt: skip
    return folder / "photos"


def watch(live: LiveMap, photos: Path, words: str) -> float:
    """Maps photos as they arrive; prints and returns the share of the area that has its views."""
    for path in sorted(photos.iterdir()):
        live.add(path, source=words)
    for _ in live.drain_all():
        pass
    mission = Mission(folder=live.folder, plan=known_plan(live.folder))
    state = mission.look(live.ledger, live.folder / PHOTOS)
    kinds = {k: sum(s == k for s in state.points.values()) for k in set(state.points.values())}
    print(
        f"{words}: {100 * state.share:.1f} % of the area has its {state.views} views,"
        f" {state.missing_m2:.0f} m2 have not; {len(state.unsharp)} photos are unsharp; points:"
        f" {', '.join(f'{n} {k}' for k, n in sorted(kinds.items()))}"
    )
    return state.share


def true_share(live: LiveMap, flights: list[Path]) -> float:
    """Share of the plan's cells that enough sharp photos truly show: each is projected, at its
    true height, by the true poses and cameras.
    """
    plan = known_plan(live.folder)
    cover = planned_cover(plan)
    row, column = np.nonzero(cover.inside)
    x, y = cover.affine * (column + 0.5, row + 0.5)
    seen = np.zeros(len(x), int)
    for flight in flights:
        truth = json.loads((flight / "truth" / "truth.json").read_text())
        with rasterio.open(flight / "truth" / "truth_surface.tif") as surface:
            east, north = map(np.array, rasterio.warp.transform("EPSG:3857", surface.crs, x, y))
            heights = surface.read(1)
            c, r = (np.floor(v).astype(int) for v in ~surface.transform * (east, north))
        rows, columns = heights.shape
        known = np.flatnonzero((r >= 0) & (r < rows) & (c >= 0) & (c < columns))
        z = heights[r[known], c[known]]
        places = np.column_stack([east[known], north[known], z])
        for photo in truth["photos"]:
            lens = truth["cameras"][photo["camera"]]
            ray = (places - photo["position"]) @ np.array(photo["cam_R_map"]).T
            u, v = (
                lens["focal"] * ray[:, k] / ray[:, 2] + lens[m] for k, m in ((0, "cx"), (1, "cy"))
            )
            ok = (ray[:, 2] > 0) & (u >= -0.5) & (u <= lens["width"] - 0.5)
            ok &= (v >= -0.5) & (v <= lens["height"] - 0.5)
            seen[known[ok]] += not photo["blurred"]
    return float((seen >= plan.proof.views).mean())


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    plan = folder / "plan"
    command("plan", area(folder / "area.geojson"), "-o", plan, "--camera", folder / "camera.json",
            "--height", 50, "--overlap", 75, "--sidelap", 65, "--views", 4, "--drones", 2,
            "--clearance", 5, "--seconds", 2, "--overwrite", "--quiet")  # fmt: skip
    first = fly(plan / "plan.json", folder / "flight-1", "--lost", 8, "--blurred", 5)
    live = LiveMap(folder / "live")
    try:
        known_plan(live.folder, plan / "plan.json")
        before = watch(live, first, "first flight")
        for told in iter_fill(live.folder, live.ledger, live.folder / PHOTOS):
            print(getattr(told, "text", ""))
        again = live.folder / "plans" / "fill-1" / "plan.json"
        second = fly(again, folder / "flight-2")
        after = watch(live, second, "second flight")
        flights = [first.parent, second.parent]
        truly = [true_share(live, flights[:1]), true_share(live, flights)]
    finally:
        live.close()
    print("all have their views" if after == 1 > before else "not all have their views")
    print(
        f"by the true poses {100 * truly[0]:.2f} % had them, and {100 * truly[1]:.2f} % have them"
    )


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
