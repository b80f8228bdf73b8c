"""The command's words, exit codes and last lines."""

import json
import subprocess
import sys

import pytest


def skyquilt(*words):
    return subprocess.run(
        [sys.executable, "-m", "skyquilt", "strip-test", *map(str, words)],
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
def test_strip_test(tmp_path):
    out = tmp_path / "out"
    done = skyquilt("-o", out, "--photos", 4, "--flights", 1)
    assert (
        done.returncode == 0
        and "order 6 + tangential, similarity" in done.stdout
        and "report.html" in done.stdout
    )
    again = skyquilt("-o", out, "--photos", 4, "--flights", 1)
    assert (
        again.returncode == 5
        and again.stderr.startswith("skyquilt: ")
        and "--overwrite" in again.stderr
    )
    told = skyquilt("-o", out, "--photos", 4, "--flights", 1, "--overwrite", "--json")
    events = [json.loads(line) for line in told.stdout.splitlines()]
    assert (
        told.returncode == 0
        and events[0]["event"] == "StageStarted"
        and events[-1]["event"] == "Result"
    )
    assert skyquilt("-o", out, "--relief", 40).returncode == 2
    assert (
        skyquilt("-o", tmp_path / "n", "--photos", 3, "--flights", 1, "--noise", 300).returncode
        == 7
    )
