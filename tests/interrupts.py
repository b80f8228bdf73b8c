"""Commands in processes of their own that are to be interrupted."""

import os
import signal
import time
from pathlib import Path


def hears_interrupts() -> None:
    """A shell's background jobs ignore Ctrl-C, and their children inherit that: not what is tested
    here.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def worked(pid: int, seconds: float) -> None:
    """Waits until a process has used so much processor time: on a busy machine it is then as far as
    on an idle one. Where the system does not tell, it waits that long.
    """
    stat, began = Path(f"/proc/{pid}/stat"), time.monotonic()
    while time.monotonic() - began < (60 if stat.exists() else seconds):
        if stat.exists():
            user, system = stat.read_text().rpartition(")")[2].split()[11:13]
            if (int(user) + int(system)) / os.sysconf("SC_CLK_TCK") >= seconds:
                return
        time.sleep(0.005)
