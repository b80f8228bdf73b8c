"""One flow: a finished map gives its photos and its ground without computing anything again."""

import numpy as np
import pytest

from skyquilt.engine.clock import result_of
from skyquilt.engine.store import Store
from skyquilt.settings import MosaicSettings
from skyquilt.thermal import workflow as thermal
from skyquilt.workflows import survey_input
from skyquilt.workflows.mosaic import make_map
from skyquilt.workflows.survey_input import read_input

QUICK = {"surface": "ties", "gsd_cm": 30.0, "jobs": 2}


@pytest.mark.parametrize(
    "asked", [{}, {"method": "image"}, {"method": "pose", "repair": False}], ids=str
)
def test_the_scene_of_a_finished_map_is_found_not_made(flight, tmp_path, monkeypatch, asked):
    """Whatever the method: one that needs no links has none sought for it afterwards either."""
    settings = MosaicSettings(**QUICK, **asked)
    given = read_input(flight / "photos", settings.input)
    finished = result_of(make_map(given, tmp_path / "out", settings))
    made = []
    put = Store.put
    monkeypatch.setattr(Store, "put", lambda *args: made.append(args[1]) or put(*args))
    scene = finished.scene()
    assert made == []
    assert len(scene.aligned.alignment.poses) == finished.result.metrics["photos_used"]
    assert len(scene.aligned.links.links) == finished.result.metrics["links"]
    assert scene.ground.grid.gsd == finished.result.metrics["gsd_m"]
    again = result_of(make_map(given, tmp_path / "out", settings))  # nothing to do
    assert np.array_equal(again.scene().ground.surface.z, scene.ground.surface.z)


@pytest.mark.slow
def test_both_surveys_of_a_thermal_map_are_read_once(flight, tmp_path, monkeypatch):
    read, folders = survey_input.read_survey, []

    def counted(folder, **more):
        folders.append(folder)
        return read(folder, **more)

    monkeypatch.setattr(survey_input, "read_survey", counted)
    photos = flight / "photos"
    settings = MosaicSettings(**QUICK)
    for _ in thermal.iter_thermal(photos, photos, tmp_path / "out", settings, route="positions"):
        pass
    assert folders == [photos, photos]  # here they are one folder: each role reads it once
