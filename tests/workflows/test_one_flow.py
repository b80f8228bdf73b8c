"""One flow: a finished map gives its photos and its ground without computing anything again."""

import shutil
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest

from skyquilt.alignment.inputs import AlignmentInputs
from skyquilt.engine.clock import result_of
from skyquilt.engine.store import Store
from skyquilt.model.photo import Focal, Shutter
from skyquilt.model.poses import MapFrame
from skyquilt.settings import MosaicSettings
from skyquilt.thermal import workflow as thermal
from skyquilt.workflows import survey_input
from skyquilt.workflows.keys import alignment_key
from skyquilt.workflows.methods import methods_for
from skyquilt.workflows.mosaic import make_map
from skyquilt.workflows.survey_input import read_input
from tests.alignment.surveys import photo

QUICK = {"surface": "ties", "gsd_cm": 30.0, "jobs": 2}


@pytest.mark.slow
@pytest.mark.parametrize(
    "asked", [{}, {"method": "image"}, {"method": "pose", "repair": False}], ids=str
)
def test_the_scene_of_a_finished_map_is_found_not_made(small_flight, tmp_path, monkeypatch, asked):
    """Whatever the method: one that needs no links has none sought for it afterwards either."""
    level = {k: v for k, v in QUICK.items() if k != "surface"}
    settings = MosaicSettings(**(level if asked else QUICK), **asked)
    given = read_input(small_flight / "photos", settings.input)
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
    photos, heats = flight / "photos", tmp_path / "thermal"
    shutil.copytree(photos, heats)
    for path in heats.glob("*.jpg"):
        path.write_bytes(path.read_bytes() + b"\0")  # the same photos twice are refused
    settings = MosaicSettings(**QUICK)
    for _ in thermal.iter_thermal(photos, heats, tmp_path / "out", settings, route="positions"):
        pass
    assert sorted(folders) == sorted([photos, heats])  # each once


@pytest.mark.parametrize(
    "changed",
    [
        {"shutter": Shutter(readout_s=0.03, sigma_s=0.001, source="option")},
        {"velocity_ned": (3.0, 0.0, 0.0)},
        {"time": datetime(2024, 5, 1, 12)},
        {"focal": Focal(px=700.0, sigma_px=7.0, source="sensor")},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_an_alignment_is_made_anew_when_anything_that_enters_it_has_changed(changed):
    def key(one):
        inputs = AlignmentInputs(
            photos=(one,),
            features=(),
            frame=MapFrame(crs=None, origin=(0.0, 0.0), vertical_datum="unknown", metric=False),
            priors=(),
            links=(),
            control=(),
            order=(0,),
            grey=lambda *_: np.zeros((1, 1), np.uint8),
        )
        return alignment_key(inputs, methods_for(MosaicSettings()))

    assert key(photo()) == key(photo())
    assert key(photo()) != key(replace(photo(), **changed))
