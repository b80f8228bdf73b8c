"""The output folder: who may write there, what full disks, Ctrl-C and kill -9 leave, what is made
again.
"""

import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import rasterio

from skyquilt.engine import codec
from skyquilt.engine.folder import CONTRACT
from skyquilt.errors import OutputError, SkyquiltError
from skyquilt.model.event import StageStarted
from skyquilt.settings import MosaicSettings
from skyquilt.workflows import flow
from skyquilt.workflows.mosaic import STAGES, iter_mosaic
from tests.end_to_end.conftest import QUICK, leftovers, named
from tests.interrupts import hears_interrupts, worked

pytestmark = pytest.mark.filterwarnings(
    "error::RuntimeWarning", "error::scipy.linalg.LinAlgWarning"
)
SLOWER = ("--features", "800", "--gsd", "11", "--jobs", "2")
"""Options with which each stage lasts long enough to be interrupted; `features` does with `QUICK`.
"""
RASTERS = ("mosaic.tif", "provenance.tif", "views.tif", "surface.tif")


def late(value):
    return pytest.param(value, marks=pytest.mark.slow)


def last(value):
    return pytest.param(value, marks=[pytest.mark.slow, pytest.mark.long])


def same_result(a: Path, b: Path) -> None:
    """Equal rasters and equal figures, times aside."""
    for name in RASTERS:
        with rasterio.open(a / name) as x, rasterio.open(b / name) as y:
            assert x.transform == y.transform, name
            assert np.array_equal(x.read(), y.read(), equal_nan=True), name
    figures = []
    for folder in (a, b):
        m = json.loads((folder / "metrics.json").read_text())
        figures.append(
            {
                k: v
                for k, v in m.items()
                if k
                not in (
                    "seconds",
                    "cpu_seconds",
                    "peak_memory_mb",
                    "cpu_seconds_of_stage",
                    "peak_memory_mb_of_stage",
                )
            }
        )
    assert figures[0] == figures[1]


@pytest.fixture
def again(finished, tmp_path) -> Path:
    """The undisturbed run, copied to where `mosaic` makes its own: another run would tell no more
    of what happens to a finished one.
    """
    return Path(shutil.copytree(finished, tmp_path / "out"))


# who may write


def test_output_below_a_file(mosaic, flight, tmp_path):
    (tmp_path / "file").write_text("x")
    mosaic(flight / "photos", output=tmp_path / "file" / "out").refused(
        5, "file is a file", "out cannot be below it", "another output folder"
    )
    mosaic(flight / "photos", output=tmp_path / "file").refused(5, "is a file", "folder")
    assert (tmp_path / "file").read_text() == "x"


@pytest.mark.parametrize("to", ["out", "nowhere/at all"])
def test_an_output_that_is_a_link_to_nowhere(mosaic, flight, tmp_path, to):
    (tmp_path / "out").symlink_to(to)
    mosaic(flight / "photos").refused(5, "out is a link that leads nowhere")


