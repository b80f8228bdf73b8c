"""Errors that a user can correct: each says what was found, what was expected, and what to do."""

import sys

PIP = r".venv\Scripts\pip" if sys.platform == "win32" else ".venv/bin/pip"
"""What installs packages beside the program, in the folder of its source."""


class SkyquiltError(Exception):
    """Base of all errors that a user can correct; `exit_code` is the exit code of the command."""

    exit_code = 1


class UsageError(SkyquiltError):
    """The options contradict each other, or name something that does not exist."""

    exit_code = 2


class NoPhotosError(SkyquiltError):
    """There is not one readable photo in the input."""

    exit_code = 3


class AlignmentError(SkyquiltError):
    """The photos cannot be placed by the requested method."""

    exit_code = 4


class OutputError(SkyquiltError):
    """The output cannot be written: it exists already, is read-only, or the disk is full."""

    exit_code = 5


class SideFileError(SkyquiltError):
    """A side file (geo.txt, gcp_list.txt, boundary, cameras.json ...) is malformed or
    names unknown photos.
    """

    exit_code = 6


class RefusedError(SkyquiltError):
    """The job was understood and refused with a reason (no trustworthy registration, say)."""

    exit_code = 7


class PhotoFailedError(SkyquiltError):
    """One photo made a step fail that works for the others; `photo` is its name, and the cause is
    in `__cause__`.

    Whoever runs the step leaves the photo out and repeats it, so a bad photo never stops a run.
    """

    def __init__(self, photo: str, reason: str) -> None:
        super().__init__(f"{photo}: {reason}")
        self.photo, self.reason = photo, reason

    def __reduce__(self) -> tuple[type["PhotoFailedError"], tuple[str, str]]:
        return type(self), (self.photo, self.reason)  # so that it comes back from other processes


class UnreadablePhotoError(SkyquiltError):
    """One file cannot be used; the message finishes the sentence 'X was left out: ...'.

    A bad photo never stops a survey: whoever meets this turns it into a `RejectedPhoto`.
    """
