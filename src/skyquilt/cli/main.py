"""The command line's way in: errors as sentences, exit codes as documented."""

import os
import sys
from io import TextIOWrapper
from typing import Any

from skyquilt.cli import interrupt
from skyquilt.errors import SkyquiltError


def run() -> None:
    """Entry point; a mendable error is one sentence on standard error and its own exit code.

    Wrong options end with 2 (as all usage errors), an interrupt with 130. What is left is a mistake
    of the program: its traceback is shown, and the exit code is 1.
    """
    # threads work on photos, not inside one product of matrices: it would only spin
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, TextIOWrapper):  # names may hold what a terminal cannot show
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with interrupt.ends_at_once():
            from skyquilt.cli.app import app
        app()
    except SkyquiltError as error:
        sys.stderr.write(f"skyquilt: {error}\n")
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        interrupt.leave()
    except SystemExit as end:
        if end.code == interrupt.CODE:  # typer ends so, without a word
            interrupt.leave()
        raise


def __getattr__(name: str) -> Any:
    """`app` too, imported when asked for."""
    if name == "app":
        from skyquilt.cli.app import app

        return app
    raise AttributeError(name)
