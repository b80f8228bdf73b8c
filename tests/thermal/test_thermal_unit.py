"""`thermal_unit` in the stories besides `mosaic`: what sixteen bits mean is what somebody said."""

import numpy as np
import pytest
import tifffile

from skyquilt.depth.workflow import iter_depth
from skyquilt.errors import UsageError
from skyquilt.live.live_map import LiveMap
from skyquilt.live.photo_intake import Accepted
from skyquilt.live.settings import LiveSettings
from skyquilt.model.event import Note
from skyquilt.papers import compare
from skyquilt.papers.compare import CompareSettings, iter_compare
from skyquilt.settings import MosaicSettings
from skyquilt.workflows.mosaic import make_map


@pytest.fixture
def frames(tmp_path):
    """Two frames of about 22 degrees in hundredths of a kelvin that say nothing about it."""
    folder = tmp_path / "frames"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(2):
        values = 29515 + rng.integers(0, 300, (120, 160)).astype(np.uint16)
        tifffile.imwrite(folder / f"t{k}.tif", values)
    return folder


def read_as(events):
    """What the first note about units says; empty where photos are no thermal ones."""
    told = (e.text for e in events if isinstance(e, Note) and e.text.startswith("Thermal TIFFs"))
    return next(told, "")


@pytest.mark.parametrize("unit", ["centikelvin", "counts"])
def test_depth_reads_values_as_told(frames, tmp_path, unit):
    events = iter_depth(frames, tmp_path / "out", MosaicSettings(thermal_unit=unit))
    assert read_as(events) == f"Thermal TIFFs are read as {unit} (2)."


def test_compare_reads_values_as_told_in_every_run(frames, tmp_path, monkeypatch):
    """The runs' own notes are overheard: frames without positions are refused by both methods later
    on.
    """
    overheard = []

    def overhearing(*args, **more):
        steps = make_map(*args, **more)
        while True:
            try:
                overheard.append(next(steps))
            except StopIteration as stop:
                return stop.value
            yield overheard[-1]

    monkeypatch.setattr(compare, "make_map", overhearing)
    settings = CompareSettings(
        mosaic=MosaicSettings(thermal_unit="counts"), variants=("position", "image")
    )
    *_, last = iter_compare(frames, tmp_path / "out", settings)
    assert last.metrics["methods"].keys() == {"position", "image"}
    told = [e.text for e in overheard if isinstance(e, Note) and e.text.startswith("Thermal TIFFs")]
    assert told == ["Thermal TIFFs are read as counts (2)."] * 2


def test_a_live_map_keeps_reading_as_told(frames, tmp_path):
    def read(live):
        return [(m.photo.unit, m.photo.stored, m.photo.band) for m in live.members.by_id.values()]

    settings = LiveSettings(thermal_unit="centikelvin")
    live = LiveMap(tmp_path / "out", settings)
    try:
        for path in sorted(frames.iterdir()):
            assert isinstance(live.intake.take_file(path, "here"), Accepted)
        live.members.take_up()
        assert read(live) == [("celsius", "centikelvin", "thermal")] * 2
    finally:
        live.close()
    with pytest.raises(UsageError, match="thermal_unit"):
        LiveMap(tmp_path / "out", LiveSettings())
    again = LiveMap(tmp_path / "out", settings)
    try:
        assert read(again) == [("celsius", "centikelvin", "thermal")] * 2
    finally:
        again.close()


def test_a_unit_that_is_none_is_refused():
    with pytest.raises(UsageError, match="--thermal-unit 'rankine' is not one of auto, celsius"):
        LiveSettings(thermal_unit="rankine")
