import errno
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from skyquilt.engine import lock
from skyquilt.engine.folder import CONTRACT, FILES, PART, STATE, check_room, claimed, open_run
from skyquilt.engine.lock import NO_LOCKS
from skyquilt.errors import OutputError, RefusedError
from skyquilt.version import __version__


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
        "version": __version__,
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


def cut(path):
    path.write_bytes(path.read_bytes()[:-1])


def hole(path):
    """What a disk leaves that lost power: the right size, zeros at the end."""
    content = bytearray(path.read_bytes())
    middle, rest = len(content) // 2, len(content) - len(content) // 2
    content[middle:] = bytes(rest)
    path.write_bytes(content)


@pytest.mark.parametrize("size", [40, 3 * PART, 3_000_001])
@pytest.mark.parametrize("spoil", [cut, hole, Path.unlink, lambda p: p.write_bytes(b"")])
def test_a_finished_file_that_is_damaged_is_made_again(tmp_path, size, spoil):
    run = finish(tmp_path)
    optional = tmp_path / "dsm.tif"
    optional.write_bytes(bytes(range(1, 251)) * (size // 250) + b"x" * (size % 250))
    run.mark("done")
    assert run.done and run.changed == ()
    (tmp_path / "metrics.json").write_text("a thermal map was added")
    assert run.done
    spoil(optional)
    assert run.changed == ("dsm.tif",) and not run.done


def test_a_run_of_another_version_is_named(tmp_path):
    finish(tmp_path)
    state = tmp_path / STATE / "run.json"
    record = json.loads(state.read_text())
    for version, words in (("0.0.1", "version 0.0.1"), (None, "an earlier version")):
        record["version"] = version
        state.write_text(json.dumps({k: v for k, v in record.items() if v}))
        with pytest.raises(OutputError, match=rf"{words} of Skyquilt, and this is version"):
            open_run(tmp_path, "other", overwrite=False)


def test_another_run_is_refused_replaced_or_made_again(tmp_path):
    finish(tmp_path)
    with pytest.raises(OutputError, match=r"another run.*--overwrite"):
        open_run(tmp_path, "other", overwrite=False)
    assert (tmp_path / "mosaic.tif").exists()
    open_run(tmp_path, "other", overwrite=False, again=True)
    assert not (tmp_path / "mosaic.tif").exists()


def test_nothing_of_the_replaced_run_stays_beside_the_new_one(tmp_path):
    """Not what only some runs write: bare ground or temperatures of other photos."""
    finish(tmp_path)
    for name in FILES:
        (tmp_path / name).write_text("of the earlier run")
    (tmp_path / "mine.txt").write_text("mine")
    open_run(tmp_path, "other", overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == [STATE, "mine.txt"]


def test_one_process_writes_to_a_folder_at_a_time(tmp_path):
    """What the first has made stays, whatever the second asks for; a killed one holds nothing."""
    code = (
        "import sys; from pathlib import Path; from skyquilt.engine.folder import open_run;"
        "run = open_run(Path(sys.argv[1]), 'k', overwrite=False);"
        "(run.path / 'mosaic.tif').write_text('half');"
        "print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout.readline() == "held\n"
        for key, overwrite in (("k", False), ("k", True), ("other", True)):
            with pytest.raises(OutputError, match=rf"another run works.*process {other.pid}"):
                open_run(tmp_path, key, overwrite=overwrite)
        assert (tmp_path / "mosaic.tif").read_text() == "half"
        assert json.loads((tmp_path / STATE / "run.json").read_text())["key"] == "k"
        other.kill()
        other.wait()
    open_run(tmp_path, "k", overwrite=False)


@pytest.mark.parametrize("number", NO_LOCKS)
def test_disks_without_locks_are_written_to(tmp_path, monkeypatch, number):
    def refused(*asked):
        raise OSError(number, "no locks here")

    monkeypatch.setattr(lock.fcntl, "lockf", refused)
    finish(tmp_path)
    assert open_run(tmp_path, "k", overwrite=False).done


def test_a_run_whose_results_disappeared_is_not_finished(tmp_path):
    """The folder was emptied while the run worked: the same command goes on afterwards."""
    run = open_run(tmp_path, "k", overwrite=False)
    for name in CONTRACT:
        (tmp_path / name).write_text("result")
    (tmp_path / "mosaic.tif").unlink()
    shutil.rmtree(tmp_path / STATE)
    with pytest.raises(OutputError, match=r"mosaic\.tif in .* disappeared.*same command again"):
        run.finish()
    again = open_run(tmp_path, "k", overwrite=False)
    assert not again.done
    (tmp_path / "mosaic.tif").write_text("result")
    again.finish()
    assert open_run(tmp_path, "k", overwrite=False).done


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
    with pytest.raises(OutputError, match="file is a file; .*out cannot be below it"):
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


def working(folder, say):
    """A process that holds the folder until it is told to end."""
    code = (
        "import sys; from pathlib import Path; from skyquilt.engine.folder import claimed\n"
        f"with claimed(Path({str(folder)!r}), ['a.json'], overwrite=True):\n"
        f"    print({say!r}, flush=True); sys.stdin.read(1)\n"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def test_one_command_writes_to_a_folder_at_a_time(tmp_path):
    out = tmp_path / "out"
    with working(out, "here") as other:
        assert other.stdout.readline() == "here\n"
        (out / "a.json").write_text("the other's")
        for overwrite in (False, True):
            with pytest.raises(OutputError), claimed(out, ["a.json"], overwrite=overwrite):
                pass
        with pytest.raises(OutputError, match=f"process {other.pid}"):
            open_run(out, "key", overwrite=True)
        assert (out / "a.json").read_text() == "the other's"
        other.communicate("x")
    assert [p.name for p in out.iterdir()] == ["a.json"]  # no lock is left behind
    with pytest.raises(OutputError, match="already holds files"), claimed(out, [], overwrite=False):
        pass


def test_a_killed_command_leaves_nothing_in_the_way(tmp_path):
    out = tmp_path / "out"
    with working(out, "here") as other:
        other.stdout.readline()
        other.kill()
    with claimed(out, ["a.json"], overwrite=False):
        (out / "a.json").write_text("new")
    assert [p.name for p in out.iterdir()] == ["a.json"]


def stopped(out, names, error=KeyboardInterrupt):
    """A command that is stopped while it writes."""
    with pytest.raises(error), claimed(out, ["a.json", "b.tif"], overwrite=False, folders=["c"]):
        for name in names:
            (out / name).parent.mkdir(exist_ok=True)
            (out / name).write_text("half")
        raise error("stopped")


def refused(out, names):
    held = pytest.raises(OutputError, match="already holds files")
    with held, claimed(out, names, overwrite=False, folders=["c"]):
        pass


@pytest.mark.parametrize("error", [OutputError, KeyboardInterrupt, RuntimeError])
def test_the_same_command_replaces_what_a_stopped_one_left(tmp_path, error):
    """It was refused: "already holds files", where the error had said to run it again."""
    out = tmp_path / "out"
    stopped(out, ["a.json", "b.tif.partial", "c/1.png", ".probe"], error)
    with claimed(out, ["a.json", "b.tif"], overwrite=False, folders=["c"]):
        assert not (out / "a.json").exists() and not (out / "b.tif.partial").exists()
        (out / "a.json").write_text("whole")
    assert sorted(p.name for p in out.iterdir()) == ["a.json", "c"]
    refused(out, ["a.json"])


def test_a_killed_command_with_results_is_replaced_too(tmp_path):
    out = tmp_path / "out"
    with working(out, "here") as other:
        other.stdout.readline()
        (out / "a.json").write_text("half")
        other.kill()
    with claimed(out, ["a.json"], overwrite=False):
        assert not (out / "a.json").exists()


def test_files_of_others_beside_those_of_a_stopped_command_are_kept(tmp_path):
    out = tmp_path / "out"
    stopped(out, ["a.json"])
    (out / "notes.txt").write_text("mine")
    refused(out, ["a.json", "b.tif"])
    assert (out / "notes.txt").read_text() == "mine"


def test_a_refusal_is_a_result(tmp_path):
    out = tmp_path / "out"
    stopped(out, ["a.json"], RefusedError)
    refused(out, ["a.json", "b.tif"])


def test_a_stopped_command_that_wrote_nothing_leaves_nothing(tmp_path):
    stopped(tmp_path / "out", [])
    assert not any((tmp_path / "out").iterdir())


def test_room_is_checked_before_the_work_and_nothing_is_changed(tmp_path):
    """`plan` told after its routes were found that it may not write them."""
    out = tmp_path / "out"
    check_room(out, ["a.json"], overwrite=False)
    assert not any(out.iterdir())
    (out / "a.json").write_text("a plan")
    check_room(out, ["a.json"], overwrite=True)
    assert (out / "a.json").read_text() == "a plan"
    for place in (out, out / "a.json", out / "a.json" / "below"):
        with pytest.raises(OutputError):
            check_room(place, ["a.json"], overwrite=False)
