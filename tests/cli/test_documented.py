"""Every command that the documents name is one that the program understands."""

import re
import shlex
from pathlib import Path

import pytest
import typer

from skyquilt.cli.app import app
from skyquilt.cli.idle import refuse

ROOT = Path(__file__).resolve().parents[2]
FENCE = re.compile(r"^```\w*\n(.*?)^```", re.M | re.S)
INLINE = re.compile(r"`((?:\.venv/bin/)?skyquilt [^`]+)`")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def commands():
    """(page, words after `skyquilt`, whether it is whole) of every command."""
    for page in PAGES:
        if page.name == "CHANGELOG.md":
            continue
        text = page.read_text()
        name = page.relative_to(ROOT).as_posix()
        for block in FENCE.findall(text):
            for line in block.replace("\\\n", " ").splitlines():
                if found := re.match(r"\s*(?:srun \S+ \S+ )?(?:\.venv/bin/)?skyquilt (.*)", line):
                    yield name, found[1], True
        yield from ((name, m.split(" ", 1)[1], False) for m in INLINE.findall(FENCE.sub("", text)))


def words_of(command):
    """The words of a command as a shell gives them, with all that is optional; the first one of
    words to choose of.
    """
    plain = re.sub(r"[\[\]]", "", command)
    plain = re.sub(r"\|\w+", "", plain)
    return [w for w in shlex.split(plain, comments=True) if w != "&"]


def parsed(words):
    """The context of a command, or that of the group's command below it."""
    found = typer.main.get_command(app)
    name = words.pop(0)
    command = found.commands[name]
    if hasattr(command, "commands"):  # plan
        name = words.pop(0) if words[0] in command.commands else "area"
        command = command.commands[name]
    return command, name, words


LISTED = [c for c in commands() if not c[1].startswith("--")]


def test_many_are_found():
    assert len(LISTED) > 90 and sum(whole for _, _, whole in LISTED) > 35
    assert {w.split()[0] for _, w, _ in LISTED} >= {"mosaic", "plan", "live", "register", "export"}


@pytest.mark.parametrize(("page", "text", "whole"), LISTED, ids=lambda v: str(v)[:60])
def test_a_documented_command_is_understood(page, text, whole):
    """Whole ones are parsed, and refused if an option has no effect; of others the options are
    known.
    """
    command, name, words = parsed(words_of(text))
    known = {o for p in command.params for o in (*p.opts, *p.secondary_opts)} | {"--help"}
    assert [w for w in words if w.startswith("-") and w not in known] == [], page
    if "--help" in words or not (whole or "-o" in words):
        return
    with command.make_context(name, list(words)) as context:
        refuse(context)
