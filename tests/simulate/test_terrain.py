"""Kinds of terrain: their shapes by formula, what stands on them, and waves that move."""

from functools import cache
from typing import get_args

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from skyquilt.cli.main import app
from skyquilt.cli.simulate import TerrainName
from skyquilt.simulate.canvas import Canvas
from skyquilt.simulate.expose import exposer
from skyquilt.simulate.flight import Shot, Waypoint
from skyquilt.simulate.grid import Grid
from skyquilt.simulate.ground import Ground
from skyquilt.simulate.noise import Noise
from skyquilt.simulate.scene import Country, SceneSettings, empty_scene
from skyquilt.simulate.settings import Pictures
from skyquilt.simulate.terrain import DECK_M, WATER_M, Terrain
from skyquilt.simulate.weather import Weather
from tests.simulate.test_geometry import LENS

BOUNDS = (-110.0, -110.0, 110.0, 110.0)


@cache
def country(kind: Terrain) -> Country:
    return Country(settings=SceneSettings(kind=kind), bounds=BOUNDS, seed=5)


def added(kind: Terrain, x: float, y: float) -> float:
    """By how much a place is higher than with hills only."""
    hills = Ground(noise=Noise(seed=5), relief=6.0)
    return Ground(noise=Noise(seed=5), relief=6.0, kind=kind).at(x, y) - hills.at(x, y)


@pytest.mark.parametrize(
    ("kind", "place", "higher"),
    [
        ("cliff", (-30, 8), 0.0),
        ("cliff", (30, 8), -45.0),
        ("quarry", (3, 2), -36.0),
        ("quarry", (80, 0), 0.0),
        ("bridge", (0, 20 * np.pi), -22.0),
        ("bridge", (0, 0.9 * DECK_M), 0.0),
        ("slope", (20, 70 * np.arctanh(0.5)), -20.0),
        ("slope", (-50, -70 * np.arctanh(0.5)), 20.0),
        ("town", (10, 10), 0.0),
        ("bare", (10, 10), 0.0),
    ],
)
def test_ground_is_shaped_as_stated(kind, place, higher):
    assert added(kind, *place) == pytest.approx(higher, abs=1e-3)


def test_a_mountain_side_falls_by_thirty_degrees():
    fall = (added("slope", 0, -2) - added("slope", 0, 2)) / 4
    assert np.degrees(np.arctan(fall)) == pytest.approx(30, abs=0.5)


@pytest.mark.parametrize("kind", ["cliff", "quarry", "bridge", "shore", "slope"])
def test_a_window_has_the_heights_of_its_points(kind):
    """Cells as small as a photo's are no smoother than the shape: a wall stays a wall."""
    ground = Ground(noise=Noise(seed=5), relief=6.0, kind=kind)
    window = Grid(left=-8.0, top=8.0, res=0.1, width=160, height=160)
    heights = ground.heights(window)
    rng = np.random.default_rng(0)
    for row, col in rng.integers(0, 160, (12, 2)):
        point = ground.at(float(window.xs[col]), float(window.ys[row]))
        assert heights[row, col] == pytest.approx(point, abs=0.03)


@pytest.mark.slow
def test_a_lake_is_level_and_nothing_stands_in_it():
    shore = country("shore")
    lake = shore.ground.heights(Grid(left=-100.0, top=50.0, res=1.0, width=60, height=100))
    assert (lake == np.float32(WATER_M)).all()
    assert shore.ground.at(60, 0) > WATER_M + 5
    things = [*shore.layout.trees, *shore.layout.houses, *shore.layout.cars]
    assert len(things) > 100
    assert all(shore.ground.at(thing.x, thing.y) > WATER_M for thing in things)
    assert len(country("landscape").layout.trees) > len(shore.layout.trees)


def test_a_town_has_tall_houses_and_bare_land_none():
    eaves = [house.eave for house in country("town").layout.houses]
    assert len(eaves) > 40
    assert min(eaves) >= 10
    assert max(eaves) > 28
    bare = country("bare").layout
    assert not bare.houses
    assert {parcel.kind for parcel in bare.parcels} == {"bare", "stubble"}


