"""How a bad file leaves this stage."""

from skyquilt.errors import SkyquiltError


class UnreadablePhoto(SkyquiltError):
    """A file that cannot be used; the message finishes the sentence 'X was left out: ...'.

    `read_survey` turns it into a `RejectedPhoto`; whoever decodes pixels later does the same.
    """
