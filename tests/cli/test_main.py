"""The command line's promises: choices, exit codes, sentences instead of tracebacks."""

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import skyquilt
from skyquilt import errors, registry, settings
from skyquilt.cli import app as commands
from skyquilt.cli import main
from skyquilt.workflows.mosaic import STAGES

CHOICES = {
    "--method": registry.names("alignment"),
    "--blend": ("auto", *settings.BLENDS),
    "--compress": settings.COMPRESSIONS,
    "--surface": settings.SURFACES,
    "--distortion": settings.DISTORTIONS,
    "--detector": registry.names("detector"),
    "--matcher": registry.names("matcher"),
    "--estimator": registry.names("estimator"),
    "--transform": settings.TRANSFORMS,
    "--image-search": settings.IMAGE_SEARCHES,
    "--optimiser": settings.OPTIMISERS,
    "--lines": settings.LINES,
    "--rerun-from": STAGES[1:],
}


def said(*words):
    """What a command prints, without the frames around it."""
    result = CliRunner(env={"COLUMNS": "400", "TERM": "dumb"}).invoke(commands.app, list(words))
    assert result.exit_code == 0, result.output
    return re.sub(r"\s+", " ", re.sub(r"[\u2500-\u257f]", " ", result.output))


def described(*words):
    """The line of a command's help (`mosaic`, where none is named) about an option."""
    *command, option = words
    result = CliRunner(env={"COLUMNS": "400", "TERM": "dumb"}).invoke(
        commands.app, [*(command or ["mosaic"]), "--help"]
    )
    return next(line for line in result.output.splitlines() if re.search(rf"{option}\b", line))


@pytest.mark.parametrize("option", CHOICES)
def test_help_lists_every_choice(option):
    words = re.findall(r"[\w-]+", described(option))
    assert [c for c in CHOICES[option] if c not in words] == []


@pytest.mark.parametrize("command", ["mosaic", "inspect", "simulate"])
def test_every_command_explains_itself(command):
    assert "Exit codes" in said(command, "--help")
    assert command in said("--help")


def test_defaults_on_the_command_line_are_those_of_the_settings():
    import inspect

    parameters = inspect.signature(commands.mosaic_command.command).parameters
    other_names = {
        "gsd": "gsd_cm",
        "feather": "feather_px",
        "height": "height_m",
        "heading": "heading_deg",
        "memory": "memory_gb",
        "relief": "relief_m",
        "contours": "contours_m",
        "shutter_readout": "shutter_readout_ms",
    }
    defaults = dict(settings.MosaicSettings())
    named = {other_names.get(name, name): p.default for name, p in parameters.items()}
    assert set(defaults) <= set(named)
    assert {n: named[n] for n in defaults} == defaults


def test_version():
    assert said("--version").strip() == f"skyquilt {skyquilt.__version__}"


def test_exit_codes_are_those_of_the_errors():
    stated = {int(code) for code in re.findall(r"\b(\d+) [a-z]", commands.EXIT_CODES)}
    leaves = [
        e
        for e in vars(errors).values()
        if isinstance(e, type) and issubclass(e, errors.SkyquiltError)
    ]
    assert stated == {0, 130} | {e.exit_code for e in leaves}


def test_a_mosaic_of_several_paths(monkeypatch, capsys, tmp_path):
    """Which a shell makes of `photos/*.JPG`."""
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    paths = [tmp_path / "a", tmp_path / "b"]
    assert run(monkeypatch, "mosaic", *paths, "-o", tmp_path / "out") == 3
    assert "no photo in the 2 given folders" in capsys.readouterr().err
    assert run(monkeypatch, "mosaic", *paths, "-o", tmp_path / "o", "--thermal", tmp_path) == 2
    assert "one folder of visible photos" in capsys.readouterr().err


def test_codes_tell_errors_apart():
    leaves = [
        errors.UsageError,
        errors.NoPhotosError,
        errors.AlignmentError,
        errors.OutputError,
        errors.SideFileError,
        errors.RefusedError,
    ]
    assert [e.exit_code for e in leaves] == [2, 3, 4, 5, 6, 7]


