"""Free memory between what stays goes back to the system."""

import platform
import subprocess
import sys

import pytest

from skyquilt.engine import free_memory

PROGRAM = """
from pathlib import Path
from skyquilt.engine.free_memory import give_back

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

kept = [bytearray(b"x" * 60_000) for _ in range(4000)]
full = resident()
kept = kept[::2]  # every other one goes: holes everywhere
before = resident()
give_back()
print(full - before, before - resident())
"""


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc",
    reason="only glibc keeps free memory that it must be asked for",
)
def test_holes_are_given_back():
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    )
    alone, asked = map(int, done.stdout.split())
    assert alone < 20e6  # of 120 MB freed, hardly anything went back by itself
    assert asked > 80e6


def test_it_is_looked_for_where_memory_has_grown(monkeypatch):
    """A survey of few photos does not lose time in pages that come and go."""
    resident, asked = [400 << 20], []
    monkeypatch.setattr(free_memory, "resident_bytes", lambda: resident[-1])

    def give_back():
        asked.append(resident[-1] >> 20)
        resident.append(resident[-1] - (30 << 20))

    monkeypatch.setattr(free_memory, "give_back", give_back)
    monkeypatch.setattr(free_memory, "_least", [0])
    for mb in (400, 460, 469, 471, 440, 300, 390, 405, 500):
        resident.append(mb << 20)
        free_memory.give_back_growth()
    # after 400 there were 370, after 471 441, and 300 were the least since; then 375
    assert asked == [400, 471, 405, 500]


def test_a_process_does_not_tell_the_memory_of_the_one_that_started_it():
    inner = "from skyquilt.engine.clock import peak_memory_mb; print(peak_memory_mb())"
    outer = f"""
import subprocess, sys
held = bytearray(500_000_000)
held[::4096] = b"1" * len(held[::4096])
print(subprocess.run([sys.executable, "-c", {inner!r}], capture_output=True, text=True).stdout)
"""
    told = subprocess.run([sys.executable, "-c", outer], capture_output=True, text=True, check=True)
    assert 10 < float(told.stdout) < 300


ONE_POOL = """
import ctypes, sys, threading
from skyquilt.engine.free_memory import keep_one_pool

libc = ctypes.CDLL(None)
libc.fopen.restype = ctypes.c_void_p

def pools():
    file = ctypes.c_void_p(libc.fopen(sys.argv[1].encode(), b"w"))
    libc.malloc_info(0, file)
    libc.fclose(file)
    return open(sys.argv[1]).read().count("<heap ")

if sys.argv[2] == "one":
    keep_one_pool()
thread = threading.Thread(target=lambda: [bytearray(60_000) for _ in range(100)])
thread.start()
thread.join()
print(pools())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries have no pools")
@pytest.mark.parametrize(("asked", "found"), [("one", "1"), ("none", "2")])
def test_threads_share_one_pool(tmp_path, asked, found):
    words = [sys.executable, "-c", ONE_POOL, str(tmp_path / "info.xml"), asked]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == found
