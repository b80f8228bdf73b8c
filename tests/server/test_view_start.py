"""`skyquilt view` answers soon: it loads what its first request needs, and no more."""

import os
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

UNNEEDED = ("scipy", "shapely", "jinja2", "tifffile", "skyquilt.planning", "skyquilt.live.live_map",
            "skyquilt.alignment", "skyquilt.workflows")  # fmt: skip
MOST_MODULES = 900
LIBRARIES = "import cv2, fastapi, numpy, pyproj, rasterio, uvicorn"
MOST_CPU = 1.7
"""Limit of the CPU time, over that of loading the libraries alone: machines differ."""


TRIES = 3
"""Another process on the machine makes both take longer, but not alike: the least of so many."""


def cpu_s_of_libraries():
    before = os.times()
    subprocess.run(
        [sys.executable, "-X", "importtime", "-c", LIBRARIES], check=True, stderr=subprocess.DEVNULL
    )
    after = os.times()
    used = after.children_user + after.children_system
    return used - before.children_user - before.children_system


def cpu_s_to_first_answer(output, said):
    """Of the viewer of a run; what it loaded is in the file `said`."""
    command = [sys.executable, "-X", "importtime", "-m", "skyquilt", "view", str(output),
               "--port", "0"]  # fmt: skip
    with said.open("w") as log:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
        try:
            address = process.stdout.readline().split()[0]
            with urllib.request.urlopen(address, timeout=60) as answer:
                assert answer.status == 200 and b"<html" in answer.read()
            words = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        finally:
            process.terminate()
            process.wait()
    return sum(map(int, words[11:13])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="CPU times are read from /proc")
def test_the_first_answer_waits_for_nothing_it_does_not_need(finished, tmp_path):
    said = tmp_path / "imports.txt"
    used = libraries = float("inf")
    for _ in range(TRIES):
        used = min(used, cpu_s_to_first_answer(finished.output, said))
        libraries = min(libraries, cpu_s_of_libraries())
        if used < MOST_CPU * libraries:
            break
    loaded = [row.rsplit("|", 1)[1].strip() for row in said.read_text().splitlines() if "|" in row]
    assert "fastapi" in loaded  # the list is what it is taken for
    assert not [m for m in loaded if m.startswith(UNNEEDED)]
    assert len(loaded) < MOST_MODULES
    assert used < MOST_CPU * libraries
