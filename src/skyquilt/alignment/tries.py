"""What an adjustment is begun with, what it found, and what repairs may ask of a survey."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from skyquilt.alignment.motion import Speeds
from skyquilt.alignment.oblique_start import Beginnings
from skyquilt.model.photo import Zoom
from skyquilt.model.poses import Alignment, Prior


@dataclass(frozen=True, kw_only=True)
class Beginning:
    """What an adjustment is begun with."""

    priors: Sequence[Prior]
    """What files tell of the photos, as far as it is believed."""
    guess: Sequence[Prior] | None = None
    """The same with guessed directions of the cameras."""
    aside: frozenset[int] = frozenset()
    """Photos that are not adjusted, but hung on the others afterwards."""
    sizes: Mapping[str, Zoom] = field(default_factory=dict)
    """Cameras whose pictures differ from others of one lens by their size (`same_lens`)."""
    enlarged: Mapping[int, float] = field(default_factory=dict)
    """Factors of photos that are enlarged against others of their camera."""
    lenses: Mapping[int, int] = field(default_factory=dict)
    """The lens, 0 and up, of photos of cameras that have several."""
    focals: Mapping[str, float] = field(default_factory=dict)
    """Factors of focal lengths that are guessed or not believed, by camera."""
    loose: frozenset[str] = frozenset()
    """Cameras whose shutters and aspect ratios pictures alone tell."""
    cut: frozenset[str] = frozenset()
    """Cameras whose principal points pictures alone tell."""
    stabilised: frozenset[str] = frozenset()
    """Cameras each of whose photos shows another part of what the lens does."""
    in_space: Beginnings | None = None
    """Photos begin where they report to be, as those of an oblique survey do, or else here; None:
    where links of photos that look down put them.
    """
    name: str = ""
    """Tells parts of this adjustment that are kept from those of others."""

    @property
    def told(self) -> Sequence[Prior]:
        """The priors of the adjustment."""
        return self.priors if self.guess is None else self.guess


@dataclass(frozen=True, kw_only=True)
class Tried:
    """An adjustment and its beginning."""

    found: Alignment
    begun: Beginning
    notes: tuple[str, ...] = ()
    """What is said of the repairs that it has."""


@dataclass(frozen=True, kw_only=True)
class Survey:
    """What repairs know of the survey, and may ask."""

    names: Sequence[str]
    """File names of the photos, in order of capture."""
    cameras: Sequence[str]
    """Names of their cameras."""
    speeds: Speeds
    """Velocities of the photos where they are placed."""
    linked: int
    """How many photos have links."""
    adjust: Callable[[Beginning], Alignment]
    """Adjusts the survey."""
    sizes: Callable[[bool], Mapping[str, Zoom]]
    """Cameras whose pictures differ from others by their size alone, as reduced ones, or (true) as
    parts (`lenses_of_sizes`).
    """
    unfit: Callable[[Tried], frozenset[str]]
    """Names of cameras that photos contradict (`unfit_cameras`)."""
    cut: Callable[[Tried], frozenset[str]]
    """Names of those whose photos may have been cut off (`cut_cameras`)."""
    wholes: Callable[[Tried], Mapping[str, float]]
    """Factors of focal lengths that files tell of the pictures before (`whole_focals`)."""
    focals: Callable[[Tried], tuple[Mapping[str, float], bool]]
    """Factors of guessed focal lengths that may be others (`other_focals`)."""
    false_focals: Callable[[Tried], tuple[Mapping[str, float], bool]]
    """The same of focal lengths that files may tell falsely (`unfit_cameras.false_focals`)."""
    beginnings: Callable[[Tried], Beginnings]
    """Where photos begin in space (`oblique_start.beginnings`)."""
    guess: Callable[[Tried], Sequence[Prior] | None]
    """Priors with directions with which matched rays meet clearly better; None without any."""

    def tried(self, begun: Beginning, **changes: Any) -> Tried:
        """The adjustment begun so, with changes."""
        changed = replace(begun, **changes)
        return Tried(found=self.adjust(changed), begun=changed)
