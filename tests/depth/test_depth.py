"""Depth maps of a simulated flight against the heights it was flown over."""

import json
import shutil

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.warp import Resampling, reproject

from skyquilt.depth.workflow import depth, iter_depth
from skyquilt.errors import OutputError, RefusedError, UsageError
from skyquilt.model.event import Note, StageStarted
from skyquilt.settings import MosaicSettings
from skyquilt.simulate import FlightSettings, simulate
from skyquilt.simulate.camera import Lens
from skyquilt.simulate.settings import Control, Reporting, Route

SETTINGS = MosaicSettings(gsd_cm=25, features=3000, jobs=2)


def against_truth(output, flight):
    """Correlation with the true heights, the slope of the found ones over them, and the share of
    the map; without a general slope, where both fit best by a similarity on the ground: two
    positions and a compass tell place, heading and scale of a pair to metres, degrees and some
    per cent. A wrong scale remains in the slope.
    """
    z, true = maps(output, flight)
    fitted = fits_best(z, true)
    return (*agreement(z, placed(true, *fitted)), np.isfinite(z).mean())


def maps(output, flight):
    """The heights found, and the true ones on the same grid."""
    truth_file = flight / "truth" / "truth_surface.tif"
    with rasterio.open(output / "depth.tif") as found, rasterio.open(truth_file) as truth:
        z, true = found.read(1), np.full(found.shape, np.nan, np.float32)
        reproject(
            rasterio.band(truth, 1),
            true,
            dst_transform=found.transform,
            dst_crs=found.crs,
            dst_nodata=np.nan,
            resampling=Resampling.average,
        )
    return z, true


REACH = (20, 20, 5.0, 0.1)
"""Largest shifts in px, turn in degrees and change of scale that are tried."""


def fits_best(z, true):
    """The shift (x and y, px), the turn in degrees and the change of scale about the middle of the
    map by which both correlate best.
    """
    best, score = (0, 0, 0.0, 0.0), agreement(z, true)[0]
    whole = [(x, y, 0, 0) for y in range(-20, 21, 4) for x in range(-20, 21, 4)]
    turns = [(0, 0, t, 0) for t in (-2, -1, -0.5, -0.25, 0.25, 0.5, 1, 2)]
    scales = [(0, 0, 0, s) for s in (-0.04, -0.02, -0.01, -0.005, 0.005, 0.01, 0.02, 0.04)]
    near = [(x, y, 0, 0) for y in range(-2, 3) for x in range(-2, 3)]
    for steps in (whole, near, *(turns, scales, near) * 3):
        start = best
        for step in steps:
            tried = tuple(np.add(start, step))
            if (np.abs(tried) > REACH).any():
                continue
            if (r := agreement(z, placed(true, *tried))[0]) > score:
                best, score = tried, r
    return best


def placed(true, dx, dy, turn_deg, scale):
    """A map (H, W) shifted by so many px, turned and enlarged by a share about its middle."""
    height, width = true.shape
    middle = ((width - 1) / 2, (height - 1) / 2)
    change = cv2.getRotationMatrix2D(middle, turn_deg, 1 + scale)
    change[:, 2] += dx, dy
    return cv2.warpAffine(
        true, change, (width, height), borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    )


def agreement(z, true):
    known = np.isfinite(z) & np.isfinite(true)
    row, column = np.nonzero(known)
    terms = np.c_[np.ones(len(row)), row, column][::7]
    a, b = z[known][::7], true[known][::7]
    a, b = (v - terms @ np.linalg.lstsq(terms, v, rcond=None)[0] for v in (a, b))
    return np.corrcoef(a, b)[0, 1], (a @ b) / (b @ b)


@pytest.mark.slow
@pytest.mark.parametrize("route", ["disparities", "reconstruction"])
def test_a_survey_shows_its_heights(flight, finished, tmp_path, route):
    result = depth(flight / "photos", tmp_path / "out", SETTINGS, route=route)
    r, slope, share = against_truth(tmp_path / "out", flight)
    # which keypoints are kept, by hardly different pictures, moves the slope by 0.06 and r by 0.02
    assert r > 0.7 and 0.55 < slope < 1.1 and share > 0.4
    assert result.metrics["route"] == route and result.metrics["unit"] == "m"
    with (
        rasterio.open(tmp_path / "out" / "depth.tif") as found,
        rasterio.open(finished.output / "mosaic.tif") as m,
    ):
        assert found.crs == m.crs and found.units == ("m",) and found.tags()["ROUTE"] == route
        assert (
            np.abs(np.array(found.bounds) - np.array(m.bounds)).max() < 4
        )  # positions alone against control points
    picture = cv2.imread(str(tmp_path / "out" / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape[2] == 4 and 0.3 < (picture[..., 3] > 0).mean() < 1
    assert "<img" in (tmp_path / "out" / "report.html").read_text()


@pytest.fixture(scope="module")
def known_places(tmp_path_factory):
    """Photos whose positions are good to 5 cm: what is wrong is the matching's."""
    folder = tmp_path_factory.mktemp("known")
    settings = FlightSettings(
        seed=3,
        lens=Lens().scaled(800, 600),
        route=Route(photos=4),
        reporting=Reporting(gps_noise=0.05),
        control=Control(points=0, checks=0),
    )
    for _ in simulate(settings, folder, overwrite=True):
        pass
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 2])
def test_a_pair_shows_the_heights_of_what_stands_there(known_places, tmp_path, first):
    """The features of the same pairs, interpolated, have r below 0.8 and slopes below 0.7."""
    photos = sorted((known_places / "photos").glob("*.jpg"))[first : first + 2]
    depth(photos, tmp_path / "out", SETTINGS)
    r, slope, _ = against_truth(tmp_path / "out", known_places)
    assert r >= 0.9 and 0.9 <= slope <= 1.1


