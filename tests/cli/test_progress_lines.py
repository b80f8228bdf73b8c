"""What a log file shows of a run."""

import io
import sys
import time

from skyquilt.cli.progress import show_live
from skyquilt.cli.progress_lines import ProgressLines
from skyquilt.model.event import Note, Result, StageFinished, StageProgress, StageStarted


def test_a_line_per_stage_and_one_now_and_then_while_it_lasts(tmp_path):
    def events():
        yield StageStarted(stage="links", total=40)
        yield StageProgress(stage="links", done=12, total=40)
        time.sleep(0.35)
        yield StageFinished(stage="links", seconds=61.0, cpu_seconds=2.5, reused=False)
        yield Note(text="a photo is missing", warning=True)
        yield StageStarted(stage="align", total=0)
        yield StageFinished(stage="align", seconds=0.1, cpu_seconds=0.1, reused=True)
        yield Result(output=tmp_path, metrics={})

    lines = []
    with ProgressLines(write=lines.append, every_s=0.1) as shown:
        assert shown.follow(events()).output == tmp_path
    told = [x for x in lines if "so far" in x]
    assert 2 <= len(told) <= 3 and all(x.startswith("links: ") for x in told)
    assert told[0].endswith("12 of 40")
    assert [x for x in lines if "so far" not in x] == [
        "links: 61.00 s",
        "warning: a photo is missing",
        "align: 0.10 s (from an earlier run)",
    ]


def test_a_step_that_lasts_says_what_is_done(tmp_path):
    def events():
        yield StageStarted(stage="align", total=0)
        yield StageProgress(stage="align", done=4, total=10, what="adjustment, 3")
        time.sleep(0.25)
        yield StageFinished(stage="align", seconds=0.2, cpu_seconds=0.1, reused=False)
        yield Result(output=tmp_path, metrics={})

    lines = []
    with ProgressLines(write=lines.append, every_s=0.1) as shown:
        shown.follow(events())
    assert lines[0].endswith("so far, 4 of 10 (adjustment, 3)")


def test_the_address_of_a_live_map_is_in_the_log_before_the_first_photo(monkeypatch):
    """A log is written in blocks: with --port 0 nobody would know where to look."""
    log = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(log))
    seen = []

    def events():
        seen.append(log.getvalue())
        yield from ()

    show_live(events(), "http://127.0.0.1:5/", mode="normal")
    assert seen[0].startswith(b"http://127.0.0.1:5/ shows the map")