def run(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["skyquilt", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        main.run()
    return end.value.code or 0


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (["--method", "magic"], 2, "auto, bundle, position, pose"),
        (["--blend", "magic"], 2, "feather, first, average, multiband"),
        (["--gsd", "0"], 2, "--gsd 0.0 lies outside 0.05 to 10000 cm"),
        (["--bounds", "1,2,3"], 2, "four numbers"),
        (["--bounds", "5,0,1,9"], 2, "west < east"),
        (["--rerun-from", "lunch"], 2, "features, links, align"),
        (["--quiet", "--json"], 2, "exclude one another"),
        (["--thermal-route", "lunch"], 2, "needs --thermal"),
        (["--all-bands", "--add"], 2, "--add and --all-bands exclude one another"),
        (["--all-bands", "--thermal", "."], 2, "--all-bands and --thermal exclude one another"),
        (["--all-bands"], 3, ""),
        ([], 3, ""),
    ],
)
def test_mistakes_get_a_sentence_and_a_code(monkeypatch, capsys, tmp_path, words, code, sentence):
    (tmp_path / "photos").mkdir()
    assert run(monkeypatch, "mosaic", tmp_path / "photos", "-o", tmp_path / "out", *words) == code
    told = capsys.readouterr().err
    assert told.startswith("skyquilt: ")
    assert len(told.strip().splitlines()) == 1
    assert sentence in told


@pytest.mark.parametrize(
    "words",
    [
        ["simulate", "{out}", "--overlap"],
        ["simulate", "{out}", "--sidelap"],
        ["plan", "{out}", "-o", "{out}", "--overlap"],
        ["plan", "{out}", "-o", "{out}", "--sidelap"],
        ["strip-test", "-o", "{out}", "--overlap"],
    ],
    ids=lambda words: f"{words[0]} {words[-1]}",
)
def test_overlaps_are_percent_and_no_shares(monkeypatch, capsys, tmp_path, words):
    words = [w.format(out=tmp_path / "out") for w in words]
    assert run(monkeypatch, *words, "0.75") == 2
    assert capsys.readouterr().err == f"skyquilt: {words[-1]} is in percent: 75, not 0.75\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "option"),
    [
        *((["inspect", "{photos}", "--max-mp", v], "--max-mp") for v in ("nan", "inf", "0", "-1")),
        *(
            (["depth", "{photos}", "-o", "{out}", "--relief", v], "--relief")
            for v in ("nan", "inf", "-1", "1e308")
        ),
        *(
            (["live", "{photos}", "-o", "{out}", option, v], option)
            for option in ("--max-mb", "--max-clip-mb", "--viewer-memory", "--max-mp")
            for v in ("nan", "inf", "1e308")
        ),
        (["export", "{photos}", "--what", "png", "--max-memory", "inf"], "--max-memory"),
        (["simulate", "{out}", "--photos", "9" * 23], "photos must be 1 to 100,000"),
    ],
)
def test_numbers_that_cannot_be_meant(monkeypatch, capsys, tmp_path, words, option):
    (tmp_path / "photos").mkdir()
    places = {"photos": tmp_path / "photos", "out": tmp_path / "out"}
    assert run(monkeypatch, *(word.format(**places) for word in words)) == 2
    told = capsys.readouterr().err
    assert told.startswith(("skyquilt: ", "Usage: "))
    assert option in told
    assert not (tmp_path / "out").exists()


INTERRUPTED = """
import sys
from skyquilt.cli import app, main
def interrupted():
    raise KeyboardInterrupt
app.app = interrupted
sys.argv = ["skyquilt", "mosaic"]
main.run()
"""


def test_an_interrupt_ends_with_130_and_says_how_to_go_on():
    """In a process of its own: an interrupt takes all threads with it."""
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, check=False
    )
    assert done.returncode == 130
    assert done.stderr == "skyquilt: interrupted; run the same command again to resume\n"


def test_help_comes_in_panels_the_six_options_most_people_need_first():
    import inspect

    from skyquilt.cli import mosaic

    panels = {}
    for name, parameter in inspect.signature(mosaic.command).parameters.items():
        panel = getattr(parameter.annotation.__metadata__[0], "rich_help_panel", None)
        if name != "photos":
            panels.setdefault(panel, []).append(name)
    assert next(iter(panels)) == mosaic.COMMON
    assert panels[mosaic.COMMON] == ["output", "gsd", "gcp", "crs", "thermal", "overwrite"]
    assert None not in panels and len(panels) > 8
    printed = described_panels()
    assert [p for p in printed if p in panels] == list(panels)


