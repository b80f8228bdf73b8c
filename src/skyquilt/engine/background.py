"""One piece of work in a process of its own.

The processes of `multiprocessing` begin by importing the program's main script again, so a script
without `if __name__ == "__main__":` would run a second time in each. The process here is started
anew and told what to do; it never sees that script.
"""

import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Generic, TypeVar

T = TypeVar("T")
_ENTRY = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer);"
    f" from {__name__} import serve; serve()"
)
"""What the process runs: it finds modules where the program that started it finds them."""


class Background(Generic[T]):
    """Runs `work(argument)` until it is done, `stop` is called, or this program ends."""

    def __init__(self, work: Callable[[Any], T], argument: Any) -> None:
        """Begins; `work` is a function of a module, and all that is handed over can be pickled."""
        task = pickle.dumps((work, argument))
        command = [sys.executable, "-P", "-c", _ENTRY]  # -P: no module from the working folder
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._outcome: T | None = None
        self._talk = threading.Thread(target=self._exchange, args=(task,), daemon=True)
        self._talk.start()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def busy(self) -> bool:
        """Whether the work goes on."""
        return self._talk.is_alive()

    def outcome(self) -> T | None:
        """What the work returned, after waiting for it; None where its process ended early."""
        self._talk.join()
        return self._outcome

    def stop(self) -> None:
        """Ends the process, whether or not it has finished."""
        self._process.terminate()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._talk.join()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()

    def _exchange(self, task: bytes) -> None:
        """Hands the task over and waits for the outcome, in a thread: the process takes a while to
        begin, and a pipe holds little. The task's pipe stays open, see `_end_with_parent`.
        """
        given, answer = self._process.stdin, self._process.stdout
        assert given is not None
        assert answer is not None
        with suppress(OSError, EOFError, pickle.UnpicklingError):
            given.write(pickle.dumps(list(sys.path)) + task)
            given.flush()
            self._outcome = pickle.load(answer)


def serve() -> None:
    """The process: one task from standard input, its outcome to standard output."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the program that started it
    with suppress(OSError, AttributeError):
        os.nice(10)  # the program that started it comes first
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not get into the outcome
    work, argument = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with answer:
        pickle.dump(work(argument), answer)


def _end_with_parent() -> None:
    """Ends this process when its input ends: the program that holds the other end is gone."""
    os.read(0, 1)
    os._exit(1)
