"""What was read of photos is taken from the store, and only of files that did not change."""

import os
import shutil
from dataclasses import fields

import pytest

from skyquilt.engine.store import Store
from skyquilt.model.photo import RejectedPhoto
from skyquilt.photos import read
from skyquilt.photos.read import ReadFiles
from skyquilt.settings import InputSettings
from skyquilt.workflows.artefacts import REGISTRY
from skyquilt.workflows.survey_input import read_input


@pytest.fixture
def folder(flight, tmp_path):
    """Photos, one of them cut to a header, with files that are read at every run."""
    home = tmp_path / "photos"
    shutil.copytree(flight / "photos", home)
    first = sorted(home.glob("*.jpg"))[0]
    (home / "broken.jpg").write_bytes(first.read_bytes()[:40])
    return home


def facts(given):
    """All fields of the photos as text."""
    return [[repr(getattr(p, f.name)) for f in fields(p)] for p in given.survey.photos]


def test_files_are_read_once(folder, tmp_path, monkeypatch):
    store, asked = Store(folder=tmp_path / "store", registry=REGISTRY), []
    header = read.read_header
    monkeypatch.setattr(
        read, "read_header", lambda path, **k: (asked.append(path.name), header(path, **k))[1]
    )

    def given(keep=True, **settings):
        asked.clear()
        files = ReadFiles(store)
        found = read_input(folder, InputSettings(**settings), files)
        if keep:
            files.keep(store)
        return found

    plain = facts(read_input(folder, InputSettings()))
    assert facts(given(keep=False)) == plain and not (tmp_path / "store").exists()
    assert facts(given()) == plain and len(asked) == 10
    again = given()
    assert facts(again) == plain
    # what could not be read is tried again: the disk may have failed
    assert asked == ["broken.jpg"] and isinstance(again.survey.rejected[0], RejectedPhoto)
    kept = next((tmp_path / "store").rglob("*.npz"))
    before = kept.stat().st_mtime_ns
    given()
    assert kept.stat().st_mtime_ns == before
    # another meaning of the values, and another limit, are other questions
    given(keep=False, max_mp=50.0)
    assert len(asked) == 10

    one, two, three = sorted(folder.glob("SIM*.jpg"))[:3]
    time = one.stat()
    one.write_bytes(one.read_bytes()[:-2] + b"\xff\xd9")  # the same size, and the same times
    os.utime(one, ns=(time.st_atime_ns, time.st_mtime_ns))
    two.rename(folder / "moved.jpg")
    three.unlink()
    shutil.copy(sorted(folder.glob("SIM*.jpg"))[-1], folder / "copy.jpg")
    changed = given()
    assert set(asked) == {"broken.jpg", "copy.jpg", "moved.jpg", one.name}
    assert facts(changed) == facts(read_input(folder, InputSettings()))
    assert three.name not in {p.name for p in changed.survey.photos}

    kept.write_bytes(b"damaged")
    assert facts(given()) == facts(changed)
