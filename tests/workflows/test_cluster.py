"""A map made by several processes, one of which dies in each stage, is that of one process."""

import time
from contextlib import suppress

import psutil
import pytest

from skyquilt.model.event import StageProgress
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.mosaic import iter_mosaic

FILES = ("mosaic.tif", "provenance.tif", "surface.tif", "shots.geojson", "reconstruction.json")


def workers():
    """The worker processes of this one that are alive."""
    found = []
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # one that was killed may end meanwhile
            if "spawn_main" in " ".join(child.cmdline()):
                found.append(child)
    return found


@pytest.mark.slow
def test_the_same_map_though_a_worker_dies_in_each_stage(flight, finished, tmp_path, monkeypatch):
    monkeypatch.chdir(flight)  # paths as users write them
    gcp = next(flight.rglob("gcp_list.txt"))
    settings = MosaicSettings(gcp=gcp, scheduler="local:2")
    killed = set()
    for event in iter_mosaic("photos", tmp_path / "out", settings):
        if isinstance(event, StageProgress) and event.stage not in killed:
            # the one killed before may be the last, and come back
            deadline = time.monotonic() + 300
            while not (victims := workers()) and time.monotonic() < deadline:
                time.sleep(0.1)
            assert victims, "no process works for this run"
            victims[0].kill()
            killed.add(event.stage)
    assert {"features", "links", "align", "surface", "seams", "mosaic"} <= killed
    for name in FILES:
        assert (tmp_path / "out" / name).read_bytes() == (finished.output / name).read_bytes(), name
    assert not (tmp_path / "out" / ".skyquilt" / "tasks").exists()
    assert workers() == []
