"""A survey of 300 photos: what a photo costs, and memory, beside a quarter of it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow
PHOTOS = 300


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Photos of 0.3 MP by three drones over ground without houses that stand (see the program)."""
    folder = tmp_path_factory.mktemp("flight")
    words = ["benchmarks/large_flight.py", str(folder), "--kind", "small", "--photos", str(PHOTOS)]
    subprocess.run([sys.executable, *words], cwd=ROOT, check=True, capture_output=True)
    return folder / "photos"


def mapped(photos, out):
    """Metrics of a map made in one thread by a process of its own."""
    command = [sys.executable, "-m", "skyquilt", "mosaic", str(photos), "-o", str(out)]
    subprocess.run([*command, "--jobs", "1", "--quiet"], check=True)
    return json.loads((out / "metrics.json").read_text())


def test_a_photo_of_a_large_survey_costs_what_one_of_a_small_survey_does(flight, tmp_path):
    quarter = tmp_path / "quarter"
    quarter.mkdir()
    for photo in sorted(flight.iterdir())[: PHOTOS // 4]:
        (quarter / photo.name).symlink_to(photo)
    small, large = mapped(quarter, tmp_path / "small"), mapped(flight, tmp_path / "large")
    assert large["photos_used"] == PHOTOS
    assert large["blocks"] == [PHOTOS]
    assert large["reprojection_error_px"]["rms"] < 0.2
    of_four = 4 * small["cpu_seconds"]
    assert large["cpu_seconds"] < 1.3 * of_four
    assert large["peak_memory_mb"] < 1000
