"""Photos added to a finished map: `--add`."""

import json
import shutil

import numpy as np
import pytest
import rasterio

from skyquilt.workflows import mosaic as workflow
from tests.end_to_end.conftest import keep, named

pytestmark = pytest.mark.slow


@pytest.fixture
def eight(mosaic, photos, flight):
    """The folder without its last photo, and its map."""
    last = named(photos)[-1]
    last.unlink()
    assert mosaic(photos).made().metrics["photos_used"] == 8
    return photos, flight / "photos" / last.name


def test_a_photo_that_came_later_joins_the_map(mosaic, eight):
    photos, last = eight
    shutil.copy(last, photos)
    told = mosaic(photos, "--add").made()
    assert told.metrics["photos_used"] == 9
    assert told.metrics["added"]["photos"] == 1 and told.metrics["added"]["to"] == 8
    for text in (told.err, (told.output / "report.html").read_text()):
        assert "1 photo was added to a map of 8" in text
    shots = json.loads((told.output / "shots.geojson").read_text())["features"]
    assert [s["properties"]["filename"] for s in shots] == [p.name for p in named(photos)]
    with rasterio.open(told.output / "provenance.tif") as file:
        assert set(np.unique(file.read(1)).tolist()) <= set(range(10))
    # the same command has nothing to do, nor has one without --add
    for words in (("--add",), ()):
        again = mosaic(photos, *words).made()
        assert "already contains this mosaic" in again.err
    # unless files joined that cannot be used: these are named with the reason
    (photos / "zz.jpg").write_bytes(last.read_bytes()[:3000])
    again = mosaic(photos, "--add").made()
    assert "already contains this mosaic" in again.err
    assert "warning: zz.jpg is left out: " in again.err


def test_a_first_map_is_made_where_there_is_none(mosaic, flight):
    told = mosaic(flight / "photos", "--add").made()
    assert told.metrics["photos_used"] == 9 and "added" not in told.metrics


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--overwrite",), "--overwrite"),
        (("--rerun-from", "align"), "--rerun-from"),
        (("--thermal", "."), "--thermal"),
    ],
)
def test_options_that_contradict_it(mosaic, flight, words, said):
    mosaic(flight / "photos", "--add", *words).refused(2, "--add", said)


def test_other_settings_are_refused_and_the_map_stays(mosaic, eight):
    photos, last = eight
    shutil.copy(last, photos)
    output = mosaic(photos, "--add", "--quality", "60").output
    told = mosaic(photos, "--add", "--quality", "60")
    assert told.code == 5 and "other settings" in told.err and "--overwrite" in told.err
    assert json.loads((output / "metrics.json").read_text())["photos_used"] == 8
    assert mosaic(photos, "--add").made().metrics["photos_used"] == 9


def test_control_points_seen_in_new_photos_hold_the_map_too(mosaic, photos, flight):
    """One list of control points for the whole survey: of the first photos it names but some."""
    listed = flight / "gcp_list.txt"
    later = named(photos)[6:]
    for path in later:
        path.unlink()
    mosaic(photos, "--gcp", listed).made()
    for path in later:
        shutil.copy(flight / "photos" / path.name, photos)
    told = mosaic(photos, "--gcp", listed, "--add").made()
    assert "all of it is made anew" in told.err
    whole = mosaic(photos, "--gcp", listed, output=told.output.with_name("whole")).made()
    for name in ("photos_used", "control", "reprojection_error_px"):
        assert told.metrics[name] == whole.metrics[name]
    assert len(told.metrics["control"]) >= 3


def test_the_zero_of_heights_is_that_of_all_photos(mosaic, photos, flight):
    """Three photos tell the take-off point's height to some metres only."""
    later, datum = named(photos)[3:], ("--vertical-datum", "egm96")
    for path in later:
        path.unlink()
    mosaic(photos, *datum).made()
    for path in later:
        shutil.copy(flight / "photos" / path.name, photos)
    told = mosaic(photos, *datum, "--add").made()
    whole = mosaic(photos, *datum, output=told.output.with_name("whole")).made()
    heights = []
    for output in (told.output, whole.output):
        with rasterio.open(output / "dsm.tif") as file:
            heights.append(float(np.nanmedian(file.read(1))))
    assert heights[0] == pytest.approx(heights[1], abs=0.5)


def test_photos_that_are_gone_are_named(mosaic, eight):
    photos, last = eight
    shutil.copy(last, photos)
    gone = keep(photos, *range(2, 9)) and "SIM"
    told = mosaic(photos, "--add")
    assert told.code == 5 and gone in told.err and "--add only adds" in told.err
    assert told.metrics["photos_used"] == 8


@pytest.mark.parametrize("stage", ["align_photos", "find_ground", "draw_map", "finish_run"])
def test_one_that_was_interrupted_goes_on(mosaic, eight, monkeypatch, stage):
    photos, last = eight
    shutil.copy(last, photos)
    whole = getattr(workflow, stage)

    def ended(*given, **more):
        yield from whole(*given, **more)
        raise KeyboardInterrupt

    monkeypatch.setattr(workflow, stage, ended)
    assert mosaic(photos, "--add").code != 0
    monkeypatch.undo()
    assert mosaic(photos, "--add").made().metrics["added"]["photos"] == 1


def test_a_map_whose_store_is_gone_is_made_anew(mosaic, eight):
    photos, last = eight
    shutil.copy(last, photos)
    output = mosaic(photos, "--add", "--quality", "60").output
    shutil.rmtree(output / ".skyquilt" / "store")
    told = mosaic(photos, "--add").made()
    assert told.metrics["photos_used"] == 9 and "added" not in told.metrics
