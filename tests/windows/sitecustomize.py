"""Makes an interpreter behave to Skyquilt as one on Windows does, as far as Linux can show it.

Python loads this file at its start where its folder is on PYTHONPATH, so every process that a
command starts has it too. Code of the package `skyquilt` finds nothing in the standard library that
Windows lacks; other code goes on as it is. All code gets what Windows answers

- to replacing, moving and deleting a file that any of these processes has open or mapped,
- to opening a folder as a file, to names that it does not take,

and Skyquilt's code may read and write no text without naming its encoding. What was refused is
written, a line each, into the file that SKYQUILT_REFUSED names.
"""

import ast
import builtins
import ctypes
import errno
import importlib.util
import mimetypes
import mmap
import os
import re
import signal
import socket
import stat
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

MARK = "SKYQUILT_REFUSED"
"""The variable by which these processes know one another."""
ABSENT = {
    "crypt", "curses", "fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "spwd",
    "syslog", "termios", "tty",
}  # fmt: skip
"""Modules that Windows lacks."""
RESERVED = re.compile(r"(con|prn|aux|nul|com[1-9]|lpt[1-9])(\..*)?", re.I)
OPEN, DENIED, FORBIDDEN = 32, 5, 123
"""Windows's numbers of errors: a file is open elsewhere; access is denied; no name of a file."""
_busy = threading.local()
_told = os.environ.get(MARK, "")


def ours(depth: int = 2) -> bool:
    """Whether the code that asks is Skyquilt's."""
    name = str(sys._getframe(depth).f_globals.get("__name__", ""))
    return name.split(".")[0] == "skyquilt"


def refuse(number: int, path: str) -> None:
    """Raises what Windows answers, and notes it."""
    kinds = {
        OPEN: (errno.EACCES, "The process cannot access the file because it is being used"),
        DENIED: (errno.EACCES, "Access is denied"),
        FORBIDDEN: (errno.EINVAL, "The filename, directory name, or volume label is incorrect"),
    }
    error = OSError(*kinds[number], path)
    error.winerror = number  # type: ignore[attr-defined]
    with suppress(OSError), open(_told, "a", encoding="utf-8", errors="backslashreplace") as notes:
        notes.write(f"{number} {path}\n")
    raise error


# ---- what there is in modules


def names(module: str, platform: str) -> set[str]:
    """The names that mypy's library of types gives to a module on a platform."""
    types = Path(str(importlib.util.find_spec("mypy").origin)).parent / "typeshed" / "stdlib"
    places = [types / f"{module}.pyi", types / module / "__init__.pyi"]
    text = next(p for p in places if p.exists()).read_text("utf-8")
    system = SimpleNamespace(platform=platform, version_info=sys.version_info)

    def holds(test: ast.expr) -> bool:
        code = compile(ast.Expression(test), module, "eval")
        return bool(eval(code, {"sys": system, "TYPE_CHECKING": False}))

    def within(body: list[ast.stmt]) -> Iterator[str]:
        for part in body:
            if isinstance(part, ast.If):
                yield from within(part.body if holds(part.test) else part.orelse)
            elif isinstance(part, ast.FunctionDef | ast.ClassDef):
                yield part.name
            elif isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                yield part.target.id
            elif isinstance(part, ast.Assign):
                yield from (t.id for t in part.targets if isinstance(t, ast.Name))
            elif isinstance(part, ast.ImportFrom):
                yield from (a.asname or a.name for a in part.names)

    return set(within(ast.parse(text).body))


def otherwise(module: ModuleType, **changed: Any) -> None:
    """Hides from Skyquilt what a module lacks on Windows; `changed` is otherwise there."""
    name = module.__name__
    lacking = names(name, "linux") - names(name, "win32") if name != "sys" else set()

    class Windows(ModuleType):
        def __getattribute__(self, asked: str) -> Any:
            if (asked in lacking or asked in changed) and ours():
                if asked in lacking:
                    raise AttributeError(f"module {name!r} has no attribute {asked!r}")
                return changed[asked]
            return ModuleType.__getattribute__(self, asked)

    module.__class__ = Windows


def library(name: Any, *rest: Any, **more: Any) -> Any:
    """`ctypes.CDLL`: Windows has no library of the whole program."""
    if name is None:
        raise TypeError("bad argument type for built-in operation")
    return ctypes.CDLL(name, *rest, **more)


def kill(process: int, number: int) -> None:
    """On Windows it ends the process, whatever the number; nobody of ours asks for that."""
    raise AssertionError(f"os.kill({process}, {number}) ends a process on Windows")


def locking(handle: int, mode: int, size: int) -> None:
    """`msvcrt.locking`, by the locks of this system."""
    import fcntl

    kind = fcntl.LOCK_UN if mode == 0 else fcntl.LOCK_EX | fcntl.LOCK_NB
    try:
        fcntl.lockf(handle, kind, size, os.lseek(handle, 0, os.SEEK_CUR))
    except BlockingIOError as error:
        raise PermissionError(errno.EACCES, "Permission denied") from error


