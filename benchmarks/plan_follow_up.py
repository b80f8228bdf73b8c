"""Follow-up plans on hills, judged by rays that share no code with the planner.

python -m benchmarks.plan_follow_up [NUMBER] [FIRST_SEED]

Random areas as in `benchmarks/plan_coverage.py`, on hills of 60 m from bottom to top. Their plans
are flown with 8 % of the photos lost, 5 % blurred, and all off their places by 0.5 m and 1 degree;
coverage is counted from the outlines of the sharp ones on the true ground, as a live map does;
the follow-up is planned without the file of the heights, as by the button in a live map, and flown
likewise, without losses, until no cell is missing (two rounds at most). Printed: the share of
random places, a third of them on the rim, that the sharp photos of all flights show as often as
asked for, before and after, by rays through the true cameras.
"""

import math
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.planning.judge import CAMERAS, KINDS, Hills, area_of, places_in

from skyquilt.errors import RefusedError
from skyquilt.planning.fill import follow_up
from skyquilt.planning.fleet import alike
from skyquilt.planning.ground_cover import cover_of, to_mercator
from skyquilt.planning.points import place_points
from skyquilt.planning.records import Plan
from skyquilt.planning.settings import PlanSettings
from skyquilt.planning.site import make_site
from skyquilt.planning.terrain import read_terrain
from skyquilt.planning.view import view_of

CRS = "EPSG:32633"


def flown(points, rng):
    """(x, y, z) and rotations from map to camera: off their places, and tilted."""
    found = []
    for p in points:
        yaw, pitch, roll = np.radians([p.yaw, 0, 0]) + rng.normal(0, np.radians(1.0), 3)
        c, s = math.cos(yaw), math.sin(yaw)
        straight = np.array([[c, -s, 0], [-s, -c, 0], [0, 0, -1.0]])
        tilt = cv2.Rodrigues(np.array([pitch, roll, 0.0]))[0]
        found.append((np.array([p.x, p.y, p.z]) + rng.normal(0, 0.5, 3), tilt @ straight))
    return found


def sees(camera, pose, places, z, ground):
    """(n,) whether a photo shows places (n, 2) of heights z."""
    centre, rotation = pose
    K = np.array([[camera.focal, 0, camera.cx], [0, camera.focal, camera.cy], [0, 0, 1]])
    k = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    spots = np.column_stack([places, z]) - centre
    near = np.hypot(spots[:, 0], spots[:, 1]) < 1.3 * -spots[:, 2]
    found = np.zeros(len(places), bool)
    if not near.any():
        return found
    px = cv2.projectPoints(spots[near] @ rotation.T, np.zeros(3), np.zeros(3), K, k)[0][:, 0]
    ok = (np.abs(px - [(camera.width - 1) / 2, (camera.height - 1) / 2])
          <= [camera.width / 2, camera.height / 2]).all(axis=1)  # fmt: skip
    share = np.linspace(0.02, 0.98, 60)[None, :, None]
    on_way = centre + spots[near][:, None] * share
    ok &= (ground.at(on_way[..., 0], on_way[..., 1]) <= on_way[..., 2] + 0.05).all(axis=1)
    found[np.flatnonzero(near)[ok]] = True
    return found


def outline(camera, pose, ground):
    """The photo's rim (m, 2) on the ground."""
    centre, rotation = pose
    w, h, n = camera.width - 0.5, camera.height - 0.5, np.linspace(0, 1, 12)[:-1]
    rim = np.concatenate([
        np.column_stack([a + (c - a) * n, b + (d - b) * n])
        for a, b, c, d in ((-0.5, -0.5, w, -0.5), (w, -0.5, w, h), (w, h, -0.5, h),
                           (-0.5, h, -0.5, -0.5))])  # fmt: skip
    K = np.array([[camera.focal, 0, camera.cx], [0, camera.focal, camera.cy], [0, 0, 1]])
    k = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    rays = cv2.undistortPoints(rim[:, None], K, k)[:, 0]
    rays = np.column_stack([rays, np.ones(len(rays))]) @ rotation
    rays = rays / -rays[:, 2:]
    depth = np.full(len(rays), centre[2] - float(ground.at(centre[0], centre[1])))
    for _ in range(40):
        under = ground.at(centre[0] + rays[:, 0] * depth, centre[1] + rays[:, 1] * depth)
        depth = 0.5 * depth + 0.5 * (centre[2] - under)
    return centre[:2] + rays[:, :2] * depth[:, None]


def one(seed, folder):
    """(kind, points, share before, share after, photos of the follow-ups, rounds)."""
    rng = np.random.default_rng(seed)
    kind, name = KINDS[seed % 6], list(CAMERAS)[seed % 3]
    camera, area, hills = CAMERAS[name], area_of(kind, rng), Hills(60.0, seed)
    view = view_of(camera, name)
    height = rng.uniform(50, 110)
    overlap, sidelap = [(80, 70), (75, 60), (60, 50), (85, 75)][rng.integers(4)]
    settings = PlanSettings(height_m=height, overlap=overlap, sidelap=sidelap, seconds=0.5)
    site = make_site(area, (), CRS)
    hills.write(folder / "dem.tif", area)
    terrain = read_terrain(folder / "dem.tif", CRS, area, 200)
    points, proof, _, _ = place_points(site, view, settings, terrain)
    drones = alike(site, 2, view, start=None, clearance=10.0, separation=20.0)
    options = {k: v for k, v in vars(settings).items() if isinstance(v, int | float)}
    plan = Plan(site=site, drones=drones, points=points, sorties=(), options=options,
                terrain=True, proof=proof)  # fmt: skip
    poses = flown(points, rng)
    fate = rng.permutation(len(points))
    bad = set(fate[: round(0.13 * len(points))].tolist())
    good = [pose for k, pose in enumerate(poses) if k not in bad]
    places = places_in(site.observe, rng)
    z = hills.at(places[:, 0], places[:, 1])
    counts = [sum(sees(camera, pose, places, z, hills) for pose in good)]
    cover = cover_of(site.observe, CRS)
    seen = [cover.seen(to_mercator(outline(camera, pose, hills), CRS)) for pose in good]
    again, more = {points[k].id for k in bad}, 0
    for _ in range(2):
        try:
            plan_again = follow_up(plan, cover, cover.counts(seen), again)
        except RefusedError:
            break
        new = flown(plan_again.points, rng)
        more += len(new)
        seen += [cover.seen(to_mercator(outline(camera, pose, hills), CRS)) for pose in new]
        counts.append(sum(sees(camera, pose, places, z, hills) for pose in new))
        again = set()
    asked = proof.views
    before, after = (float((sum(c) >= asked).mean()) for c in (counts[:1], counts))
    return kind, len(points), before, after, more, len(counts) - 1


def main():
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 24
    first = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    whole, befores, afters = 0, [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(first, first + number):
            kind, points, before, after, more, rounds = one(seed, Path(folder))
            whole += after == 1.0
            befores.append(before)
            afters.append(after)
            print(
                f"seed {seed:4d} {kind:10s} {points:5d} points, {100 * before:5.1f} % of the places"
                f" have their views; {more} photos in {rounds} follow-ups: {100 * after:.2f} %",
                flush=True,
            )
    print(f"all have their views: {whole} of {number}; before {100 * np.mean(befores):.1f} %,"
          f" after {100 * np.mean(afters):.2f} %, least {100 * min(afters):.2f} %")  # fmt: skip


if __name__ == "__main__":
    main()