@pytest.mark.slow
def test_waves_move_from_photo_to_photo_and_the_shore_does_not(tmp_path):
    shore, weather = country("shore"), Weather()
    scene = empty_scene(shore.grid(0.25), thermal=False, scratch=tmp_path, water=WATER_M)
    list(shore.draw(scene, weather, scratch=tmp_path))
    way = Waypoint(x=-5.0, y=0.0, heading=0.0, line=0)
    shot = Shot(name="a", waypoint=way, centre=(-5.0, 0.0, 60.0), yaw=0.0, pitch=0.0, roll=0.0)
    camera = exposer(scene, LENS.scaled(320, 240))
    clean = Pictures(exposure_noise=0, vignetting=0, noise=0)
    first, second = (
        camera.visible(shot, clean, 1.0, np.random.default_rng(k)).mean(axis=2) for k in (1, 2)
    )
    hits, heights, _ = camera.pixels(shot)
    water = heights < WATER_M + 0.01
    assert 0.2 < water.mean() < 0.8
    land = cv2.erode((heights > WATER_M + 0.1).astype(np.uint8), np.ones((9, 9))) > 0
    assert np.array_equal(first[land], second[land])
    assert np.corrcoef(first[water], second[water])[0, 1] < 0.5
    assert first[water].std() > 8


@pytest.mark.slow
def test_a_cliff_is_flown_and_low_flights_are_refused(tmp_path):
    assert get_args(TerrainName) == get_args(Terrain)
    words = ["--terrain", "cliff", "--photos", "2", "--size", "200x150", "--quiet"]
    low = CliRunner().invoke(app, ["simulate", str(tmp_path / "a"), *words, "--height", "60"])
    assert low.exit_code != 0
    assert "at least 70 m over cliff" in str(low.exception)
    high = CliRunner().invoke(app, ["simulate", str(tmp_path / "b"), *words, "--height", "70"])
    assert high.exit_code == 0, high.output


def test_few_places_have_the_noise_of_many():
    noise, land = Noise(seed=5), Grid(left=-40.3, top=22.1, res=0.7, width=90, height=70)
    whole = noise.fractal(land, 40.0, 3.0, 0.6, 9)
    for row, col, height, width in [(0, 0, 5, 5), (61, 80, 8, 8), (30, 41, 1, 1), (33, 12, 2, 3)]:
        few = noise.fractal(land.window(row, col, height, width), 40.0, 3.0, 0.6, 9)
        assert few.dtype == np.float32
        assert few == pytest.approx(whole[row : row + height, col : col + width], abs=1e-6)


def painted(kind: Terrain, x: float, y: float) -> Canvas:
    """12 x 12 m about a place, as large as the painter's blocks have them, without sunlight."""
    grid = country(kind).grid(0.1).around(x, y, 6.0)
    return country(kind).paint(grid, Weather())


def test_panels_are_alike_and_the_ground_between_is_not():
    """Rows 8 m apart: brightness and height above the ground repeat, grass does not."""
    parcels = [p for p in country("solar").layout.parcels if np.hypot(*p.outline.mean(axis=0)) < 70]
    x, y = max((p.outline for p in parcels), key=lambda o: np.ptp(o, axis=0).min()).mean(axis=0)
    low, high = (painted("solar", x, y + up) for up in (0.0, 8.0))
    above = low.height - low.ground
    panel = above > 0.5
    assert 0.3 < panel.mean() < 0.5
    assert above[panel].max() == pytest.approx(0.8 + 0.45 * 3.6, abs=0.1)
    np.testing.assert_allclose(above[panel], (high.height - high.ground)[panel], atol=1e-3)
    same = np.corrcoef(low.look[panel][:, 1], high.look[panel][:, 1])[0, 1]
    other = np.corrcoef(low.look[~panel][:, 1], high.look[~panel][:, 1])[0, 1]
    assert same > 0.98
    assert abs(other) < 0.3


def test_orchards_have_trees_in_rows_and_dunes_nothing_but_ripples():
    trees = [t for t in country("orchard").layout.trees if t.height < 4.6]
    places = np.array([(t.x, t.y) for t in trees])
    nearest = cKDTree(places).query(places, k=2)[0][:, 1]
    assert np.median(nearest) == pytest.approx(6.0, abs=0.6)
    assert np.ptp([t.radius for t in trees if t.radius > 1.5]) < 1.2
    dunes = country("dunes")
    assert not dunes.layout.trees
    assert not dunes.layout.roads
    look = painted("dunes", 5.0, 5.0).look[..., 1]
    assert look.std() / look.mean() < 0.05


def test_crops_are_rows_everywhere():
    assert {p.kind for p in country("crops").layout.parcels} == {"crop", "maize"}
