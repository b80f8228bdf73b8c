"""Files that are lost while a second camera is placed beside the map, whose pairs of photos tell of
it: each costs its own pair or frame.
"""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile

from skyquilt.engine.clock import Clock
from skyquilt.engine.store import Store
from skyquilt.engine.workers import Threads
from skyquilt.errors import PhotoFailedError
from skyquilt.geometry.camera import Camera
from skyquilt.model.event import Note
from skyquilt.model.poses import Pose
from skyquilt.multispectral import workflow
from skyquilt.multispectral.captures import BandFiles
from skyquilt.multispectral.draw import PlacedBand
from skyquilt.photos.read import read_photo
from skyquilt.thermal import by_heights, by_pairs, by_rig
from skyquilt.workflows import photo_features
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.photo_features import pixels_again
from skyquilt.workflows.second_camera import seen_together


def lost(*_, **__):
    raise PhotoFailedError("1.jpg", "its file is gone")


@pytest.fixture
def frame(tmp_path):
    """A thermal frame that was read."""
    values = np.random.default_rng(1).normal(20, 5, (64, 80)).astype(np.float32)
    tifffile.imwrite(tmp_path / "1.tif", values)
    tifffile.imwrite(tmp_path / "other.tif", values[::-1])
    return read_photo(tmp_path / "1.tif")


def scene_without_pixels():
    """A map of one photo, whose file is gone."""
    camera = Camera.ideal(width=80, height=64, focal=80.0)
    photo = SimpleNamespace(name="1.jpg", channels=3, dtype="uint8")
    pose = Pose(cam_R_map=np.diag([1.0, -1, -1]), map_C=np.array([0.0, 0, 50]))
    alignment = SimpleNamespace(poses={0: pose}, camera=lambda _: camera, held=(0,))
    aligned = SimpleNamespace(photos=(photo,), pixels=lost, grey=lost, alignment=alignment)
    view = SimpleNamespace(photo=0, pose=pose)
    ground = SimpleNamespace(views=[view], surface=None, grid=None)
    return SimpleNamespace(aligned=aligned, ground=ground)


@pytest.mark.parametrize("spoil", ["gone", "cut", "empty", "other"])
def test_a_file_is_read_again_only_as_it_was(frame, spoil):
    whole = frame.path.read_bytes()
    assert pixels_again(frame).shape == (64, 80)
    if spoil == "gone":
        frame.path.unlink()
    elif spoil == "other":
        shutil.copy(frame.path.with_name("other.tif"), frame.path)
    else:
        frame.path.write_bytes(whole[: len(whole) // 2] if spoil == "cut" else b"")
    why = "its file is gone" if spoil == "gone" else "its file was changed after it had been read"
    with pytest.raises(PhotoFailedError, match=why):
        pixels_again(frame)
    assert by_rig._undecodable(frame).reason == why


def test_memory_is_no_fault_of_a_file(frame, monkeypatch):
    def full(_):
        raise MemoryError

    monkeypatch.setattr(photo_features, "read_color", full)
    with pytest.raises(MemoryError, match=r"decode 1\.tif"):
        pixels_again(frame)


@pytest.mark.parametrize("which", ["map", "frame"])
def test_pairs_of_a_rig(frame, which):
    """The run ended with the exit code of a wrong option, or with the error of the photo."""
    scene = scene_without_pixels()
    if which == "frame":
        picture = np.zeros((64, 80, 3), np.uint8)
        scene.aligned.pixels, scene.aligned.grey = (lambda _: picture), (lambda *_: picture[..., 0])
        scene.aligned.photos = (replace(frame, channels=3, dtype="uint8", unit=""),)
        frame.path.unlink()
    assert by_rig._registered(scene, 0, frame, np.zeros(3)) is None
    assert seen_together(scene, [(0, 0)], [frame], {0: np.zeros(3)}, 6, coloured=True) == []


def test_pairs_of_two_maps(monkeypatch):
    scene = scene_without_pixels()
    view = SimpleNamespace(photo=0, footprint=np.array([[0.0, 0], [9, 0], [9, 9], [0, 9]]))
    monkeypatch.setattr(by_pairs, "_flat", lost)
    monkeypatch.setattr(by_pairs, "_shift", lambda *_: np.zeros(2))
    scene.ground.grid = SimpleNamespace(gsd=0.1)
    assert by_pairs._registered(scene, scene, view, view, None) is None
    assert by_pairs._as_they_are(scene, scene, (view, np.eye(3)), (view, np.eye(3))) is None


def test_heights_are_measured_in_the_others():
    scene = scene_without_pixels()
    scene.ground.views[0].pose = SimpleNamespace(cam_H_map=None)
    asked = []

    def dense(surface, views, grid, grey):
        asked.append(len(views))
        return grey(0, 2000) if views else None

    assert by_heights._heights(scene, dense) is None and asked == [1, 0]


def test_a_band_without_files_is_not_drawn(frame, monkeypatch):
    """It was drawn empty."""
    files = BandFiles(name="nir", photos=(frame,), tags=())
    bands = [PlacedBand(files=files, of_photo={0: 0})]
    placed = SimpleNamespace(bands=bands, lost=[], kind="relative")

    def blocks(_):
        raise PhotoFailedError(frame.name, "its file is gone")
        yield

    monkeypatch.setattr(workflow, "_drawing", lambda *_: SimpleNamespace(blocks=blocks))
    clock = Clock(
        store=Store(folder=frame.path.parent, registry=REGISTRY),
        began=Clock.now(),
        workers=Threads(1),
    )
    made = SimpleNamespace(result=SimpleNamespace(output=frame.path.parent))
    steps, told = workflow._drawn(made, None, placed, clock, ""), []
    while True:
        try:
            told.append(next(steps))
        except StopIteration as end:
            drawn, gone, names = end.value
            break
    assert drawn == [] and names == [] and [r.name for r in gone] == [frame.name]
    assert "so there is no bands.tif" in [e.text for e in told if isinstance(e, Note)][-1]
