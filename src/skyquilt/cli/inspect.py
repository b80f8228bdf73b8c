"""`skyquilt inspect`."""


def command() -> None:
    """Not there yet."""
    raise NotImplementedError
