"""Flights that are simulated, and maps that are made, once for all processes that run tests beside
one another; pictures that are looked at and commands that are made once by each.
"""

import copy
import fcntl
import functools
import hashlib
import os
import pickle
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import typer.main

from skyquilt.matching.sift import Sift
from skyquilt.model.features import Features
from skyquilt.simulate import FlightSettings, simulate


def once_for_all(
    temporary: pytest.TempPathFactory, name: str, make: Callable[[Path], object]
) -> Path:
    """A folder that is made by one process. Others read it too: it is not to be changed."""
    shared = temporary.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder, whole = shared / "once" / name, shared / "once" / f"{name}.whole"
    folder.parent.mkdir(exist_ok=True)
    with folder.with_name(f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not whole.exists():
            make(folder)
            whole.touch()
    return folder


def flown_once(temporary: pytest.TempPathFactory, name: str, settings: FlightSettings) -> Path:
    """Folder of a simulated flight, for all processes. Those of one name and other settings are not
    one.
    """
    mark = zlib.crc32(repr(settings).encode())
    return once_for_all(
        temporary,
        f"{name}-{mark:08x}",
        lambda folder: list(simulate(settings, folder, overwrite=True)),
    )


typer.main.get_command = cache(typer.main.get_command)


def made_once(make):
    """Decorates a class of scenes: one that is made of the same arguments again has the same parts,
    in lists of its own, for tests that exchange some.
    """
    honest, made = make.__init__, {}

    @functools.wraps(honest)
    def init(self, *args, **options):
        key = pickle.dumps((args, sorted(options.items())))
        if key not in made:
            honest(self, *args, **options)
            made[key] = copy.copy(self.__dict__)
        parts = made[key].items()
        self.__dict__ = {k: v[:] if isinstance(v, list) else v for k, v in parts}

    make.__init__ = init
    return make


PICTURES = 200
"""Pictures whose features are remembered, those seen last: some hundred MB."""


@contextmanager
def seen_once() -> Iterator[None]:
    """What SIFT finds on the same picture again, in another test, is remembered in this process."""
    honest, found = Sift.of_shrunken, OrderedDict[object, Features]()

    def remembered(sift: Sift, small: np.ndarray, full: tuple[int, int]) -> Features:
        picture = hashlib.sha256(np.ascontiguousarray(small)).digest()
        key = (sift, picture, small.shape, small.dtype.str, full)
        known = found.pop(key, None)
        known = honest(sift, small, full) if known is None else known
        found[key] = known
        if len(found) > PICTURES:
            found.popitem(last=False)
        return copy.deepcopy(known)

    with mock.patch.object(Sift, "of_shrunken", remembered):
        yield


@pytest.fixture(scope="package", autouse=True)
def pictures_seen_before() -> Iterator[None]:
    """For packages of tests of what follows SIFT, which takes a third of a small map's time."""
    with seen_once():
        yield
