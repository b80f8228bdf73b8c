"""Flights that are simulated once for all processes that run tests beside one another."""

import fcntl
import os
from pathlib import Path

import pytest

from skyquilt.simulate import FlightSettings, simulate


def flown_once(temporary: pytest.TempPathFactory, name: str, settings: FlightSettings) -> Path:
    """Folder of a simulated flight. Other processes read it too: it is not to be changed."""
    shared = temporary.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder, whole = shared / "flights" / name, shared / "flights" / f"{name}.whole"
    folder.parent.mkdir(exist_ok=True)
    with folder.with_name(f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not whole.exists():
            for _ in simulate(settings, folder, overwrite=True):
                pass
            whole.touch()
    return folder
