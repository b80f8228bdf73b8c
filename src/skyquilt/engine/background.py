"""Runs one task in a separate process.

A process started by `multiprocessing` imports the program's main script again, so a script without
`if __name__ == "__main__":` would run a second time. The process here is a new interpreter that
receives its task through a pipe and never imports that script.
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
"""Code of the new process. It uses the same module search path as the parent process."""


class Background(Generic[T]):
    """Runs `work(argument)` until it is done, `stop` is called, or this program ends."""

    def __init__(self, work: Callable[[Any], T], argument: Any) -> None:
        """Starts the process. `work` must be a function at module level, and its argument and
        result must be picklable.
        """
        task = pickle.dumps((work, argument))
        command = [sys.executable, "-P", "-c", _ENTRY]  # -P: not from the working folder
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # on Windows, as `nice` in `serve`: the parent process has priority
            creationflags=getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0),
        )
        self._outcome: T | None = None
        self._talk = threading.Thread(target=self._exchange, args=(task,), daemon=True)
        self._talk.start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def busy(self) -> bool:
        """Whether the task is still running."""
        return self._talk.is_alive()

    def outcome(self) -> T | None:
        """Waits for the task and returns its result; None if its process ended early."""
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
        """Sends the task and waits for the result. Runs in a thread, since the process takes time
        to start and the buffer of a pipe is small. The pipe of the task stays open, see
        `_end_with_parent`.
        """
        given, answer = self._process.stdin, self._process.stdout
        assert given is not None
        assert answer is not None
        with suppress(OSError, EOFError, pickle.UnpicklingError):
            given.write(pickle.dumps(list(sys.path)) + task)
            given.flush()
            self._outcome = pickle.load(answer)


def serve() -> None:
    """Main function of the process: reads one task from standard input and writes its result to
    standard output.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C is handled by the parent process
    if sys.platform != "win32":
        with suppress(OSError):
            os.nice(10)  # the parent process has priority
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output printed by libraries must not mix with the result
    work, argument = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    done = work(argument)
    with suppress(BrokenPipeError), answer:  # the parent has ended meanwhile
        pickle.dump(done, answer)


def _end_with_parent() -> None:
    """Ends this process when its standard input is closed, which means that the parent process has
    ended.
    """
    os.read(0, 1)
    os._exit(1)
