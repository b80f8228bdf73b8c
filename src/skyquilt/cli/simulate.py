"""`skyquilt simulate`."""


def command() -> None:
    """Not there yet."""
    raise NotImplementedError
