"""Ctrl-C: one sentence and exit code 130, at any time."""

import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

CODE = 130
"""Exit code by which shells recognise an interrupt."""


def say() -> None:
    """Prints the sentence to standard error; a second Ctrl-C during shutdown is ignored."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    resumable = (
        "; run the same command again to resume" if sys.argv[1:2] in (["mosaic"], ["live"]) else ""
    )
    sys.stderr.write(f"skyquilt: interrupted{resumable}\n")
    sys.stderr.flush()


def leave() -> NoReturn:
    """Ends the program with all of its threads at once: Python's normal shutdown could be broken by
    a second Ctrl-C.
    """
    say()
    sys.stdout.flush()
    os._exit(CODE)


@contextmanager
def ends_at_once() -> Iterator[None]:
    """While modules load, Ctrl-C ends the program immediately.

    There is no work yet that must be completed, and some modules swallow every exception while they
    load. The garbage collector is off meanwhile, and afterwards it never scans the loaded modules:
    they are no garbage, and scanning them takes a tenth of the loading time.
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
