"""Folders that hold visible and thermal photos, as drones with two cameras write them."""

import numpy as np
import pytest
import tifffile

from skyquilt.errors import UsageError
from skyquilt.settings import MosaicSettings
from skyquilt.thermal import workflow
from skyquilt.thermal.workflow import iter_thermal


class MappedError(Exception):
    """Instead of making a map."""


def mapped(monkeypatch, photos, thermal, output):
    """Names of the photos that would be mapped, visual and thermal, and what was said, also of the
    visual survey.
    """
    seen, notes = [], []

    def make_map(given, *_, **__):
        notes.extend(given.survey.notes)
        seen.append([p.name for p in given.survey.photos])
        raise MappedError
        yield

    def refuse_apart(_, thermal):
        seen.append([p.name for p in thermal])

    monkeypatch.setattr(workflow, "make_map", make_map)
    monkeypatch.setattr(workflow, "refuse_apart", refuse_apart)
    said = []
    with pytest.raises(MappedError):
        for event in iter_thermal(photos, thermal, output, MosaicSettings()):
            said.append(event.text)
    return seen[1], seen[0], [*said, *notes]


@pytest.fixture
def folder(tmp_path):
    """Three triggers of a drone with a wide, a zoom and a thermal camera."""
    rng = np.random.default_rng(2)
    for k in range(3):
        for name in "WZ":
            colours = rng.integers(0, 255, (60, 80, 3)).astype(np.uint8)
            path = tmp_path / "both" / f"DJI_{k:04d}_{name}.tif"
            path.parent.mkdir(exist_ok=True)
            tifffile.imwrite(path, colours, photometric="rgb")
        heat = rng.uniform(10, 30, (60, 80)).astype(np.float32)
        tifffile.imwrite(
            tmp_path / "both" / f"DJI_{k:04d}_T.tif", heat, description="unit: celsius"
        )
    return tmp_path / "both"


def test_one_folder_of_both_gives_each_map_its_photos(folder, tmp_path, monkeypatch):
    """thermal.tif was made of the visible photos, because there were more of them."""
    visual, heat, said = mapped(monkeypatch, folder, folder, tmp_path / "out")
    assert visual == [f"DJI_{k:04d}_{n}.tif" for k in range(3) for n in "WZ"]
    assert heat == [f"DJI_{k:04d}_T.tif" for k in range(3)]
    assert any("3 thermal photos in the folder" in t and "visual map" in t for t in said)
    assert any("6 visible photos in the folder" in t and "thermal map" in t for t in said)
    assert not any("spectra are mixed" in t for t in said)  # no map shows both


def test_the_visible_photos_alone_are_no_thermal_flight(folder, tmp_path):
    for path in folder.glob("*_T.tif"):
        path.unlink()
    with pytest.raises(UsageError, match="none is known to be thermal"):
        list(iter_thermal(folder, folder, tmp_path / "out", MosaicSettings()))


def test_the_thermal_photos_twice_are_refused(folder, tmp_path):
    for path in (*folder.glob("*_W.tif"), *folder.glob("*_Z.tif")):
        path.unlink()
    with pytest.raises(UsageError, match="all are thermal; for a map of them alone"):
        list(iter_thermal(folder, folder, tmp_path / "out", MosaicSettings()))


def test_pictures_that_nobody_but_the_user_calls_thermal(folder, tmp_path, monkeypatch):
    """Pictures of a palette by a camera that no table lists were taken for visible photos: for
    overexposed where it is warm, with a lens as visible cameras have.
    """
    alone = tmp_path / "heat"
    alone.mkdir()
    for path in folder.glob("*_W.tif"):
        path.rename(alone / path.name)
    for path in folder.glob("*_T.tif"):
        path.unlink()
    keyed = []
    monkeypatch.setattr(workflow, "_key", lambda _, heats, __: keyed.extend(heats[0].survey.photos))
    _, heat, said = mapped(monkeypatch, folder, alone, tmp_path / "out")
    assert heat == [f"DJI_{k:04d}_W.tif" for k in range(3)]
    assert [p.band for p in keyed] == ["thermal"] * 3
    assert {p.focal.px for p in keyed} == {1.15 * 80}  # the guess for thermal cameras
    assert any("says that it is thermal" in t for t in said)
