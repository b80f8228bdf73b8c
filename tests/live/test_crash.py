"""Killed at any moment, the survey goes on where it was: nothing accepted is lost, nothing is
half-written.
"""

import json
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from skyquilt.live.ledger import POINTS
from tests.end_to_end.conftest import relabel

KILLS = int(os.environ.get("SKYQUILT_KILLS", "5"))
"""Kills at random moments; more can be asked for."""
OFTEN = 6
"""Kills that one survey meets; with more, the last ones would find nothing left to do."""


def replay(out, photos, point="", count=1):
    command = [
        sys.executable,
        "-m",
        "tests.live.crashing",
        str(out),
        str(photos),
        point,
        str(count),
    ]
    root = Path(__file__).resolve().parents[2]
    env = {
        **os.environ,
        "PYTHONPATH": f"{root / 'src'}{os.pathsep}{root}",
        "OPENBLAS_NUM_THREADS": "1",
    }
    return subprocess.run(
        command, cwd=root, env=env, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture(scope="module")
def photos(flight, tmp_path_factory):
    """Five photos, of which the second does not know where it was taken: it waits, is found and
    tried again.
    """
    folder = tmp_path_factory.mktemp("inbox")
    for path in flight.photos[:5]:
        shutil.copyfile(path, folder / path.name)
    relabel(folder / flight.photos[1].name, drop=("position",))
    return folder


@pytest.fixture(scope="module")
def undisturbed(photos, tmp_path_factory):
    done = replay(tmp_path_factory.mktemp("undisturbed"), photos)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found["poses"]) == 5
    assert found["states"] == {"refined": 5, "refused": 0}
    return found


def same(done, undisturbed):
    """Bit for bit: JSON gives floats back as they were."""
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["states"] == undisturbed["states"]
    assert found["poses"] == undisturbed["poses"]


@pytest.mark.slow
def test_killed_at_every_write_point(photos, undisturbed, tmp_path):
    surveys = 0
    for k, point in enumerate([*POINTS, "torn"]):
        done = replay(tmp_path / f"{surveys}", photos, point, 1 + k % 2)
        if done.returncode == 0:  # the work that passes this point was done already
            same(done, undisturbed)
            surveys += 1
            done = replay(tmp_path / f"{surveys}", photos, point, 1)
        assert done.returncode == -9, (point, done.stderr)
    for number in range(surveys + 1):
        same(replay(tmp_path / f"{number}", photos), undisturbed)
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.slow
def test_killed_at_random_moments(photos, undisturbed, tmp_path):
    rng = np.random.default_rng(int(os.environ.get("SKYQUILT_SEED", "1")))
    killed = surveys = 0
    while killed < KILLS:
        out = tmp_path / f"{surveys}"
        for _ in range(min(OFTEN, KILLS - killed)):
            moment = int(1000 * undisturbed["seconds"] * rng.uniform(0.05, 0.5))
            done = replay(out, photos, "time", moment)
            assert done.returncode in (-9, 0), done.stderr
            killed += done.returncode == -9
            if done.returncode == 0:
                break
        same(replay(out, photos), undisturbed)
        surveys += 1


def test_a_full_disk_refuses_and_loses_nothing(flight, tmp_path, monkeypatch):
    """Writes fail with ENOSPC for a while, as they do on a full disk; then there is room again."""
    import errno

    from skyquilt.errors import OutputError
    from skyquilt.live.live_map import LiveMap
    from skyquilt.live.settings import LiveSettings

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


@pytest.mark.slow
def test_a_database_that_cannot_grow_refuses_and_loses_nothing(flight, tmp_path):
    """SQLite itself is told that the disk is full: its page limit is what a small disk is."""
    from skyquilt.errors import OutputError
    from skyquilt.live.live_map import LiveMap
    from skyquilt.live.settings import LiveSettings

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


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 3 MB of its own, which can be made larger."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = shutil.which("mount")
    size = ["-t", "tmpfs", "-o", "size=3m", "tmpfs", str(folder)]
    if mount is None or subprocess.run([mount, *size], capture_output=True, check=False).returncode:
        pytest.skip(
            "no disk can be mounted here; a full one is played by failing writes in the tests above"
        )
    yield folder
    subprocess.run([shutil.which("umount"), "--lazy", str(folder)], check=True)


