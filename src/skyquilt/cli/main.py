"""Entry point of the command line: errors as sentences, exit codes as documented."""

import errno
import os
import re
import sys
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NoReturn

from skyquilt.cli import interrupt
from skyquilt.errors import OutputError, SkyquiltError, UsageError

REFUSED = {
    errno.ENAMETOOLONG, errno.EINVAL, errno.ELOOP, errno.ENOTDIR, errno.EACCES, errno.EPERM
}  # fmt: skip
"""What a system answers to a name, or to a person, that it does not let in."""
FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
"""What a system answers where what is printed cannot be written."""


def _streams() -> None:
    """Opens closed standard streams on nothing. Otherwise the next file that is opened takes the
    place of one of them, and what a library prints goes into a photo's row or into the map.
    """
    for number, mode in ((0, os.O_RDONLY), (1, os.O_WRONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)  # the lowest number that is free
    if sys.stdout is None:
        sys.stdout = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115


def _checked(words: list[str]) -> None:
    """Refuses what no command can work with.

    Raises:
        UsageError: an empty argument, which would mean the current folder; a current folder that is
            gone.
    """
    for before, word in zip(["", *words], words, strict=False):
        if not word or re.fullmatch("--[a-z-]+=", word):
            after = f" after {before}" if before and not word else ""
            what = f"{word} has no value" if word else f"the argument{after} is empty"
            raise UsageError(f"{what}; perhaps a variable in the command is not set")
    try:
        Path.cwd()
    except OSError as error:
        raise UsageError(
            f"the current folder cannot be used ({error.strerror}); change to another one"
        ) from error


def run() -> None:
    """Entry point; an error that the user can correct is one sentence on standard error and its own
    exit code.

    Wrong options end with 2 (as all usage errors), and so do names that the system refuses; an
    interrupt with 130. A system that gives no more memory is told in a sentence too. Any other
    exception is a bug in the program: its traceback is shown, and the exit code is 1.
    """
    _streams()
    # threads work on different photos; threads within one matrix product would only wait
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # names may hold characters that a terminal cannot show
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        _checked(sys.argv[1:])
        with interrupt.ends_at_once():
            from skyquilt.engine.free_memory import keep_one_pool
            from skyquilt.engine.memory_watch import enough_addresses

            enough_addresses(1)  # before libraries are loaded that crash
            keep_one_pool()  # before they start threads
            from skyquilt.cli.app import app
        try:
            app()
        finally:
            sys.stdout.flush()  # here, where it can still be said that this fails
    except SkyquiltError as error:
        from skyquilt.outside import shown

        sys.stderr.write(f"skyquilt: {shown(error)}\n")
        sys.exit(error.exit_code)
    except OSError as error:
        if error.errno in FULL and error.filename is None:
            _unprinted(error)
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


def _unprinted(error: OSError) -> NoReturn:
    """Says that the system takes no more of what is printed."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for what is printed still
    sys.stderr.write(
        f"skyquilt: what is printed, or a file, cannot be written ({error.strerror}); make room and"
        " run the same command again\n"
    )
    sys.exit(OutputError.exit_code)


def __getattr__(name: str) -> Any:
    """Also provides `app`, imported on first use."""
    if name == "app":
        from skyquilt.cli.app import app

        return app
    raise AttributeError(name)
