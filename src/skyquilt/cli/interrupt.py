"""Ctrl-C: one sentence and exit code 130, whenever it comes."""

import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

CODE = 130
"""What shells know an interrupt by."""


def say() -> None:
    """The sentence, on standard error; a second Ctrl-C while the program goes down is ignored."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    resumable = (
        "; run the same command again to resume" if sys.argv[1:2] in (["mosaic"], ["live"]) else ""
    )
    sys.stderr.write(f"skyquilt: interrupted{resumable}\n")
    sys.stderr.flush()


def leave() -> NoReturn:
    """Ends the program, all of its threads included: Python's own way out is no place for a second
    Ctrl-C.
    """
    say()
    sys.stdout.flush()
    os._exit(CODE)


@contextmanager
def ends_at_once() -> Iterator[None]:
    """While modules load, Ctrl-C ends the program then and there.

    Nothing is under way yet that needs care, and some modules swallow every exception while they
    load. The garbage collector rests meanwhile, and what was loaded it never looks through again:
    modules are no garbage, and looking takes a tenth of the time that loading does.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.signal(signal.SIGINT, lambda *_: leave())
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collects:
            gc.enable()
        signal.signal(signal.SIGINT, former)
