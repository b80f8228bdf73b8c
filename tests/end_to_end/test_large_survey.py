"""A survey of 300 photos, the last ten of which come later: what a photo costs beside a quarter of
it, memory, and what photos cost that are added.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from skyquilt.alignment.control import fit_similarity_3d

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow
PHOTOS, LATER = 300, 10


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Photos of 0.17 MP by three drones over ground without houses that stand (see the program)."""
    folder = tmp_path_factory.mktemp("flight")
    words = ["benchmarks/large_flight.py", str(folder), "--kind", "tiny", "--photos", str(PHOTOS)]
    subprocess.run([sys.executable, *words], cwd=ROOT, check=True, capture_output=True)
    return folder / "photos"


def mapped(photos, out, *words):
    """Metrics of a map made in one thread by a process of its own."""
    command = [sys.executable, "-m", "skyquilt", "mosaic", str(photos), "-o", str(out), *words]
    subprocess.run([*command, "--jobs", "1", "--quiet"], check=True)
    return json.loads((out / "metrics.json").read_text())


def some(photos, folder, number):
    """A folder with the first photos."""
    folder.mkdir(exist_ok=True)
    for photo in sorted(photos.iterdir())[:number]:
        if not (folder / photo.name).exists():
            (folder / photo.name).symlink_to(photo)
    return folder


def centres(out):
    """Camera centre by name of photo."""
    shots = json.loads((out / "shots.geojson").read_text())["features"]
    return {s["properties"]["filename"]: s["properties"]["translation"] for s in shots}


def off_truth(flight, out):
    """RMS in m of camera centres after a similarity to the truth."""
    truth = json.loads((flight.parent / "truth" / "truth.json").read_text())
    true = {Path(p["file"]).name: p["position"] for p in truth["photos"]}
    found = centres(out)
    x, y = (np.array([c[n] for n in sorted(found)], float) for c in (found, true))
    s, R, t = fit_similarity_3d(x - x.mean(0), y - y.mean(0))
    return float(np.sqrt(((s * (x - x.mean(0)) @ R.T + t - (y - y.mean(0))) ** 2).mean()))


def test_a_photo_of_a_large_survey_costs_what_one_of_a_small_survey_does(flight, tmp_path):
    small = mapped(some(flight, tmp_path / "few", PHOTOS // 4), tmp_path / "small")
    survey, out = tmp_path / "survey", tmp_path / "large"
    large = mapped(some(flight, survey, PHOTOS - LATER), out)
    assert large["photos_used"] == PHOTOS - LATER
    assert large["blocks"] == [PHOTOS - LATER]
    assert large["reprojection_error_px"]["rms"] < 0.2
    each = large["cpu_seconds"] / (PHOTOS - LATER)
    assert each < 1.3 * small["cpu_seconds"] / (PHOTOS // 4)
    assert large["peak_memory_mb"] < 850
    before, error = centres(out), off_truth(flight, out)

    whole = mapped(some(flight, survey, PHOTOS), out, "--add")
    assert whole["photos_used"] == PHOTOS and whole["blocks"] == [PHOTOS]
    assert whole["added"]["photos"] == LATER and whole["added"]["moved"] < PHOTOS / 5
    assert whole["added"]["share_made_anew"] < 0.5
    assert whole["cpu_seconds"] < 0.45 * large["cpu_seconds"]
    assert whole["reprojection_error_px"]["rms"] < large["reprojection_error_px"]["rms"] + 0.02
    assert off_truth(flight, out) < 1.1 * error
    now = centres(out)
    stayed = sum(now[name] == place for name, place in before.items())
    assert stayed == len(before) - whole["added"]["moved"]