def described_panels():
    """Titles of the panels of `skyquilt mosaic --help`, in order."""
    result = CliRunner(env={"COLUMNS": "120", "TERM": "dumb"}).invoke(
        commands.app, ["mosaic", "--help"]
    )
    return re.findall(r"^\u256d\u2500 (.*?) \u2500", result.output, re.M)


@pytest.mark.parametrize("option", ["--gcp", "--geo", "--cameras", "--distances"])
def test_a_side_file_that_is_not_there_is_a_wrong_option(option, tmp_path):
    words = ["mosaic", str(tmp_path), "-o", str(tmp_path / "out"), option, str(tmp_path / "none")]
    result = CliRunner().invoke(commands.app, words)
    assert isinstance(result.exception, errors.UsageError) and result.exception.exit_code == 2
    assert option in str(result.exception) and not (tmp_path / "out").exists()


def test_a_viewer_that_others_can_reach_needs_a_token(tmp_path):
    words = ["view", str(tmp_path), "--host", "0.0.0.0", "--port", "0"]
    result = CliRunner().invoke(commands.app, words)
    assert isinstance(result.exception, errors.UsageError) and "--token" in str(result.exception)
    assert "--token" in described("view", "--host") and "--token" in described("view", "--token")


def test_live_creates_its_inbox_or_fails_before_anything_else(tmp_path):
    from skyquilt.live.folder_watch import create_inbox

    create_inbox(tmp_path / "new" / "inbox")
    assert (tmp_path / "new" / "inbox").is_dir()
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(
        commands.app, ["live", str(tmp_path / "file"), "-o", str(tmp_path / "out")]
    )
    assert isinstance(result.exception, errors.UsageError) and "is a file" in str(result.exception)
    assert result.output == "" and not (tmp_path / "out").exists()


def test_live_into_its_own_inbox_is_refused_and_writes_nothing(tmp_path):
    words = ["live", str(tmp_path), "-o", str(tmp_path / "." / "x" / ".."), "--port", "0"]
    (tmp_path / "x").mkdir()
    result = CliRunner().invoke(commands.app, words)
    assert isinstance(result.exception, errors.UsageError)
    assert "is the folder of the photos" in str(result.exception)
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


def test_shells_can_complete_commands():
    env = {"_SKYQUILT_COMPLETE": "complete_bash", "COMP_WORDS": "skyquilt exp", "COMP_CWORD": "1"}
    code = "from skyquilt.cli.app import app; app(prog_name='skyquilt')"
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False,
        env=os.environ | env,
    )  # fmt: skip
    assert said.stdout.split() == ["export"]


LONG = "a" * 5000
"""A name that no system takes."""


@pytest.mark.parametrize(
    "words",
    [
        ("mosaic", LONG, "-o", "OUT"),
        ("mosaic", "IN", "-o", LONG),
        ("mosaic", "IN", "-o", "OUT", "--gcp", LONG),
        ("mosaic", "IN", "-o", "OUT", "--thermal", LONG),
        ("inspect", LONG),
        ("plan", LONG, "-o", "OUT", "--camera", "FC6310", "--gsd", "2"),
        ("view", LONG),
        ("live", LONG, "-o", "OUT"),
        ("live", "IN", "-o", LONG),
        ("export", LONG, "--what", "png"),
        ("compare", LONG, "-o", "OUT"),
        ("depth", LONG, "-o", "OUT"),
    ],
    ids=lambda words: " ".join(w[:8] for w in words),
)
def test_a_name_that_the_system_refuses_gets_a_sentence(monkeypatch, capsys, tmp_path, words):
    (tmp_path / "IN").mkdir()
    monkeypatch.chdir(tmp_path)
    code = run(monkeypatch, *words)
    said = capsys.readouterr().err
    assert code in (2, 3, 5), said
    assert "skyquilt: " in said and "Traceback" not in said


@pytest.mark.parametrize(
    "words",
    [
        ("mosaic", "", "-o", "OUT"),
        ("mosaic", "IN", "-o", ""),
        ("mosaic", "IN", "--output="),
        ("view", "OUT", "--token", ""),
    ],
)
def test_a_variable_that_is_not_set_is_no_current_folder(monkeypatch, capsys, tmp_path, words):
    (tmp_path / "IN").mkdir()
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *words) == 2
    told = capsys.readouterr().err
    assert told.startswith("skyquilt: ") and "a variable in the command is not set" in told
    assert [p.name for p in tmp_path.iterdir()] == ["IN"]


