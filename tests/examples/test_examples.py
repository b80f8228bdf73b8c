"""Every example runs, and says what it should, on a small simulated flight."""

import os
import re
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from skyquilt.simulate import preset, simulate
from tests.end_to_end.conftest import flight as small_flight  # noqa: F401 - a fixture

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    base = preset("demo")
    route = replace(base.route, photos=6)
    small = replace(base, lens=base.lens.scaled(800, 600), route=route, thermal=None)
    folder = tmp_path_factory.mktemp("flight")
    for _ in simulate(small, folder):
        pass
    return folder


def run(name, *arguments):
    command = [sys.executable, EXAMPLES / name, *arguments]
    done = subprocess.run(
        list(map(str, command)),
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_two_photos(small_flight):  # noqa: F811
    said = run("00_two_photos.py", *sorted((small_flight / "photos").iterdir())[:2])
    assert re.search(r"linked by \d{2,} matches", said)


@pytest.mark.slow
def test_photo_by_photo(small_flight):  # noqa: F811
    said = run("02_photo_by_photo.py", small_flight / "photos")
    assert re.search(r"9 photos, ([89]|[12]\d) links, frame EPSG:32633", said)


@pytest.mark.slow
def test_your_own_features(flight, tmp_path):
    said = run("03_your_own_features.py", flight / "photos", tmp_path / "out")
    assert re.findall(r"(\d) of 6 photos", said) == ["6", "6"]
    usual, own = re.findall(r"(\d+) links", said)
    assert int(own) < int(usual)  # upright features are blind to photos of the way back
    assert all(0.02 < float(px) < 1.0 for px in re.findall(r"reprojection error ([\d.]+) px", said))


@pytest.mark.slow
def test_a_folder_becomes_a_map_that_fits_the_truth(flight, tmp_path):
    said = run("01_folder_to_cog.py", flight / "photos", tmp_path / "out", "15")
    assert "6 of 6 photos by bundle" in said
    assert "EPSG:32633" in said
    judged = run(
        "04_map_against_truth.py",
        tmp_path / "out" / "mosaic.tif",
        flight / "truth" / "truth_ortho.tif",
    )
    bias = [float(m) for m in re.findall(r"([+-][\d.]+) m (?:east|north)", judged)]
    assert max(map(abs, bias)) < 4.0  # GPS noise of 2 m over six photos


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda p: p.name)
def test_without_arguments_each_says_how_to_call_it(path, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(path)])
    with pytest.raises(SystemExit, match=f"python examples/{path.name}"):  # a text: code 1
        runpy.run_path(str(path), run_name="__main__")


def test_they_are_numbered_without_gaps():
    assert [int(p.name[:2]) for p in sorted(EXAMPLES.glob("*.py"))] == list(range(6))


@pytest.mark.slow
@pytest.mark.long
def test_the_loop_of_a_mission_closes_all_holes(tmp_path):
    said = run("05_plan_fly_watch_fill.py", tmp_path)
    assert "and 100.00 % have them" in said  # by the true poses
    shares = [float(s) for s in re.findall(r"flight: ([\d.]+) % of the area", said)]
    assert len(shares) == 2 and shares[0] < 100 == shares[1], said
    assert "\nall have their views\n" in said and "not all" not in said
