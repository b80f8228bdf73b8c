"""Watches the resident memory of a process, and ends it with a sentence before the system kills it;
limits of the system on addresses and open files that are too low.

The limit is on resident memory: mapped files and the allocator's arenas make the address space far
larger than the memory in use, so a limit on addresses would end healthy runs.
"""

import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from skyquilt.errors import SkyquiltError
from skyquilt.settings import within

CHECK_S = 0.25
"""Time in s between checks."""
SHARE = 0.9
"""Share of the machine's memory, or of that of its container, that a run may take by default."""
EXIT_CODE = 1
MEMORY_GB = (0.1, 1e6)
"""Least and largest limit that can be asked for, in GB."""
ADDRESSES_MB, THREAD_MB = 800, 100
"""Addresses in MB that the libraries of a run need, and those of each of its threads. With fewer
OpenBLAS ends the process by a fault of memory. Surveys of some photos of 0.3 MP were mapped with
900, 1000 and 1100 MB by one, two and four threads, and crashed with 700, 800 and 1000.
"""
OPEN_FILES, MOST_FILES = 32, 8192
"""Open files that a live map needs at least, with its databases and photos, and a limit with which
thousands of connections are held. Of two photos a map grew with 28, and none with 24.
"""
_CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def resident_bytes() -> int:
    """Resident memory of this process; 0 on systems that do not report it."""
    if sys.platform == "linux":
        with suppress(OSError, ValueError, IndexError):
            pages = int(Path("/proc/self/statm").read_text("ascii").split()[1])
            return pages * os.sysconf("SC_PAGE_SIZE")
    return 0


def machine_bytes() -> int:
    """Memory of the machine, or of the container in which this process runs; 0 where it is not
    known.
    """
    found = list[int]()
    if sys.platform != "win32":
        with suppress(OSError, ValueError):
            found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for name in _CGROUPS:
        with suppress(OSError, ValueError):
            found.append(int(Path(name).read_text("ascii")))
    return min(found, default=0)


def limit_bytes(asked_gb: float | None) -> int:
    """The limit in bytes: as asked, or a share of the machine's memory; 0 = none.

    Raises:
        UsageError: no machine has what is asked, or no run can do with it.
    """
    within("--max-memory", asked_gb, *MEMORY_GB, "GB")
    return int(asked_gb * 1e9) if asked_gb is not None else int(SHARE * machine_bytes())


def enough_addresses(threads: int) -> None:
    """Checks the limit of addresses (`ulimit -v`), if there is one.

    Raises:
        SkyquiltError: it is too low for so many threads.
    """
    if sys.platform == "win32":  # there is no such limit
        return
    import resource

    most, needed = resource.getrlimit(resource.RLIMIT_AS)[0], ADDRESSES_MB + THREAD_MB * threads
    if most != resource.RLIM_INFINITY and most < needed * 1e6:
        fewer = ", or use fewer threads (--jobs)" if threads > 1 else ""
        raise SkyquiltError(
            f"the system allows {most / 1e6:.0f} MB of addresses, and {needed} MB are needed at"
            f" least; raise the limit (ulimit -v){fewer}"
        )


def enough_files(needed: int = 0) -> None:
    """Lets this process open as many files as the system allows, up to `MOST_FILES`.

    Raises:
        SkyquiltError: fewer than are needed.
    """
    if sys.platform == "win32":  # it sets no such limit
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    most = MOST_FILES if hard == unlimited else min(hard, MOST_FILES)
    if soft != unlimited and soft < most:
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
            soft = most
    if soft != unlimited and soft < needed:
        raise SkyquiltError(
            f"the system allows {soft} open files, and {needed} are needed at least; raise the"
            " limit (ulimit -n)"
        )


@dataclass(kw_only=True)
class MemoryWatch:
    """Checks the memory in a thread. As a context manager it stops at the end of its block."""

    limit: int
    """Largest resident memory in bytes; 0 = no limit."""
    end: Callable[[int], None]
    """Called once, in the thread, with the resident memory in bytes, when the limit is exceeded."""
    _stop: threading.Event = field(default_factory=threading.Event)

    def __enter__(self) -> "MemoryWatch":
        if self.limit > 0 and resident_bytes() > 0:
            threading.Thread(target=self._run, daemon=True, name="memory").start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()

    def _run(self) -> None:
        while not self._stop.wait(CHECK_S):
            if (taken := resident_bytes()) > self.limit:
                self.end(taken)
                return


def ends_run(limit: int, advice: str) -> MemoryWatch:
    """A watch that ends the program with one sentence. Nothing that was stored is lost: a run can
    be ended at any moment.
    """

    def end(taken: int) -> None:
        sys.stderr.write(
            f"skyquilt: it needs more memory than it may take ({taken / 1e9:.1f} of"
            f" {limit / 1e9:.1f} GB) and was ended; {advice}\n"
        )
        sys.stderr.flush()
        os._exit(EXIT_CODE)

    return MemoryWatch(limit=limit, end=end)
