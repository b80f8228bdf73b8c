"""What a log file shows of a run."""

import time

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