def test_a_current_folder_that_is_gone_gets_a_sentence(monkeypatch, capsys, tmp_path):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    try:
        assert run(monkeypatch, "mosaic", tmp_path, "-o", "OUT") == 2
    finally:
        os.chdir(tmp_path)
    assert "the current folder cannot be used" in capsys.readouterr().err


def in_shell(line, *words):
    """Exit code and standard error of the command `"$@"` in a line of a shell."""
    words = ["sh", "-c", line, "sh", sys.executable, "-m", "skyquilt", *map(str, words)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    return done.returncode, done.stderr


@pytest.mark.slow
def test_closed_streams_change_nothing(tmp_path):
    """Without them sentences could not be written, and files would get their numbers."""
    words = ("mosaic", tmp_path, "-o", tmp_path / "out")
    assert in_shell('"$@" 2>&-', *words) == (3, "")
    assert in_shell('"$@" <&- >&- 2>&-', *words) == (3, "")
    said = in_shell('"$@" <&- >&-', *words)
    assert said[0] == 3 and said[1].startswith("skyquilt: There is no photo")
    code = (
        "import os; from skyquilt.cli.main import _streams; _streams();"
        "os._exit(os.open(os.devnull, os.O_RDONLY))"
    )
    done = subprocess.run(
        ["sh", "-c", f"{sys.executable} -c '{code}' <&- >&- 2>&-"], check=False, timeout=60
    )
    assert done.returncode >= 3


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device")
@pytest.mark.parametrize("words", [("--version",), ("mosaic", "--help")])
def test_output_to_a_full_disk_gets_a_sentence(words):
    code, told = in_shell('"$@" >/dev/full', *words)
    assert code == 5
    assert told.startswith("skyquilt: what is printed, or a file, cannot be written (No space")
    assert told.count("\n") == 1


@pytest.mark.slow
def test_too_few_addresses_get_a_sentence(tmp_path):
    """With these, libraries end the process by a fault of memory in the middle of a run."""
    code, told = in_shell('ulimit -v 700000; "$@"', "mosaic", tmp_path, "-o", tmp_path / "out")
    assert code == 1
    assert told.startswith("skyquilt: the system allows 717 MB of addresses")
    assert told.count("\n") == 1
    assert in_shell('ulimit -v 1000000; "$@"', "mosaic", tmp_path, "-o", tmp_path / "out")[0] == 3


@pytest.mark.slow
def test_too_few_open_files_get_a_sentence(tmp_path):
    """With these, the live map's server ended in a traceback, and its tiles could not be opened."""
    words = ("live", tmp_path, "-o", tmp_path / "out", "--port", "0")
    code, told = in_shell('ulimit -n 24; "$@"', *words)
    assert code == 1 and told.count("\n") == 1
    assert told.startswith("skyquilt: the system allows 24 open files")
    assert not (tmp_path / "out").exists()
    # a limit that the program may raise is raised
    assert in_shell('ulimit -S -n 24; "$@"', *words, "--max-mb", "0")[0] == 2


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 9 GiB"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),
    ],
)
def test_a_full_memory_is_a_sentence(monkeypatch, capsys, error):
    def fails():
        raise RuntimeError("the step that met it") from error

    monkeypatch.setattr("skyquilt.cli.app.app", fails)
    with pytest.raises(SystemExit) as end:
        main.run()
    assert end.value.code == 1
    told = capsys.readouterr().err
    assert told.startswith("skyquilt: the system gives no more memory") and told.count("\n") == 1


def test_a_bug_keeps_its_traceback(monkeypatch):
    def fails():
        raise RuntimeError("a bug")

    monkeypatch.setattr("skyquilt.cli.app.app", fails)
    with pytest.raises(RuntimeError, match="a bug"):
        main.run()


def test_photos_in_place_of_a_command_are_told_what_maps_them(tmp_path):
    """A word that is neither a command nor a path is answered as before."""
    invoke = CliRunner().invoke
    told = invoke(commands.app, [str(tmp_path)]).exception
    assert isinstance(told, errors.UsageError) and f"skyquilt mosaic {tmp_path} -o OUT" in str(told)
    assert invoke(commands.app, [str(tmp_path / "none")]).exit_code == 2
    assert invoke(commands.app, ["mosaic", "--help"]).exit_code == 0