@pytest.mark.slow
def test_a_real_full_disk_refuses_and_loses_nothing(flight, small_disk):
    from skyquilt.errors import OutputError
    from skyquilt.live.live_map import LiveMap
    from skyquilt.live.settings import LiveSettings

    settings = LiveSettings(features=300, deterministic=True)
    live = LiveMap(small_disk / "out", settings)
    safe, refused = set(), 0
    for path in flight.photos:
        try:
            safe.add(live.intake.take_file(path, "drone").id)
            for _ in live.drain():
                pass
        except OutputError as error:
            assert "full" in str(error)
            refused += 1
    assert refused >= 1
    assert len(safe) >= 2
    held = {row[0] for row in live.ledger.rows("select id from photo")}
    assert held == safe  # what was promised is there, and nothing else
    bigger = ["-o", "remount,size=60m", str(small_disk)]
    subprocess.run([shutil.which("mount"), *bigger], check=True)
    for path in flight.photos:
        live.intake.take_file(path, "drone")
    for _ in live.drain():
        pass
    poses = {m.photo.name: m.pose.map_C.tolist() for m in live.members.on_map()}
    assert set(poses) == {p.name for p in flight.photos}
    for level in range(9):
        for address in live.tiles.addresses("visible", level):
            assert live.tiles.get(address) is not None
    order = [row[0] for row in live.ledger.rows("select name from photo order by id")]
    live.close()
    # the disk has cost nothing but time: the same photos in the same order lie where they lie
    # without it
    other = LiveMap(small_disk / "undisturbed", settings)
    for name in order:
        other.add(flight.folder / "photos" / name, "drone")
    assert {m.photo.name: m.pose.map_C.tolist() for m in other.members.on_map()} == poses
    other.close()


@pytest.mark.long
@pytest.mark.slow
def test_a_disk_that_is_full_from_each_write_point_on(drones, small_disk):
    """No byte is left from the moment on at which a photo passes the point; with room again it goes
    on, and poses are those of a map that was never disturbed.
    """
    from skyquilt.errors import OutputError
    from skyquilt.live import ledger as points
    from skyquilt.live.live_map import LiveMap
    from skyquilt.live.settings import LiveSettings

    bigger = ["-o", "remount,size=60m", str(small_disk)]
    subprocess.run([shutil.which("mount"), *bigger], check=True)
    settings = LiveSettings(features=300, deterministic=True)
    live, filler, met = LiveMap(small_disk / "out", settings), small_disk / "filler", {}
    photos = drones.photos[: len(points.POINTS)]
    for name, photo in zip(points.POINTS, photos, strict=True):

        def full(here, name=name):
            if here == name and name not in met:
                met[name] = ""
                with filler.open("wb", buffering=0) as file, suppress(OSError):
                    while file.write(bytes(1 << 20)):
                        pass

        points.watcher = full
        for _ in range(2):
            try:
                live.add(photo, "drone")
                break
            except OutputError as error:
                assert "full" in str(error) or "disk" in str(error)
                met[name] = str(error)
                filler.unlink()
        points.watcher = points._nothing
        filler.unlink(missing_ok=True)
    for _ in live.drain():
        pass
    assert len(met) >= 7  # those that a folder and a viewer pass are not met here
    assert sum(bool(said) for said in met.values()) >= 5, met
    poses = {m.photo.name: m.pose.map_C.tolist() for m in live.members.on_map()}
    assert set(poses) == {p.name for p in photos}
    live.close()
    other = LiveMap(small_disk / "undisturbed", settings)
    for photo in photos:
        other.add(photo, "drone")
    assert {m.photo.name: m.pose.map_C.tolist() for m in other.members.on_map()} == poses
    other.close()
