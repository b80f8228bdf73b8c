import errno
import json
from pathlib import Path

import pytest

from skyquilt.engine.folder import CONTRACT, STATE, open_run
from skyquilt.errors import OutputError


def finish(path, key="k"):
    run = open_run(path, key, overwrite=False)
    for name in CONTRACT:
        (path / name).write_text("result")
    run.mark("done")
    return run


def test_a_new_folder_and_its_parents_are_made(tmp_path):
    run = open_run(tmp_path / "a" / "b", "k", overwrite=False)
    assert not run.done
    assert json.loads((run.path / STATE / "run.json").read_text()) == {
        "key": "k",
        "state": "running",
    }


def test_an_empty_folder_is_free(tmp_path):
    assert not open_run(tmp_path, "k", overwrite=False).done


def test_a_run_killed_before_it_wrote_its_key_is_taken_up(tmp_path):
    (tmp_path / STATE).mkdir()
    open_run(tmp_path, "k", overwrite=False)


def test_the_same_run_is_done_or_resumed(tmp_path):
    finish(tmp_path)
    assert open_run(tmp_path, "k", overwrite=False).done
    (tmp_path / "report.html").unlink()
    assert not open_run(tmp_path, "k", overwrite=False).done
    assert (tmp_path / "mosaic.tif").exists()


def test_another_run_is_refused_replaced_or_made_again(tmp_path):
    finish(tmp_path)
    with pytest.raises(OutputError, match=r"another run.*--overwrite"):
        open_run(tmp_path, "other", overwrite=False)
    assert (tmp_path / "mosaic.tif").exists()
    open_run(tmp_path, "other", overwrite=False, again=True)
    assert not (tmp_path / "mosaic.tif").exists()


def test_other_files_are_refused_and_survive_overwriting(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for again in (False, True):
        with pytest.raises(OutputError, match=r"other files.*--overwrite"):
            open_run(tmp_path, "k", overwrite=False, again=again)
    open_run(tmp_path, "k", overwrite=True)
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("text", ["", "{", "[]", '"text"', '{"key": 1}', "\xff"])
def test_a_damaged_state_counts_as_none(tmp_path, text):
    finish(tmp_path)
    (tmp_path / STATE / "run.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(OutputError, match="other files"):
        open_run(tmp_path, "k", overwrite=False)


def test_files_and_places_below_files_are_no_folders(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="is a file"):
        open_run(tmp_path / "file", "k", overwrite=True)
    with pytest.raises(OutputError, match="cannot write"):
        open_run(tmp_path / "file" / "out", "k", overwrite=True)


@pytest.mark.parametrize(
    ("number", "words"), [(errno.ENOSPC, "disk is full"), (errno.EACCES, "another output folder")]
)
def test_refusals_of_the_disk_say_what_to_do(tmp_path, monkeypatch, number, words):
    def refuse(*args, **options):
        raise OSError(number, "refused")

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(OutputError, match=words):
        open_run(tmp_path, "k", overwrite=False)
    monkeypatch.undo()
    run = open_run(tmp_path, "k", overwrite=False)
    monkeypatch.setattr(Path, "write_text", refuse)
    with pytest.raises(OutputError, match=words):
        run.mark("done")
