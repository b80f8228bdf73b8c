"""A live map in a script as a user writes it: without `if __name__ == "__main__":`."""

import os
import subprocess
import sys

import pytest

SCRIPT = """
import sys
from pathlib import Path

from skyquilt.live.settings import LiveSettings
from skyquilt.live.live_map import LiveMap

folder = Path(__file__).parent
with (folder / "runs").open("a") as runs:
    runs.write("once more\\n")
live = LiveMap(folder / "out", LiveSettings(features=600))
for name in sys.argv[1:]:
    print(live.add(Path(name)).what)
live.blocks.last_arrival = -1e9  # as if it had been quiet for long
for update in live.drain_all():
    print(update.what, update.text)
live.close()
"""


@pytest.mark.slow
def test_a_plain_script_runs_once_and_its_blocks_are_adjusted_in_the_background(flight, tmp_path):
    (tmp_path / "plain.py").write_text(SCRIPT)
    command = [sys.executable, str(tmp_path / "plain.py"), *map(str, flight.photos[:4])]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert (tmp_path / "runs").read_text().split("\n") == ["once more", ""]
    assert "adjusted together in the background" in done.stdout
    assert "closed 4 photos were adjusted together" in done.stdout
