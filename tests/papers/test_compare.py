"""A comparison that was stopped goes on with the same command."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from skyquilt.errors import OutputError, UsageError
from skyquilt.model.event import Result, StageFinished, StageStarted
from skyquilt.papers.compare import CompareSettings, iter_compare
from skyquilt.papers.compare_state import taken_up
from skyquilt.workflows.methods import MosaicSettings

SETTINGS = CompareSettings(
    mosaic=MosaicSettings(features=300, surface="ties", gsd_cm=30, jobs=2),
    variants=("pose", "bundle"),
    first=5,
)
"""No known distances: baselines between cameras are what methods are judged by."""


def compared(photos, out, until=None, settings=SETTINGS):
    """What a call tells of stages; it is stopped at the time that `until` (a stage) begins."""
    told, times = [], 0
    events = iter_compare(photos, out, settings)
    for event in events:
        if isinstance(event, StageStarted) and until is not None and event.stage == until[0]:
            times += 1
            if times == until[1]:
                events.close()
                return told
        if isinstance(event, StageFinished):
            told.append(event.stage)
    assert isinstance(event, Result)
    return told


def record(out):
    """compare.json without times."""
    found = json.loads((out / "compare.json").read_text())
    for column in found["methods"].values():
        for key in ("seconds", "align_seconds", "cpu_seconds"):
            column.pop(key)
    return found


@pytest.fixture(scope="module")
def undisturbed(flight, tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    compared(flight / "photos", out)
    found = record(out)
    assert "baselines between cameras" in found["judged_by"]
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "time", "not_again"),
    [("bundle: align", 1, ()), ("bundle: mosaic", 1, ("pose: mosaic", "pose: report"))],
)
def test_what_was_finished_is_not_made_again(flight, tmp_path, undisturbed, stage, time, not_again):
    out = tmp_path / "out"
    before = compared(flight / "photos", out, (stage, time))
    assert "pose: features" in before
    again = compared(flight / "photos", out)
    assert not set(not_again) & set(again)
    assert "bundle: report" in again
    assert record(out) == undisturbed


@pytest.mark.slow
def test_another_comparison_is_refused(flight, tmp_path):
    out = tmp_path / "out"
    compared(flight / "photos", out, ("pose: features", 1))
    other = replace(SETTINGS, mosaic=replace(SETTINGS.mosaic, gsd_cm=40))
    with pytest.raises(OutputError, match=r"comparison of other photos or settings.*--overwrite"):
        compared(flight / "photos", out, settings=other)
    compared(flight / "photos", out)
    with pytest.raises(OutputError, match=r"already holds a comparison; add --overwrite"):
        compared(flight / "photos", out)


def test_settings_that_were_refused_can_be_corrected(flight, tmp_path):
    """A comparison that has not begun to work leaves the folder free for other settings."""
    wrong = replace(SETTINGS, mosaic=replace(SETTINGS.mosaic, gsd_cm=30, crs="EPSG:4326"))
    with pytest.raises(Exception, match="not projected"):
        compared(flight / "photos", tmp_path / "out", settings=wrong)
    compared(flight / "photos", tmp_path / "out", ("pose: links", 1))


@pytest.mark.slow
def test_killed_between_methods_the_same_command_goes_on(flight, tmp_path, undisturbed):
    out = tmp_path / "out"
    words = [
        "compare",
        flight / "photos",
        "-o",
        out,
        "--methods",
        "pose,bundle",
        "--gsd",
        "30",
        "--first",
        "5",
    ]
    command = [sys.executable, "-m", "skyquilt", *map(str, words), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            if "bundle: links" in line:
                os.kill(process.pid, signal.SIGKILL)
                break
    assert process.returncode == -signal.SIGKILL
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert "pose: mosaic" not in again.stdout
    assert "bundle: mosaic" in again.stdout
    assert Path(out / "report.html").is_file()


@pytest.mark.slow
def test_a_comparison_that_is_replaced_leaves_no_columns(flight, tmp_path):
    """They would stand beside those of other photos; what somebody else put there stays."""
    out = tmp_path / "out"
    two = replace(SETTINGS, variants=("position", "pose"), first=4)
    compared(flight / "photos", out, settings=two)
    (out / "position" / "mine.txt").write_text("mine")
    (out / "bundle").mkdir()  # no run
    (out / "bundle" / "notes.txt").write_text("mine")
    one = replace(two, variants=("image",), first=3)
    assert isinstance(list(iter_compare(flight / "photos", out, one, overwrite=True))[-1], Result)
    assert {p.name for p in out.iterdir() if p.is_dir()} == {
        ".skyquilt",
        "image",
        "position",
        "bundle",
    }
    assert [p.name for p in (out / "position").iterdir()] == ["mine.txt"]
    assert [p.name for p in (out / "bundle").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("name", ["a file", "a file/below", "a link", "a link/below"])
def test_a_folder_that_cannot_be_made_is_refused_in_plain_words(tmp_path, name):
    (tmp_path / "a file").write_text("mine")
    (tmp_path / "a link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OutputError, match="a (file is a file|link is a link that leads nowhere);"):
        taken_up(tmp_path / name, "key", overwrite=False)


def test_one_photo_compares_nothing(flight, tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    first, second, *_ = sorted((flight / "photos").glob("*.jpg"))
    shutil.copy(first, photos)
    (photos / "cut.jpg").write_bytes(second.read_bytes()[:3000])
    with pytest.raises(UsageError, match="two photos or more.*cut.jpg"):
        compared(photos, tmp_path / "out")
    assert not (tmp_path / "out").exists()
