"""The command line's way in: errors as sentences, exit codes as documented."""

import os
import sys
from io import TextIOWrapper
from typing import Any

from skyquilt.errors import SkyquiltError

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells know it."""


def run() -> None:
    """Entry point; a mendable error is one sentence on standard error and its own exit code.

    Wrong options end with 2 (as all usage errors), an interrupt with 130. What is left is a mistake of the
    program: its traceback is shown, and the exit code is 1.
    """
    # threads work on photos, not inside one product of matrices: it would only spin
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, TextIOWrapper):  # names may hold what a terminal cannot show
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        from skyquilt.cli.app import app  # importing takes a moment, and Ctrl-C may come then

        app()
    except SkyquiltError as error:
        sys.stderr.write(f"skyquilt: {error}\n")
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        _interrupted()
    except SystemExit as end:
        if end.code != INTERRUPTED:
            raise
        _interrupted()  # typer ends so, without a word


def _interrupted() -> None:
    resumable = "; run the same command again to resume" if sys.argv[1:2] == ["mosaic"] else ""
    sys.stderr.write(f"skyquilt: interrupted{resumable}\n")
    sys.exit(INTERRUPTED)


def __getattr__(name: str) -> Any:
    """`app` too, imported when asked for."""
    if name == "app":
        from skyquilt.cli.app import app

        return app
    raise AttributeError(name)
