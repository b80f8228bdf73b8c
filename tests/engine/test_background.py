"""Work in a process of its own: handed over, brought back, and ended with the program."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from skyquilt.engine.background import Background


def test_the_outcome_comes_back():
    values = np.arange(3e5)  # more than a pipe holds
    work = Background(np.cumsum, values)
    np.testing.assert_array_equal(work.outcome(), np.cumsum(values))
    assert not work.busy
    assert work.pid != os.getpid()
    work.stop()


def test_what_is_printed_does_not_get_into_the_outcome(capfd):
    work = Background(print, "said")
    assert work.outcome() is None
    work.stop()
    assert capfd.readouterr() == ("", "said\n")


@pytest.mark.parametrize("how", ["stopped", "killed", "failed"])
def test_a_process_that_ends_early_has_no_outcome(how, capfd):
    work = Background(*((int, "no number") if how == "failed" else (time.sleep, 60)))
    if how != "failed":
        assert work.busy
    if how == "killed":
        os.kill(work.pid, signal.SIGKILL)
    if how == "stopped":
        work.stop()
    assert work.outcome() is None
    assert not work.busy
    work.stop()
    work.stop()


def gone(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
def test_it_ends_with_the_program_that_started_it():
    """However that ends."""
    script = """
import os, sys, time
from skyquilt.engine.background import Background
work = Background(time.sleep, 60)
time.sleep(1.0)
print(work.pid, work.busy, flush=True)
"""
    ends = ("os.kill(os.getpid(), 9)", "sys.exit()", "raise ValueError")
    started = [
        subprocess.Popen([sys.executable, "-c", script + end], stdout=subprocess.PIPE)
        for end in ends
    ]
    for end, program in zip(ends, started, strict=True):
        pid, busy = program.communicate()[0].split()
        assert busy == b"True", end
        until = time.monotonic() + 5
        while not gone(int(pid)):
            if time.monotonic() > until:
                os.kill(int(pid), signal.SIGKILL)
                raise AssertionError(f"it goes on after {end}")
            time.sleep(0.05)