@pytest.fixture
def small_disk(tmp_path):
    """A function that mounts a disk of some size; skipped where that is not permitted."""
    mounted = []

    def mount(size: str, *options: str) -> Path:
        place = tmp_path / "disk"
        place.mkdir(exist_ok=True)
        words = [
            "mount",
            "-t",
            "tmpfs",
            "-o",
            ",".join([f"size={size}", *options]),
            "tmpfs",
            str(place),
        ]
        try:
            subprocess.run(words, check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            pytest.skip("mounting is not permitted here")
        mounted.append(place)
        return place

    yield mount
    for place in mounted:
        subprocess.run(["umount", "-l", str(place)], check=False)


def remount(place: Path, options: str) -> None:
    subprocess.run(
        ["mount", "-o", f"remount,{options}", str(place)], check=True, capture_output=True
    )


def test_output_on_a_read_only_disk(mosaic, flight, small_disk):
    disk = small_disk("2m", "ro")
    mosaic(flight / "photos", output=disk / "out").refused(
        5, "cannot write to", "Read-only file system"
    )


@pytest.mark.slow
def test_results_that_may_not_be_replaced(mosaic, flight, small_disk):
    """The former results stay whole when they cannot be replaced."""
    disk = small_disk("30m")
    mosaic(flight / "photos", output=disk / "out").made()
    before = (disk / "out" / "mosaic.tif").read_bytes()
    remount(disk, "ro")
    told = mosaic(flight / "photos", "--blend", "first", "--overwrite", output=disk / "out")
    assert told.code == 5, told.err
    assert "Traceback" not in told.err
    assert (disk / "out" / "mosaic.tif").read_bytes() == before
    remount(disk, "rw")


@pytest.mark.slow
@pytest.mark.parametrize("size", ["700k", *map(late, ("8k", "100k", "1200k", "1600k", "2m"))])
def test_a_full_disk(mosaic, flight, small_disk, finished, size):
    """Wherever it fills up: a sentence, no half file, and with more room the same command goes
    on.
    """
    disk = small_disk(size)
    told = mosaic(flight / "photos", output=disk / "out")
    if told.code == 0:
        pytest.skip("there was room enough")
    assert told.code == 5, told.err
    assert "disk is full" in told.err
    assert "Traceback" not in told.err
    assert leftovers(disk) == []
    assert "metrics.json" not in [p.name for p in (disk / "out").iterdir()]
    for name in RASTERS:
        if (disk / "out" / name).exists():
            with rasterio.open(disk / "out" / name) as raster:
                raster.read()
    remount(disk, "size=60m")
    same_result(mosaic(flight / "photos", output=disk / "out").made().output, finished)


@pytest.mark.parametrize(
    "stage", [*map(late, ("alignment", "features", "links", "surface", "blocks"))]
)
def test_a_disk_that_fills_up_while_intermediate_results_are_stored(
    mosaic, flight, finished, monkeypatch, stage
):
    def full(file, value, name):
        buffer = io.BytesIO()
        codec.write(buffer, value, name)
        data = buffer.getvalue()
        if Path(file.name).parent.name == stage:
            file.write(data[: len(data) // 2])
            raise OSError(errno.ENOSPC, "No space left on device")
        file.write(data)

    monkeypatch.setattr("skyquilt.engine.store.write", full)
    told = mosaic(flight / "photos").refused(5, "disk is full", "make room", "same command again")
    monkeypatch.undo()
    same_result(mosaic(flight / "photos", output=told.output).made().output, finished)


@pytest.mark.slow
def test_a_disk_that_is_full_from_each_stage_on(flight, small_disk, finished):
    """A sentence at each, or the stage needs no room; with room again the same command goes on."""
    disk, said = small_disk("60m"), {}
    settings = MosaicSettings(features=300, surface="ties", gsd_cm=30.0, jobs=2)
    for stage in [*STAGES, ""]:
        filler = disk / "filler"
        try:
            for event in iter_mosaic(flight / "photos", disk / "out", settings):
                if isinstance(event, StageStarted) and event.stage == stage:
                    fill(filler)
            said[stage] = "finished"
        except OutputError as error:
            assert "disk is full" in str(error), stage
            assert error.exit_code == 5
            said[stage] = "full"
        filler.unlink(missing_ok=True)
        if said[stage] == "finished" and stage:
            shutil.rmtree(disk / "out")
    assert list(said.values()).count("full") >= len(STAGES) - 2, said
    assert said[""] == "finished"
    same_result(disk / "out", finished)


def fill(path: Path) -> None:
    """Leaves no byte on the disk of a file."""
    with path.open("wb", buffering=0) as file, suppress(OSError):
        for size in (1 << 20, 4096, 1):
            with suppress(OSError):
                while file.write(bytes(size)) == size:
                    pass


@pytest.mark.slow
def test_photos_on_a_read_only_disk(mosaic, flight, small_disk, tmp_path):
    disk = small_disk("20m")
    shutil.copytree(flight / "photos", disk / "photos")
    remount(disk, "ro")
    mosaic(disk / "photos", output=tmp_path / "out").made()


# who may be replaced


@pytest.mark.slow
def test_a_folder_of_other_files_is_left_alone(mosaic, flight, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.doc").write_text("years of work")
    told = mosaic(flight / "photos")
    assert told.code == 5
    assert "already holds other files; add --overwrite" in told.err
    told = mosaic(flight / "photos", "--rerun-from", "features")
    assert told.code == 5
    told = mosaic(flight / "photos", "--overwrite").made()
    assert (tmp_path / "out" / "thesis.doc").read_text() == "years of work"


def test_another_run_is_replaced_only_when_asked_for(mosaic, flight, again):
    before = {n: (again / n).read_bytes() for n in CONTRACT}
    told = mosaic(flight / "photos", "--blend", "first")
    assert told.code == 5
    assert "already holds another run" in told.err
    assert "--overwrite" in told.err
    assert {n: (again / n).read_bytes() for n in CONTRACT} == before
    told = mosaic(flight / "photos", "--blend", "first", "--overwrite", "--json").made()
    reused = {e["stage"]: e["reused"] for e in told.events if e["event"] == "StageFinished"}
    kept = ("features", "links", "align", "surface", "balance")
    assert reused == {s: s in kept for s in STAGES[1:] if s != "frames"}


def test_the_same_run_again_does_nothing(mosaic, flight, finished, again):
    times = {n: (again / n).stat().st_mtime_ns for n in CONTRACT}
    told = mosaic(flight / "photos", "--json").made()
    assert [e["event"] for e in told.events] == ["Note", "Result"]
    assert "nothing to do" in told.events[0]["text"]
    assert {n: (again / n).stat().st_mtime_ns for n in CONTRACT} == times
    same_result(again, finished)


@pytest.mark.slow
@pytest.mark.usefixtures("again")
def test_other_threads_and_memory_are_the_same_run(mosaic, flight):
    assert "nothing to do" in mosaic(flight / "photos", "--jobs", "1", "--memory", "2").made().err


@pytest.mark.parametrize(
    "lost", [*map(late, ("report.html", "mosaic.tif", "metrics.json", "run.toml"))]
)
def test_a_file_that_was_deleted_is_made_again(mosaic, flight, finished, again, lost):
    (again / lost).unlink()
    told = mosaic(flight / "photos", "--json").made()
    reused = {e["stage"]: e["reused"] for e in told.events if e["event"] == "StageFinished"}
    assert all(reused[s] for s in ("features", "links", "align", "surface"))
    assert reused["mosaic"] == (lost != "mosaic.tif")
    same_result(again, finished)


@pytest.mark.parametrize("stage", ["mosaic", *(late(s) for s in STAGES[1:] if s != "mosaic")])
def test_rerun_from_each_stage(mosaic, flight, finished, again, stage):
    told = mosaic(flight / "photos", "--rerun-from", stage, "--json").made()
    reused = {e["stage"]: e["reused"] for e in told.events if e["event"] == "StageFinished"}
    stored = {"features", "links", "align", "surface", "balance", "seams", "mosaic"}
    first = STAGES.index(stage)
    assert reused == {
        s: s in stored and k + 1 < first for k, s in enumerate(STAGES[1:]) if s != "frames"
    }
    same_result(again, finished)


@pytest.mark.slow
def test_damaged_intermediate_results_are_made_again(mosaic, flight, finished, again):
    for number, path in enumerate(sorted((again / ".skyquilt" / "store").rglob("*.npz"))):
        data = path.read_bytes()
        path.write_bytes(
            (b"", data[:100], data[: len(data) // 2], data[:-1], bytes(len(data)))[number % 5]
        )
    (again / "report.html").unlink()
    mosaic(flight / "photos").made()
    same_result(again, finished)


@pytest.mark.slow
def test_a_damaged_state_is_another_run_not_a_crash(mosaic, flight, again):
    (again / ".skyquilt" / "run.json").write_text('{"key": ')
    told = mosaic(flight / "photos")
    assert told.code == 5
    assert "--overwrite" in told.err


@pytest.mark.slow
def test_damaged_figures_of_a_finished_run_are_made_again(mosaic, flight, again):
    (again / "metrics.json").write_text('{"photos_total": ')
    assert mosaic(flight / "photos").made().metrics["photos_used"] == 9


# output and photos in one place


def test_the_folder_of_photos_itself_is_no_output(mosaic, photos):
    before = sorted(p.name for p in photos.iterdir())
    for options in ((), ("--overwrite",)):
        told = mosaic(photos, *options, output=photos)
        assert told.code == 2
        assert "contains the photos" in told.err
    assert sorted(p.name for p in photos.iterdir()) == before


@pytest.mark.slow
def test_an_output_inside_the_folder_of_photos_is_no_input(mosaic, photos):
    mosaic(photos, output=photos / "map").made()
    told = mosaic(photos, output=photos / "map").made()
    assert "nothing to do" in told.err
    told = mosaic(photos, "--blend", "first", output=photos / "second map").made()
    assert told.metrics["photos_total"] == 9


@pytest.mark.slow
def test_an_unfinished_output_inside_the_folder_of_photos_is_no_input_either(
    mosaic, photos, monkeypatch
):
    from skyquilt.workflows import mosaic as workflow

    def interrupted(*args, **words):
        raise KeyboardInterrupt

    monkeypatch.setattr(workflow, "measure_seams", interrupted)
    told = mosaic(photos, output=photos / "map")
    assert told.code == 130
    assert (photos / "map" / "mosaic.tif").is_file()
    assert not (photos / "map" / "run.toml").is_file()
    monkeypatch.undo()
    told = mosaic(photos, output=photos / "map").made()
    assert (told.metrics["photos_total"], told.metrics["photos_rejected"]) == (9, {})


# interrupts and kills


class Running:
    """The command in a process of its own, its events read as they come."""

    def __init__(self, photos: Path, output: Path, *options: str) -> None:
        words = [
            sys.executable,
            "-m",
            "skyquilt",
            "mosaic",
            str(photos),
            "-o",
            str(output),
            "--json",
            *options,
        ]
        self.process = subprocess.Popen(
            words,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=dict(os.environ),
            preexec_fn=hears_interrupts,
        )

    def until(self, event: str, stage: str, count: int = 1) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            record = json.loads(line)
            count -= record["event"] == event and record.get("stage") == stage
            if count == 0:
                return
        raise AssertionError(
            f"no {event} of {stage}: {self.process.stderr.read() if self.process.stderr else ''}"
        )

    def signalled(self, number: int) -> tuple[int, float, str]:
        """Exit code, seconds until the end, standard error."""
        begun = time.perf_counter()
        self.process.send_signal(number)
        _, err = self.process.communicate(timeout=60)
        return self.process.returncode, time.perf_counter() - begun, err


@pytest.fixture(scope="module")
def undisturbed(flight, tmp_path_factory) -> Path:
    """The slower run without a disturbance."""
    from tests.end_to_end.conftest import skyquilt

    output = tmp_path_factory.mktemp("undisturbed") / "out"
    code, _, err = skyquilt("mosaic", flight / "photos", "-o", output, *SLOWER)
    assert code == 0, err
    return output


MOMENTS = [
    ("StageStarted", "features", 1),
    ("StageProgress", "features", 3),
    ("StageStarted", "links", 1),
    ("StageStarted", "align", 1),
    ("StageStarted", "surface", 1),
    ("StageStarted", "mosaic", 1),
    ("StageStarted", "measure", 1),
    ("StageStarted", "report", 1),
]


def with_options(moment: tuple[str, str, int], request: pytest.FixtureRequest) -> tuple:
    """The options for a run that is disturbed at a moment, and the undisturbed run with them."""
    if moment[1] == "features":
        return QUICK, request.getfixturevalue("finished")
    return SLOWER, request.getfixturevalue("undisturbed")


@pytest.mark.parametrize(
    "moment", [late(MOMENTS[1]), *map(late, MOMENTS[3::2]), *map(last, MOMENTS[::2])]
)
def test_ctrl_c_ends_soon_and_the_same_command_resumes(mosaic, flight, tmp_path, request, moment):
    options, undisturbed = with_options(moment, request)
    running = Running(flight / "photos", tmp_path / "out", *options)
    running.until(*moment)
    code, seconds, err = running.signalled(signal.SIGINT)
    assert code == 130, err
    assert seconds < 3, f"it took {seconds:.1f} s to end"
    assert (
        err.strip().splitlines()[-1]
        == "skyquilt: interrupted; run the same command again to resume"
    )
    assert "Traceback" not in err
    assert not (tmp_path / "out" / "metrics.json").exists()
    same_result(mosaic(flight / "photos", *options, quick=False).made().output, undisturbed)


@pytest.mark.parametrize("delay", [0.3, *map(late, (0.2, 0.5, 0.8))])
def test_ctrl_c_while_the_program_is_still_loading(flight, tmp_path, delay):
    running = Running(flight / "photos", tmp_path / "out", *SLOWER)
    worked(running.process.pid, delay)
    code, seconds, err = running.signalled(signal.SIGINT)
    assert code == 130, err
    assert seconds < 3
    assert "Traceback" not in err


@pytest.mark.slow
def test_ctrl_c_twice(flight, tmp_path):
    running = Running(flight / "photos", tmp_path / "out", *SLOWER)
    running.until("StageStarted", "features")
    running.process.send_signal(signal.SIGINT)
    time.sleep(0.02)
    code, seconds, err = running.signalled(signal.SIGINT)
    assert code == 130, err
    assert seconds < 3


@pytest.mark.slow
@pytest.mark.parametrize(
    "moment",
    [
        ("StageProgress", "features", 4),
        last(("StageStarted", "links", 1)),
        ("StageStarted", "mosaic", 1),
        ("StageFinished", "mosaic", 1),
        last(("StageStarted", "report", 1)),
    ],
)
def test_kill_9_and_the_same_command_resumes(mosaic, flight, tmp_path, request, moment):
    options, undisturbed = with_options(moment, request)
    running = Running(flight / "photos", tmp_path / "out", *options)
    running.until(*moment)
    code, _, _ = running.signalled(signal.SIGKILL)
    assert code == -signal.SIGKILL
    told = mosaic(flight / "photos", *options, "--json", quick=False).made()
    reused = {e["stage"]: e["reused"] for e in told.events if e["event"] == "StageFinished"}
    before = STAGES[1 : STAGES.index(moment[1])]
    assert all(reused[s] for s in before if s in ("features", "links", "align", "surface"))
    same_result(told.output, undisturbed)


@pytest.mark.slow
def test_kill_9_between_blocks_of_a_map_of_several(mosaic, flight, tmp_path):
    """Two of four blocks and more are in the spool: only the others are drawn again."""
    options = ("--features", "300", "--surface", "ties", "--gsd", "4", "--jobs", "1")
    running = Running(flight / "photos", tmp_path / "out", *options)
    running.until("StageProgress", "mosaic", 2)
    running.signalled(signal.SIGKILL)
    told = mosaic(flight / "photos", *options, "--json", quick=False).made()
    steps = [e for e in told.events if e["event"] == "StageProgress" and e["stage"] == "mosaic"]
    assert steps[0]["total"] == 4
    assert len(steps) <= 2
    other = mosaic(flight / "photos", *options, quick=False, output=tmp_path / "other").made()
    same_result(told.output, other.output)


@pytest.mark.slow
def test_photos_that_come_later_are_added_without_looking_at_the_others_again(mosaic, photos):
    late = named(photos)[-1].rename(photos.parent / "late.jpg")
    mosaic(photos).made()
    late.rename(photos / "late.jpg")
    told = mosaic(photos)
    assert told.code == 5
    assert "other photos or other settings" in told.err
    assert mosaic(photos, "--overwrite").made().metrics["photos_used"] == 9


# what is there was spoiled between two runs, or while one ran


def _pipe(path):
    path.unlink()
    os.mkfifo(path)


def _loop(path):
    path.unlink()
    path.symlink_to(path)


def _deep(path):
    path.write_bytes(b"[" * 200_000)


def _other(path):
    """Another photo of the same size takes its place."""
    path.write_bytes(named(path.parent)[0].read_bytes())


def _half(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [_pipe, _deep])
def test_what_is_spoiled_between_runs_is_made_again_or_named(mosaic, flight, finished, spoil):
    """Every file of the run, one kind of artefact at a time; a pipe must not be waited for."""
    files = [p.relative_to(finished) for p in sorted(finished.rglob("*")) if p.is_file()]
    inner = [f for f in files if f.parts[0] == ".skyquilt"]
    assert len({f.parent for f in inner}) > 5
    for folder in sorted({f.parent for f in inner} | {Path("metrics.json")}):
        output = finished.parent / "spoiled"
        shutil.rmtree(output, ignore_errors=True)
        shutil.copytree(finished, output)
        for file in [f for f in inner if f.parent == folder] or [folder]:
            spoil(output / file)
        told = mosaic(flight / "photos", output=output)
        if told.code == 5:  # without run.json nobody knows whose files these are
            assert folder == Path(".skyquilt")
            assert "already holds other files" in told.err
        else:
            same_result(told.made().output, finished)


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["links", "mosaic", "measure", "report"])
def test_an_output_that_disappears_while_a_map_is_made(mosaic, photos, finished, tmp_path, stage):
    """All of it is made, or the run says what is missing and the same command makes it."""
    output, gone = tmp_path / "out", ""
    settings = MosaicSettings(features=300, surface="ties", gsd_cm=30.0, jobs=2)
    try:
        for event in iter_mosaic(photos, output, settings):
            if isinstance(event, StageStarted) and event.stage == stage:
                shutil.rmtree(output)
    except OutputError as error:
        gone = str(error)
    assert ("mosaic.tif" in gone) == (stage in ("measure", "report"))
    same_result(mosaic(photos, output=output).made().output, finished)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "spoil"),
    [
        ("features", _loop),
        ("links", Path.unlink),
        ("mosaic", _half),
        ("mosaic", _other),
        ("report", _pipe),
    ],
)
def test_a_photo_spoiled_while_a_map_is_made_is_left_out(
    photos, tmp_path, monkeypatch, stage, spoil
):
    """It is missed where its pixels are needed again, whatever the stage."""
    monkeypatch.setattr(flow, "pixel_budget", lambda memory: 0)
    bad = named(photos)[4]
    settings = MosaicSettings(features=300, surface="ties", gsd_cm=30.0, jobs=2)
    for event in iter_mosaic(photos, tmp_path / "out", settings):
        if isinstance(event, StageStarted) and event.stage == stage and bad.is_file():
            spoil(bad)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["photos_used"] == 8
    assert list(metrics["photos_rejected"]) == [bad.name]


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["features", "links", "mosaic"])
def test_a_disk_that_is_pulled_out_while_a_map_is_made(
    mosaic, photos, finished, tmp_path, monkeypatch, stage
):
    """The map is not made of what had been read by then: with the disk back the run goes on."""
    monkeypatch.setattr(flow, "pixel_budget", lambda memory: 0)
    away, settings = photos.with_name("away"), MosaicSettings(features=300, surface="ties")
    with pytest.raises(SkyquiltError, match=r"\d of 9 photos cannot be used any more"):
        for event in iter_mosaic(photos, tmp_path / "out", settings.changed(gsd_cm=30.0, jobs=1)):
            if isinstance(event, StageStarted) and event.stage == stage:
                photos.rename(away)
    away.rename(photos)
    same_result(mosaic(photos, output=tmp_path / "out").made().output, finished)


@pytest.mark.slow
def test_a_photo_that_comes_back_is_not_missed_for_ever(mosaic, photos, finished, tmp_path):
    """A map without photos that were lost while it was made is not the finished map of all."""
    away, settings = tmp_path / "away.jpg", MosaicSettings(features=300, surface="ties")
    for event in iter_mosaic(photos, tmp_path / "out", settings.changed(gsd_cm=30.0, jobs=1)):
        if isinstance(event, StageStarted) and event.stage == "features" and not away.exists():
            named(photos)[4].rename(away)
    told = mosaic(photos, output=tmp_path / "out").made()
    assert told.metrics["photos_used"] == 8 and "nothing to do" in told.out + told.err
    away.rename(photos / "SIM_0005.jpg")
    assert mosaic(photos, output=tmp_path / "out").code == 5
    again = mosaic(photos, "--overwrite", output=tmp_path / "out").made()
    same_result(again.output, finished)
