"""How freed memory returns to the operating system.

The C library keeps the gaps that freed images leave, and fills them badly: after hundreds of photos
the unused gaps are as large as the memory in use.
"""

import ctypes
from contextlib import suppress

from skyquilt.engine.memory_watch import resident_bytes

_TRIM, _MMAP, _ARENAS = -1, -3, -8
"""Parameters of `mallopt` of glibc: M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX."""
LARGE_BYTES = 32 << 20
"""Blocks of memory that are the system's again as soon as they are freed. With smaller ones, time
is lost in getting pages; glibc's own limit rises to 32 MB with what is freed.
"""

GROWN_BYTES = 100 << 20
"""Growth of resident memory from which gaps in it are looked for: pages that are given back are
asked for again, and of a survey of few photos that took as long as a fifteenth of all.
"""
_least = [0]
"""Least resident memory, in bytes, since it was last given back."""


def return_large_blocks() -> None:
    """Asks the C library to return large blocks at once, and to keep one pool. Other C libraries
    than glibc do that by themselves.
    """
    keep_one_pool()
    _ask((_MMAP, LARGE_BYTES), (_TRIM, 16 * LARGE_BYTES))


def keep_one_pool() -> None:
    """Asks the C library for one pool of memory for all threads: what one thread freed serves the
    others. Without effect once there is another thread.
    """
    _ask((_ARENAS, 1))


def _ask(*wanted: tuple[int, int]) -> None:
    with suppress(OSError, AttributeError, TypeError):
        library = ctypes.CDLL(None)
        for parameter, value in wanted:
            library.mallopt(ctypes.c_int(parameter), ctypes.c_int(value))


def give_back() -> None:
    """Asks the C library to return free memory (malloc_trim of glibc). Other C libraries do that by
    themselves.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(ctypes.c_size_t(0))


def give_back_growth() -> None:
    """`give_back`, provided that resident memory has grown clearly since it was least."""
    now = resident_bytes()
    if now - _least[0] > GROWN_BYTES:
        give_back()
        now = _least[0] = resident_bytes()
    _least[0] = min(_least[0], now)
