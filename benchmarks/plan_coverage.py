"""Random areas planned, and every one judged by rays that share no code with the planner.

python -m benchmarks.plan_coverage [NUMBER] [FIRST_SEED]

Areas: rectangles, concave outlines, outlines with holes, several at once, slivers, corridors; half
of them on hills of up to 60 m from bottom to top; three cameras, two with distortion. Prints the
areas whose ground is not seen as often as asked for, and, for rectangles on flat ground, the photos
over those of the perfect grid of docs/planning.md.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.planning.judge import CAMERAS, KINDS, Hills, area_of, perfect, places_in, views_by_rays

from skyquilt.planning.points import place_points
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.site import make_site
from skyquilt.planning.terrain import FLAT, read_terrain
from skyquilt.planning.view import view_of


def one(seed, folder):
    """(kind, whether all is seen, points, seconds, photos over the perfect grid or None)."""
    rng = np.random.default_rng(seed)
    kind, name = KINDS[seed % 6], list(CAMERAS)[seed % 3 if seed % 2 else (seed // 2) % 3]
    camera = CAMERAS[name]
    area = area_of(kind, rng)
    relief = 60.0 if (seed // 6) % 2 else 0.0
    hills = Hills(relief, seed)
    view = view_of(camera, name)
    height = rng.uniform(50, 110)
    overlap, sidelap = [(80, 70), (75, 60), (60, 50), (85, 75)][rng.integers(4)]
    views = [None, None, 4, 6][rng.integers(4)]
    settings = PlanSettings(height_m=height, overlap=overlap, sidelap=sidelap, views=views)
    site = make_site(area, (), "EPSG:32633")
    terrain = FLAT
    if relief:
        hills.write(folder / "dem.tif", area)
        terrain = read_terrain(folder / "dem.tif", "EPSG:32633", area, 200)
    begun = time.process_time()
    points, proof, _, _ = place_points(site, view, settings, terrain)
    seconds = time.process_time() - begun
    ground = hills if relief else Hills(0.0, seed)
    if not relief:
        points = [type(p)(**{**vars(p), "z": p.z + 200.0}) for p in points]
    seen = views_by_rays(camera, points, ground, places_in(site.observe, rng))
    ratio = None
    if kind == "rectangle" and not relief and views is None:
        x, y = np.array(area.exterior.coords.xy)
        sides = np.hypot(np.diff(x), np.diff(y))
        ratio = len(points) / perfect(
            sides[0], sides[1], settings, view.along * height, view.across * height
        )
    return kind, int(seen.min()), proof, len(points), seconds, ratio


def main():
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    good, ratios = 0, []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(first, first + number):
            kind, least, proof, points, seconds, ratio = one(seed, Path(folder))
            fine = least >= proof.views and proof.missing_m2 == 0
            good += fine
            if ratio is not None:
                ratios.append(ratio)
            if not fine or seed % 10 == 0:
                print(
                    f"seed {seed:4d} {kind:10s} {points:5d} points, {seconds:5.1f} CPU s, least"
                    f" {least} of {proof.views} by rays, {proof.least} by cells,"
                    f" {'good' if fine else 'SHORT'}",
                    flush=True,
                )
    print(f"{good} of {number} areas have the views asked for everywhere")
    if ratios:
        print(
            f"rectangles over the perfect grid: mean {np.mean(ratios):.3f}, most {max(ratios):.3f}"
            f" ({len(ratios)} rectangles)"
        )


if __name__ == "__main__":
    main()
