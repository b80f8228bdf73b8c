"""An output folder for a command that writes all its files at once."""

from collections.abc import Sequence
from pathlib import Path

from skyquilt.errors import OutputError
from skyquilt.run.disk import refusal


def claim(path: Path, names: Sequence[str], *, overwrite: bool) -> None:
    """Makes the folder, or clears the files `names` of a former run from it; other files stay.

    Raises:
        OutputError: it holds files already and `overwrite` is not given, is a file, or cannot be
            written.
    """
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path} is a file; the output is a folder")
    try:
        if path.is_dir() and any(path.iterdir()) and not overwrite:
            raise OutputError(
                f"{path} already holds files; add --overwrite to replace its results, or choose"
                " another folder"
            )
        path.mkdir(parents=True, exist_ok=True)
        for name in names:
            (path / name).unlink(missing_ok=True)
        probe = path / ".probe"
        probe.write_bytes(b"x")
        probe.unlink()
    except OSError as error:
        raise refusal(path, error) from error
