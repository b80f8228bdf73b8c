"""Routes of 3 drones through 300 points around keep-outs: ten stated instances,
or others by their numbers.

python benchmarks/plan_routes.py [SECONDS [FIRST LAST]]

For each: the longest route over the lower bound, the time that planning took, and whether any leg
meets a keep-out (exact intersection), or any sortie needs more than its endurance less the
reserve.
"""

import sys
import time

import numpy as np
from shapely import LineString, Point, Polygon, box
from shapely.affinity import rotate

from skyquilt.planning.points import height_of, place_points
from skyquilt.planning.records import Drone, KeepOut
from skyquilt.planning.routes import plan_routes
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.site import make_site
from skyquilt.planning.terrain import FLAT
from skyquilt.planning.view import find_view

VIEW = find_view("FC6310")


POINTS = 300


def sized(number):
    """(site, settings, drones, points, proof, warnings) of an instance, scaled until it takes
    `POINTS` points, or as near to that as possible: points come in whole lines.
    """
    scale, best = 0.9, None
    for _ in range(12):
        site, settings, drones = instance(number, scale)
        points, proof, warnings, _ = place_points(site, VIEW, settings, FLAT)
        found = site, settings, drones, points, proof, warnings
        if best is None or abs(len(points) - POINTS) < abs(len(best[3]) - POINTS):
            best = found
        if len(points) == POINTS:
            break
        scale *= 1 + 0.4 * (np.sqrt(POINTS / len(points)) - 1)
    return best


def instance(number, scale):
    """(site, settings, drones): an area with 1 to 4 keep-outs in it."""
    rng = np.random.default_rng(number)
    width, height = scale * rng.uniform(380, 480), scale * rng.uniform(300, 360)
    area = rotate(box(0, 0, width, height), rng.uniform(0, 90), origin=(0, 0))
    if number % 3 == 2:
        area = area.difference(
            rotate(box(width * 0.55, height * 0.5, width, height), 0, origin=(0, 0))
        )
    area = max(getattr(area, "geoms", [area]), key=lambda a: a.area)
    west, south, east, north = area.bounds
    closed = []
    while len(closed) < 1 + number % 4:
        x, y = rng.uniform([west, south], [east, north])
        kind = rng.integers(3)
        shape = (
            Point(x, y).buffer(rng.uniform(15, 35), 8)
            if kind == 0
            else rotate(box(x - 40, y - 8, x + 40, y + 8), rng.uniform(0, 180))
            if kind == 1
            else Polygon([(x, y), (x + 50, y + 10), (x + 20, y + 45)])
        )
        if area.contains(shape.buffer(5)):
            closed.append(KeepOut(shape=shape))
    site = make_site(area, closed, "EPSG:32633")
    settings = PlanSettings(height_m=60, overlap=75, sidelap=65)
    corner = [(west - 20, south - 20), (east + 20, south), (west, north + 20)]
    places = corner if number % 2 else [(corner[0][0] + 25 * k, corner[0][1]) for k in range(3)]
    drones = [
        Drone(name=f"drone {k + 1}", start=p, landing=p, endurance_s=1500, view=VIEW)
        for k, p in enumerate(places)
    ]
    return site, settings, drones


def main():
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else PlanSettings().seconds
    first, last = (int(sys.argv[2]), int(sys.argv[3])) if len(sys.argv) > 3 else (1, 10)
    worst = 0.0
    for number in range(first, last + 1):
        site, settings, drones, points, proof, warnings = sized(number)
        settings = type(settings)(**{**vars(settings), "seconds": seconds})
        middle, spent = time.monotonic(), time.process_time()
        routes = plan_routes(site, points, drones, settings, FLAT, height_of(settings, VIEW))
        took, spent = time.monotonic() - middle, time.process_time() - spent
        visited = sorted(w.point for s in routes.sorties for w in s.way if w.point is not None)
        met = sum(
            k.shape.intersects(LineString([(w.x, w.y) for w in s.way]))
            for s in routes.sorties
            for k in site.keep_out
        )
        longest = max(s.seconds for s in routes.sorties)
        end = max(s.way[-1].time_s for s in routes.sorties)
        over = sum(s.seconds > drones[s.drone].usable_s for s in routes.sorties)
        ratio = longest / routes.bound_s
        worst = max(worst, ratio)
        print(
            f"{number:2d}: {len(points)} points, {len(site.keep_out)} keep-outs,"
            f" {len(routes.sorties)} sorties, longest {longest:.0f} s = {ratio:.3f} x bound"
            f" {routes.bound_s:.0f} s, last landing {end:.0f} s; "
            f" routes {took:.1f} s ({spent:.1f} of CPU);"
            f" {met} legs meet a keep-out, {over} over endurance,"
            f" all points once: {visited == [p.id for p in points]};"
            f" views {proof.least}/{proof.views} {' '.join((*warnings, *routes.warnings))}",
            flush=True,
        )
    print(f"largest ratio {worst:.3f}")


if __name__ == "__main__":
    main()
