"""Memory that was freed, given back to the system.

A process that lives for hours and makes and drops pictures of all sizes keeps holes between those
that stay: on the scale of a thousand photos, as much again as it holds.
"""

import ctypes
from contextlib import suppress


def give_back() -> None:
    """Asks the C library to return what it has free (glibc's malloc_trim); other libraries do that
    by themselves.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(ctypes.c_size_t(0))
