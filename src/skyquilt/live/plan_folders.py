"""Folders of the plans that are made during a live survey."""

from pathlib import Path

PLANS = "plans"
"""Folder of the plans made while the map grows."""


def next_folder(folder: Path, word: str) -> Path:
    """A new folder for a plan: `plans/fill-1`, `plans/fill-2` ..."""
    number = 1
    while (Path(folder) / PLANS / f"{word}-{number}").exists():
        number += 1
    return Path(folder) / PLANS / f"{word}-{number}"
