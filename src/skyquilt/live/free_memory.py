"""Returns freed memory to the operating system.

A process that runs for hours and allocates and frees images of many sizes fragments its memory:
after about a thousand photos the unused gaps are as large as the memory in use.
"""

import ctypes
from contextlib import suppress


def give_back() -> None:
    """Asks the C library to return free memory (malloc_trim of glibc). Other C libraries do that by
    themselves.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(ctypes.c_size_t(0))
