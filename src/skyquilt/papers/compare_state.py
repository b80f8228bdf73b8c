"""Progress of a comparison, so that the same command continues where it was stopped."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from skyquilt.engine.folder import STATE, make_folder, refusal
from skyquilt.errors import OutputError
from skyquilt.raster.atomic import write_text

FILES = ("compare.json", "report.html")
"""Files of a finished comparison."""


@dataclass(kw_only=True)
class CompareState:
    """State of a comparison before it is finished."""

    key: str
    """Key of its inputs: photos, side files and settings."""
    done: bool = False
    """Whether it is finished."""

    def write(self, output: Path) -> None:
        """Stores it in the comparison's folder."""
        path = output / STATE / "compare.json"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise refusal(output, error) from error
        write_text(path, json.dumps(asdict(self)))


def taken_up(output: Path, key: str, *, overwrite: bool) -> tuple[CompareState, bool]:
    """The state from which to continue, and whether it comes from an earlier, unfinished call.

    Raises:
        OutputError: the folder contains a finished comparison, or one of other photos or settings.
    """
    make_folder(output)
    known = _read(output)
    finished = any((output / name).exists() for name in FILES) and (known is None or known.done)
    if known is not None and known.key == key and not finished:
        return replace(known, done=False), True
    if (finished or known is not None) and not overwrite:
        what = (
            "a comparison" if finished else "a comparison of other photos or settings, unfinished"
        )
        raise OutputError(
            f"{output} already holds {what}; add --overwrite to replace it, or choose another"
            " folder"
        )
    return CompareState(key=key), False


def _read(output: Path) -> CompareState | None:
    """The state of the folder; None if no run has started."""
    if not any(output.glob(f"*/{STATE}/run.json")):
        return None
    try:
        text = (output / STATE / "compare.json").read_text(encoding="utf-8")
        return CompareState(**json.loads(text))
    except (OSError, ValueError, TypeError):
        return None