def stand_in() -> ModuleType:
    """The module `msvcrt`."""
    module = ModuleType("msvcrt")
    module.__dict__.update(locking=locking, LK_UNLCK=0, LK_LOCK=1, LK_NBLCK=2)
    return module


_import, _msvcrt = builtins.__import__, stand_in()


def imported(name: str, given: Any = None, *rest: Any, **more: Any) -> Any:
    """`import`, as it is on Windows for Skyquilt."""
    if given and str(given.get("__name__", "")).split(".")[0] == "skyquilt":
        if name in ABSENT:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if name == "msvcrt":
            return _msvcrt
    return _import(name, given, *rest, **more)


# ---- files


def processes() -> list[str]:
    """Numbers of the processes that behave like this one."""
    found = []
    for number in os.listdir("/proc"):
        with suppress(OSError):
            if (
                number.isdigit()
                and f"{MARK}=".encode() in Path(f"/proc/{number}/environ").read_bytes()
            ):
                found.append(number)
    return found


def held(path: str) -> bool:
    """Whether one of the processes has a file, or one in a folder, open or mapped."""
    try:
        file = os.lstat(path)
    except OSError:
        return False
    folder = os.path.realpath(path) + "/" if stat.S_ISDIR(file.st_mode) else None
    for number in processes():
        with suppress(OSError):
            for handle in os.listdir(f"/proc/{number}/fd"):
                with suppress(OSError):
                    at = f"/proc/{number}/fd/{handle}"
                    if folder and os.readlink(at).startswith(folder):
                        return True
                    other = os.stat(at)
                    if (other.st_dev, other.st_ino) == (file.st_dev, file.st_ino):
                        return True
            maps = Path(f"/proc/{number}/maps").read_text("utf-8", "replace")
            if re.search(rf" {file.st_ino} +/", maps) or (folder and f" {folder}" in maps):
                return True
    return False


def named(path: Any) -> str:
    """A path as text; empty where it is none of a file that counts."""
    if isinstance(path, int) or path is None:
        return ""
    text = os.path.abspath(os.fsdecode(path))
    return "" if text.startswith(("/proc/", "/sys/", "/dev/")) else text


def checked(path: str) -> None:
    """Refuses a name that Windows does not take."""
    for part in Path(path).parts[1:]:
        if re.search(r'[<>:"|?*\x00-\x1f]', part) or part[-1] in ". " or RESERVED.fullmatch(part):
            refuse(FORBIDDEN, path)


def within(path: Any, folder: int) -> str:
    """A path that may be relative to a folder's handle."""
    if isinstance(folder, int) and folder >= 0 and path is not None:
        return named(os.path.join(os.readlink(f"/proc/self/fd/{folder}"), os.fsdecode(path)))
    return named(path)


def look(event: str, given: tuple[Any, ...]) -> None:
    """Hears what Python asks the system for, before it does."""
    if event == "open":
        path, _, flags = given
        text = named(path)
        if text and flags & os.O_CREAT:
            checked(text)
        if text and os.path.isdir(text) and ours(3):
            refuse(DENIED, text)
        if text and flags & os.O_TRUNC and os.path.exists(text) and mapped(text):
            refuse(OPEN, text)
    elif event == "os.mkdir":
        checked(within(given[0], given[2]) or "/")
    elif event in ("os.remove", "os.rmdir"):
        text = within(given[0], given[1])
        if text and held(text) and not temporary():
            refuse(OPEN, text)
    elif event == "os.rename":
        old, new = within(given[0], given[2]), within(given[1], given[3])
        checked(new)
        if held(old):
            refuse(OPEN, old)
        if held(new) or os.path.isdir(new):
            refuse(DENIED, new)


def mapped(path: str) -> bool:
    """Whether one of the processes has mapped a file."""
    number = os.stat(path).st_ino
    return any(
        re.search(rf" {number} +/", Path(f"/proc/{p}/maps").read_text("utf-8", "replace"))
        for p in processes()
    )


def temporary() -> bool:
    """Whether `tempfile` deletes a file while it is open: on Windows the system does it later."""
    frame: Any = sys._getframe(3)
    return frame is not None and frame.f_globals.get("__name__") == "tempfile"


def hook(event: str, given: tuple[Any, ...]) -> None:
    """`look`, not at what it asks for itself."""
    if not event.startswith(("open", "os.")) or getattr(_busy, "now", False):
        return
    _busy.now = True
    try:
        look(event, given)
    finally:
        _busy.now = False


if _told:
    otherwise(os, name="nt", kill=kill)
    otherwise(sys, platform="win32")
    otherwise(ctypes, CDLL=library)
    otherwise(socket, SO_EXCLUSIVEADDRUSE=socket.SO_REUSEADDR)
    for other in (signal, mmap):
        otherwise(other)
    builtins.__import__ = imported
    warnings.filterwarnings("ignore", category=EncodingWarning)
    warnings.filterwarnings("error", category=EncodingWarning, module=r"skyquilt\b")
    mimetypes.add_type("text/plain", ".js")  # as some programs write into the registry
    sys.addaudithook(hook)
