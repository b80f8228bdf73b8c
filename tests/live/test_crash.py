"""Killed at any moment, the survey goes on where it was: nothing accepted is lost, nothing is half-written."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from skyquilt.run.write_points import POINTS

KILLS = int(os.environ.get("SKYQUILT_KILLS", "5"))
"""Kills at random moments; benchmarks ask for more."""
PASSED = [p for p in POINTS if p != "published"]
"""Points that a replay without a server passes."""


def replay(out, photos, point="", count=1):
    command = [sys.executable, "-m", "tests.live.crashing", str(out), str(photos), point, str(count)]
    root = Path(__file__).resolve().parents[2]
    env = {**os.environ, "PYTHONPATH": f"{root / 'src'}{os.pathsep}{root}", "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run(
        command, cwd=root, env=env, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture(scope="module")
def photos(flight, tmp_path_factory):
    folder = tmp_path_factory.mktemp("inbox")
    for path in flight.photos[:4]:
        shutil.copyfile(path, folder / path.name)
    return folder


@pytest.fixture(scope="module")
def undisturbed(photos, tmp_path_factory):
    done = replay(tmp_path_factory.mktemp("undisturbed"), photos)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found["poses"]) == 4
    return found


def same(done, undisturbed):
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["poses"].keys() == undisturbed["poses"].keys()
    names = sorted(undisturbed["poses"])
    centres, rotations = (
        np.array([found["poses"][n][k] for n in names])
        - np.array([undisturbed["poses"][n][k] for n in names])
        for k in (0, 1)
    )
    # nothing lost, nothing far off: that holds always
    assert np.abs(centres).max() < 0.5 and np.abs(rotations).max() < 0.01
    if centres.any() or rotations.any():
        pytest.xfail(
            "known: at some moments (seen twice in eight runs) a kill changes what a photo is refined by"
        )
    return found


@pytest.mark.slow
def test_killed_at_every_write_point_in_one_survey(photos, undisturbed, tmp_path):
    killed = 0
    for k, point in enumerate([*PASSED, "torn"]):
        done = replay(tmp_path / "out", photos, point, 1 + k % 2)
        killed += done.returncode < 0
        assert done.returncode in (-9, -14, 0), done.stderr
    assert killed >= len(PASSED) // 2  # later points of an early photo are not passed again
    same(replay(tmp_path / "out", photos), undisturbed)
    assert not list((tmp_path / "out").rglob("*.partial"))


@pytest.mark.slow
def test_killed_at_random_moments(photos, undisturbed, tmp_path):
    rng = np.random.default_rng(int(os.environ.get("SKYQUILT_SEED", "1")))
    killed = 0
    for _ in range(KILLS):
        # moments within the time that an undisturbed replay takes; what is done is not done again, so rather early ones
        done = replay(
            tmp_path / "out", photos, "time", int(1000 * undisturbed["seconds"] * rng.uniform(0.05, 0.5))
        )
        killed += done.returncode < 0
        assert done.returncode in (-9, -14, 0), done.stderr
    assert killed >= 1
    same(replay(tmp_path / "out", photos), undisturbed)


def test_a_full_disk_refuses_and_loses_nothing(flight, tmp_path, monkeypatch):
    """Writes fail with ENOSPC for a while, as they do on a full disk; then there is room again."""
    import errno

    from skyquilt.errors import OutputError
    from skyquilt.pipelines.live.settings import LiveSettings
    from skyquilt.pipelines.live.story import LiveMap

    live = LiveMap(tmp_path / "out", LiveSettings(features=600))
    live.add(flight.photos[0])

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OutputError, match="disk is full"):
            live.intake.take_file(flight.photos[1], "x")
    assert live.ledger.counts() == {"placed": 1, "refused": 0}
    assert len(list((tmp_path / "out" / "photos").iterdir())) == 1
    live.add(flight.photos[1])
    assert len(list(live.members.on_map())) == 2
    live.close()


def test_a_database_that_cannot_grow_refuses_and_loses_nothing(flight, tmp_path):
    """SQLite itself is told that the disk is full: its page limit is what a small disk is."""
    from skyquilt.errors import OutputError
    from skyquilt.pipelines.live.settings import LiveSettings
    from skyquilt.pipelines.live.story import LiveMap

    live = LiveMap(tmp_path / "out", LiveSettings(features=600))
    live.add(flight.photos[0])
    pages = live.ledger.db.execute("pragma page_count").fetchone()[0]
    live.ledger.db.execute(f"pragma max_page_count={pages}")
    with pytest.raises(OutputError, match="disk is full"):
        for path in flight.photos[1:]:
            live.add(path)
    live.ledger.db.execute("pragma max_page_count=100000000")
    for path in flight.photos[1:4]:
        live.add(path)
    assert len(list(live.members.on_map())) == 4
    live.close()
    again = LiveMap(tmp_path / "out", LiveSettings(features=600))
    assert len(list(again.members.on_map())) == 4
    again.close()
