"""What a run begins with: photos' metadata, side files, control points, known distances."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from skyquilt.alignment.priors import choose_frame
from skyquilt.errors import UsageError
from skyquilt.model.photo import ControlPoint, KnownDistance, Survey
from skyquilt.photos.distances import read_distances
from skyquilt.photos.gcp import read_gcp_list
from skyquilt.photos.sequence import sequence_of
from skyquilt.photos.survey import read_survey
from skyquilt.settings import InputSettings, MosaicSettings

Source = Path | Sequence[Path]
"""A folder of photos, or photos."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurveyInput:
    """A survey as it was handed in; nothing is decoded yet."""

    source: Source
    """Where it was read from."""
    survey: Survey
    """Photos with their metadata, refused files, notes."""
    control: tuple[ControlPoint, ...]
    """Control and check points."""
    distances: tuple[KnownDistance, ...]
    """Distances to judge the map by."""
    rank: dict[str, int]
    """Place of a photo, by its name, in the sequence in which photos are joined."""

    @property
    def title(self) -> str:
        """The folder, or how many files."""
        return str(self.source) if isinstance(self.source, Path) else f"{len(self.source)} files"


def read_input(source: Source | str, settings: InputSettings) -> SurveyInput:
    """Reads metadata and side files; a gcp_list.txt beside the photos is used without being named.

    Raises:
        UsageError, NoPhotosError, SideFileError: there is nothing to read, or it is malformed.
    """
    source = Path(source) if isinstance(source, str) else source
    survey = read_survey(
        source, geo=settings.geo, cameras=settings.cameras, thermal_unit=settings.thermal_unit
    )
    names = [p.name for p in survey.photos]
    gcp = settings.gcp
    if gcp is None and isinstance(source, Path) and (source / "gcp_list.txt").is_file():
        gcp = source / "gcp_list.txt"
    control: tuple[ControlPoint, ...] = ()
    if gcp is not None:
        control, notes = read_gcp_list(gcp, names)
        survey = replace(survey, notes=(*survey.notes, *notes))
    given = settings.distances
    return SurveyInput(
        source=source,
        survey=survey,
        control=control,
        distances=() if given is None else read_distances(given, names, control),
        rank={names[i]: k for k, i in enumerate(sequence_of(names, settings.sequence))},
    )


def check_input(given: SurveyInput, output: Path, settings: MosaicSettings) -> None:
    """Whether options and output fit the survey, before anything is computed or replaced.

    Raises:
        UsageError, SideFileError: they do not.
    """
    source = given.source
    if isinstance(source, Path) and source.is_dir() and source.resolve() == output.resolve():
        raise UsageError(
            f"{output} holds the photos; choose another folder for the results, such as"
            f" {output / 'map'}"
        )
    frame = choose_frame(given.survey.photos, settings.picture.crs, given.control)
    if settings.picture.boundary is not None:
        if frame.crs is None:
            raise UsageError(
                "--boundary needs a georeferenced survey, and these photos have no positions;"
                " add --geo or --gcp"
            )
        from skyquilt.raster.boundary import read_boundary

        read_boundary(settings.picture.boundary, frame.crs)
