"""How far a comparison is, so that the same command goes on where it was stopped."""

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from skyquilt.errors import OutputError
from skyquilt.raster.atomic import write_text
from skyquilt.run.disk import refusal
from skyquilt.run.folder import STATE

FILES = ("compare.json", "report.html")
"""Files of a finished comparison."""


@dataclass(kw_only=True)
class CompareState:
    """What is known about a comparison before it is finished."""

    key: str
    """What it is made from: photos, side files and settings."""
    done: bool = False
    """Whether it is finished."""
    judged_by: str = ""
    """Where the distances come from, if they were found by the bundle adjustment."""
    times: dict[str, dict[str, float]] = field(default_factory=dict)
    """`seconds` and `cpu_seconds` of the bundle run before those distances were known."""

    def write(self, output: Path) -> None:
        """Keeps it in the comparison's folder."""
        path = output / STATE / "compare.json"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise refusal(output, error) from error
        write_text(path, json.dumps(asdict(self)))


def taken_up(output: Path, key: str, *, overwrite: bool) -> tuple[CompareState, bool]:
    """The state to go on from, and whether it is that of an earlier, unfinished call.

    Raises:
        OutputError: the folder holds a finished comparison, or one of other photos or settings.
    """
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output} is a file; the output is a folder")
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
    """The state of the folder; None where no method's run has begun."""
    if not any(output.glob(f"*/{STATE}/run.json")):
        return None
    try:
        text = (output / STATE / "compare.json").read_text(encoding="utf-8")
        return CompareState(**json.loads(text))
    except (OSError, ValueError, TypeError):
        return None
