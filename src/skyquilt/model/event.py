"""Events that a workflow yields while it runs. Progress bars, logs, viewers and tests read the same
events.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skyquilt import registry


@dataclass(frozen=True, kw_only=True)
class StageStarted:
    """A stage starts."""

    stage: str
    """Its name."""
    total: int
    """Steps it will take; 0 where unknown."""


@dataclass(frozen=True, kw_only=True)
class StageProgress:
    """A stage reports progress."""

    stage: str
    """Its name."""
    done: int
    """Steps done."""
    total: int
    """Steps in all; it may grow."""
    what: str = ""
    """What is done now, where a step takes long."""


@dataclass(frozen=True, kw_only=True)
class StageFinished:
    """A stage has ended."""

    stage: str
    """Its name."""
    seconds: float
    """Wall-clock time in s."""
    cpu_seconds: float
    """CPU time of the process in s."""
    reused: bool
    """True when everything came from the store."""


@dataclass(frozen=True, kw_only=True)
class Note:
    """A message for the user."""

    text: str
    """A plain sentence."""
    warning: bool = False
    """True when the user should act on it or check the result."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """The end of a run."""

    output: Path
    """The run's folder."""
    metrics: Mapping[str, Any]
    """The content of metrics.json."""

    def facts(self) -> dict[str, str]:
        """What matters of it, by name."""
        m = self.metrics
        told = {"folder": str(self.output)}
        if "photos_used" in m:
            told["photos"] = f"{m['photos_used']} of {m.get('photos_total')}"
        if m.get("gsd_m"):
            told["pixel"] = f"{100 * m['gsd_m']:.3g} cm"
        if "crs" in m:
            told["crs"] = str(m["crs"] or "not georeferenced")
        if (seams := m.get("seam_disparity_px")) and seams.get("median") is not None:
            told["seams"] = f"{seams['median']} px"
        return told

    def __repr__(self) -> str:
        return f"Result({', '.join(f'{k}: {v}' for k, v in self.facts().items())})"

    def _repr_html_(self) -> str:
        return str(registry.load("notebook", "result")(self))


Event = StageStarted | StageProgress | StageFinished | Note | Result


@dataclass(frozen=True, kw_only=True)
class MetadataConflict:
    """A photo whose metadata contradict its image observations."""

    photo: str
    """Photo.name."""
    field: str
    """`yaw`, `altitude`, `position`, `focal`, `lens`, `principal_point`, or `calibration`, one that
    no lens can have.
    """
    reported: float | None
    """Value in the metadata: degrees, m above the datum, m off, px; None of a `calibration`."""
    estimated: float
    """Value estimated from all photos, same unit; the focal length for a `calibration`."""
    meaning: str
    """A plain sentence."""
