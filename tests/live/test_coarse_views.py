"""Photos of a growing map yield to much finer ones where its pixels show the difference; of many,
those are drawn that show a place best.
"""

import io

import numpy as np
import piexif
import pytest
from PIL import Image

from skyquilt.geometry.frames import cam_R_map_from_angles
from skyquilt.imaging.nodes import View, project_nodes
from skyquilt.imaging.views import footprint, make_views
from skyquilt.live.coarse_views import showing_best, yielding_to_finer
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.live.tile_drawing import MOST_VIEWS, WHOLE
from skyquilt.model.camera import Camera
from skyquilt.model.poses import Pose
from skyquilt.model.raster import Grid
from skyquilt.ortho.blend import Feather
from skyquilt.ortho.tie_surface import level
from tests.live.conftest import fed
from tests.ortho.test_sharpness import flight as levelled
from tests.ortho.test_spoilt import of_two_cameras


def test_a_higher_photo_yields_in_the_middle_of_its_picture():
    """Every other photo is 40 m higher up: beside what the others show, nothing takes its place."""
    views = make_views(of_two_cameras(levelled(10, apart=9.0), 40.0, 1.0), level(0.0))
    sizes = {v.photo: float(v.pose.map_C[2]) / v.camera.focal for v in views}
    fine, coarse = min(sizes.values()), max(sizes.values())
    found = yielding_to_finer(views, sizes, level(0.0), fine)
    marked = [v.photo for v in found if v.limits.mark is not None]
    assert marked == [1, 3, 5, 7, 9]
    room = found[5].limits.mark.at(np.full(3, 200.0), np.array([10.0, 150.0, 290.0]))
    assert room[1] < 0 < min(room[0], room[2])
    same = yielding_to_finer(views, sizes, level(0.0), 1.1 * coarse)  # the map shows it no finer
    assert all(a is b for a, b in zip(same, views, strict=True))


def orbit(photos, radius, height):
    """Views of photos around a place at the origin, all looking at it from above ground at zero."""
    camera = Camera(width=960, height=720, focal=800.0, cx=479.5, cy=359.5)
    tilt = np.degrees(np.arctan2(radius, height))
    views = []
    for k, at in enumerate(np.linspace(0, 360, photos, endpoint=False)):
        C = [radius * np.sin(np.radians(at)), radius * np.cos(np.radians(at)), height]
        pose = Pose(cam_R_map=cam_R_map_from_angles(at + 180, tilt, 0.0), map_C=np.array(C))
        outline = footprint(camera, pose, level(0.0))
        views.append(View(photo=k, camera=camera, pose=pose, footprint=outline))
    return views


@pytest.mark.parametrize("radius", [75.0, 60.0])
def test_neighbouring_tiles_of_an_orbit_show_a_roof_between_them_at_one_place(radius):
    """Drawn from other photos on the two sides, what stands there breaks at the rim of a tile."""
    views, y = orbit(40, radius, 75.0), np.linspace(-24.0, 26.0, 60)[:, None]
    apart = []
    for rim in (-51.2, -25.0, 0.0, 10.0):
        leans = []
        for west in (rim - 51.2, rim):
            grid = Grid(gsd=0.2, west=west, north=26.4, width=256, height=256)
            tile = showing_best(views, grid, level(0.0), MOST_VIEWS)
            nodes = [project_nodes(v, np.full_like(y, rim), y, np.zeros_like(y)) for v in tile]
            score = np.array([np.where(n.seen, n.score, np.inf)[:, 0] for n in nodes])
            C = np.array([v.pose.map_C for v in tile])[score.argmin(0)]
            leans.append((np.column_stack([np.full(60, rim), y[:, 0]]) - C[:, :2]) / C[:, 2:])
        apart.append(5.0 * np.hypot(*(leans[0] - leans[1]).T))  # m, of a roof 5 m high
    assert (np.concatenate(apart) > 0.5).mean() < 0.02


@pytest.mark.parametrize(("radius", "north"), [(75.0, 110.0), (75.0, 20.0), (5.0, 40.0)])
def test_a_tile_is_drawn_from_the_photos_that_show_its_places_best(radius, north):
    """The nearest ones of an orbit look away from the ground below them: it stayed empty."""
    views = orbit(60, radius, 75.0)
    grid = Grid(gsd=0.2, west=-25.0, north=north, width=256, height=256)
    some = showing_best(views, grid, level(0.0), MOST_VIEWS)
    assert len(some) == MOST_VIEWS and [v.photo for v in some] == sorted(v.photo for v in some)
    x, y = np.meshgrid(np.linspace(-20, 20, 12), np.linspace(north - 5, north - 45, 12))
    best = []
    for among in (views, some):
        nodes = [project_nodes(v, x, y, np.zeros_like(x)) for v in among]
        best.append(np.min([np.where(n.seen, n.score, np.inf) for n in nodes], axis=0))
    assert np.isfinite(best[0]).mean() > 0.9
    assert np.array_equal(np.isfinite(best[0]), np.isfinite(best[1]))
    seen = np.isfinite(best[0])
    assert (best[1][seen] < 1.2 * best[0][seen] + 0.05).all()  # nearly as from straight above
    assert showing_best(views[:24], grid, level(0.0), MOST_VIEWS) == views[:24]


@pytest.mark.slow
def test_a_growing_map_shows_the_finer_photos(flight, tmp_path):
    """The two in the middle of each line have pixels five times as large: they were drawn where
    they look down most steeply.
    """
    paths = []
    for k, path in enumerate(flight.photos):
        image = Image.open(path)
        held = io.BytesIO()
        tags, size = piexif.load(image.info["exif"]), image.size
        if k in (1, 4):
            size = (96, 72)
            for tag in ("FocalPlaneXResolution", "FocalPlaneYResolution"):
                count, per = tags["Exif"][getattr(piexif.ExifIFD, tag)]
                tags["Exif"][getattr(piexif.ExifIFD, tag)] = (count, 5 * per)
        exif = piexif.dump(tags)
        image.resize(size).save(held, "JPEG", quality=95, exif=exif, xmp=image.info.get("xmp"))
        paths.append(tmp_path / path.name)
        paths[-1].write_bytes(held.getvalue())
    live = fed(LiveMap(tmp_path / "out", LiveSettings(deterministic=True, gsd_cm=15.0)), paths)
    coarse = {m.id for m in live.members.on_map() if m.photo.width == 96}
    assert len(coarse) == 2
    both = shown = 0
    for address in live.tiles.addresses("visible", 0):
        if (compose := live.canvas._composer(address, Feather(width_px=2.0))) is None:
            continue  # a photo that moved since has left it empty
        plan = compose.plan(WHOLE)
        drawn = compose.drawn(plan).photo[8::16, 8::16]
        rows, columns = drawn.shape
        seen = [n.seen[1 : 1 + rows, 1 : 1 + columns] for i, n in plan.projected.items()
                if i not in coarse]  # fmt: skip
        fine = np.any(seen, axis=0) if seen else np.zeros(drawn.shape, bool)
        both += int(fine.sum())
        shown += int((fine & np.isin(drawn, list(coarse))).sum())
    assert both > 100
    assert shown < 0.08 * both
    live.close()