@pytest.mark.slow
def test_pairs_show_their_heights_where_positions_err_by_two_metres(flight, tmp_path):
    """Positions alone put the last pair 23 % too near, and its heights are as much too low."""
    photos, told = sorted((flight / "photos").glob("*.jpg")), []
    for k in (0, 3, 6):
        *events, _ = iter_depth(photos[k : k + 2], tmp_path / "out", SETTINGS, overwrite=True)
        told.append(against_truth(tmp_path / "out", flight)[:2])
    assert any("rests on heights above take-off" in e.text for e in events if isinstance(e, Note))
    r, slope = np.array(told).T
    assert r.min() >= 0.9 and 0.9 <= slope.min() <= slope.max() <= 1.1, told


@pytest.mark.slow
def test_two_photos_show_their_heights_and_their_field(flight, tmp_path):
    photos = sorted((flight / "photos").glob("*.jpg"))[:2]
    result = depth(photos, tmp_path / "out", SETTINGS)
    r, slope, _ = against_truth(tmp_path / "out", flight)
    assert result.metrics["route"] == "pair" and r >= 0.9 and 0.9 <= slope <= 1.1
    (pair,) = json.loads((tmp_path / "out" / "depth.json").read_text())["pairs"]
    field = cv2.imread(str(tmp_path / "out" / "pairs" / pair["field"]))
    assert field.shape == (562, 750, 3) and field.std() > 5
    others = sorted((flight / "photos").glob("*.jpg"))[1:3]
    depth(others, tmp_path / "out", SETTINGS, overwrite=True)
    (left,) = (tmp_path / "out" / "pairs").iterdir()
    assert left.name != pair["field"]  # nothing of the former run stays


@pytest.mark.slow
def test_a_photo_that_is_lost_meanwhile_is_left_out(flight, tmp_path):
    """The heights are those of the others alone."""
    for name in ("whole", "others"):
        shutil.copytree(flight / "photos", tmp_path / name)
    gone = sorted((tmp_path / "whole").glob("*.jpg"))[4]
    (tmp_path / "others" / gone.name).unlink()
    notes = []
    for event in iter_depth(tmp_path / "whole", tmp_path / "out", SETTINGS):
        if isinstance(event, StageStarted) and event.stage == "features":
            gone.unlink(missing_ok=True)
        notes += [event.text] if isinstance(event, Note) else []
    assert f"{gone.name} is left out: its file is gone" in notes
    depth(tmp_path / "others", tmp_path / "fewer", SETTINGS)
    with (
        rasterio.open(tmp_path / "out" / "depth.tif") as found,
        rasterio.open(tmp_path / "fewer" / "depth.tif") as alone,
    ):
        assert np.array_equal(found.read(1), alone.read(1), equal_nan=True)


@pytest.mark.slow
def test_of_two_photos_none_may_be_lost(flight, tmp_path):
    for path in sorted((flight / "photos").glob("*.jpg"))[:2]:
        shutil.copy(path, tmp_path / path.name)
    a, b = sorted(tmp_path.glob("*.jpg"))
    events = iter_depth([a, b], tmp_path / "out", SETTINGS)
    notes = []
    with pytest.raises(UsageError, match="at least two photos"):
        for event in events:
            if isinstance(event, StageStarted) and event.stage == "features":
                b.unlink()
            notes += [event.text] if isinstance(event, Note) else []
    assert any(b.name in note and "is gone" in note for note in notes)


def test_what_tells_no_height_is_refused(small_flight, tmp_path):
    one, *_, last = far = sorted((small_flight / "photos").glob("*.jpg"))
    with pytest.raises(UsageError, match="at least two photos"):
        list(iter_depth([one], tmp_path / "a"))
    with pytest.raises(UsageError, match="--route 'guess'"):
        list(iter_depth([one, last], tmp_path / "a", route="guess"))
    noise = np.random.default_rng(0).integers(0, 255, (360, 480, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "noise.jpg"), noise)
    with pytest.raises(RefusedError, match="of the first two: they do not match"):
        depth([far[0], tmp_path / "noise.jpg"], tmp_path / "b", SETTINGS)
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="already holds files"):
        depth(far[:2], tmp_path / "c", SETTINGS)
