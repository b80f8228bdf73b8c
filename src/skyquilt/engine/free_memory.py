"""How freed memory returns to the operating system.

The C library keeps the gaps that freed images leave, and fills them badly: after hundreds of photos
the unused gaps are as large as the memory in use.
"""

import ctypes
from contextlib import suppress

_TRIM, _MMAP, _ARENAS = -1, -3, -8
"""Parameters of `mallopt` of glibc: M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX."""
LARGE_BYTES = 32 << 20
"""Blocks of memory that are the system's again as soon as they are freed. With smaller ones, time
is lost in getting pages; glibc's own limit rises to 32 MB with what is freed.
"""


def return_large_blocks() -> None:
    """Asks the C library to return large blocks at once, and to keep few separate pools. Other C
    libraries than glibc do that by themselves.
    """
    with suppress(OSError, AttributeError, TypeError):
        library = ctypes.CDLL(None)
        for parameter, value in (_MMAP, LARGE_BYTES), (_TRIM, 16 * LARGE_BYTES), (_ARENAS, 2):
            library.mallopt(ctypes.c_int(parameter), ctypes.c_int(value))


def give_back() -> None:
    """Asks the C library to return free memory (malloc_trim of glibc). Other C libraries do that by
    themselves.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(ctypes.c_size_t(0))
