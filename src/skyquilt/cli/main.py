"""Entry point of the command line: errors as sentences, exit codes as documented."""

import errno
import os
import sys
from io import TextIOWrapper
from typing import Any

from skyquilt.cli import interrupt
from skyquilt.errors import SkyquiltError, UsageError

REFUSED = {
    errno.ENAMETOOLONG, errno.EINVAL, errno.ELOOP, errno.ENOTDIR, errno.EACCES, errno.EPERM
}  # fmt: skip
"""What a system answers to a name, or to a person, that it does not let in."""


def run() -> None:
    """Entry point; an error that the user can correct is one sentence on standard error and its own
    exit code.

    Wrong options end with 2 (as all usage errors), and so do names that the system refuses; an
    interrupt with 130. A system that gives no more memory is told in a sentence too. Any other
    exception is a bug in the program: its traceback is shown, and the exit code is 1.
    """
    # threads work on different photos; threads within one matrix product would only wait
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # names may hold characters that a terminal cannot show
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        with interrupt.ends_at_once():
            from skyquilt.cli.app import app
        app()
    except SkyquiltError as error:
        from skyquilt.outside import shown

        sys.stderr.write(f"skyquilt: {shown(error)}\n")
        sys.exit(error.exit_code)
    except OSError as error:
        if error.errno not in REFUSED or error.filename is None:
            raise
        from skyquilt.outside import plain

        name = plain(os.fsdecode(error.filename), 200)
        sys.stderr.write(f"skyquilt: {name} cannot be used: {error.strerror}\n")
        sys.exit(UsageError.exit_code)
    except KeyboardInterrupt:
        interrupt.leave()
    except Exception as error:
        from skyquilt.outside import out_of_memory, shown

        if not out_of_memory(error):
            raise
        why = f" ({shown(error, 300)})" if str(error) else ""
        sys.stderr.write(
            f"skyquilt: the system gives no more memory{why}; close other programs, or allow the"
            " program more, and run the same command again\n"
        )
        sys.exit(SkyquiltError.exit_code)
    except SystemExit as end:
        if end.code == interrupt.CODE:  # typer ends like this, without a message
            interrupt.leave()
        raise


def __getattr__(name: str) -> Any:
    """Also provides `app`, imported on first use."""
    if name == "app":
        from skyquilt.cli.app import app

        return app
    raise AttributeError(name)
