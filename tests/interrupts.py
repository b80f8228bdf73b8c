"""Commands in processes of their own that are to be interrupted."""

import signal


def hears_interrupts() -> None:
    """A shell's background jobs ignore Ctrl-C, and their children inherit that: not what is tested
    here.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
