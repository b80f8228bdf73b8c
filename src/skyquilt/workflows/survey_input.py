"""Input of a run: metadata of photos, side files, control points, known distances."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from skyquilt.alignment.priors import choose_frame
from skyquilt.effects import option_of, taken
from skyquilt.errors import PhotoFailedError, SkyquiltError, UsageError
from skyquilt.model.clip import ChosenFrames
from skyquilt.model.photo import (
    ControlPoint,
    KnownDistance,
    Photo,
    PointObservation,
    RejectedPhoto,
    Survey,
)
from skyquilt.model.poses import MapFrame
from skyquilt.ortho.orthomosaic import not_jpeg
from skyquilt.outside import same_folder
from skyquilt.photos.capture import stated_shutter
from skyquilt.photos.detector_faults import Repair
from skyquilt.photos.distances import read_distances
from skyquilt.photos.gcp import check_control, read_gcp_list
from skyquilt.photos.left_out import of_one_band
from skyquilt.photos.lever_arm import with_lever_arm
from skyquilt.photos.pixels import lost, read_color
from skyquilt.photos.read import ReadPhoto, read_photo
from skyquilt.photos.sequence import sequence_of
from skyquilt.photos.survey import read_survey
from skyquilt.photos.track_positions import is_track
from skyquilt.settings import DEFAULTS, InputSettings, MosaicSettings

Source = Path | Sequence[Path]
"""A folder of photos and clips, or such files."""
TIFFS = (".tif", ".tiff")


@dataclass(frozen=True, kw_only=True, eq=False)
class SurveyInput:
    """The input data of a survey; photos are not decoded yet."""

    source: Source
    """The folder or files from which it was read."""
    survey: Survey
    """Photos with their metadata, refused files, notes."""
    control: tuple[ControlPoint, ...]
    """Control and check points."""
    distances: tuple[KnownDistance, ...]
    """Known distances, to check the map."""
    rank: dict[str, int]
    """Position of each photo, by name, in the order in which photos are joined."""
    clips: tuple[ChosenFrames, ...] = ()
    """How frames were chosen from clips."""

    @property
    def title(self) -> str:
        """The name of the folder, or the number of files."""
        if isinstance(self.source, Path):
            return str(self.source)
        folders = all(Path(p).is_dir() for p in self.source)
        return f"{len(self.source)} {'folders' if folders else 'files'}"

    def order_of(self, photos: Sequence[Photo]) -> list[int]:
        """The photos (indices) in the order in which they are joined, without those that are not
        to be.
        """
        ranked = ((self.rank[p.name], i) for i, p in enumerate(photos) if p.name in self.rank)
        return [i for _, i in sorted(ranked)]

    def control_file(self, asked: Path | None) -> Path | None:
        """The file of control points that is asked for, else the only gcp_list.txt in a folder of
        photos or among files that are given.
        """
        if asked is not None:
            return asked
        given = [self.source] if isinstance(self.source, Path) else [Path(p) for p in self.source]
        found = [p for p in given if p.name == "gcp_list.txt" and p.is_file()]
        found += [p / "gcp_list.txt" for p in given if (p / "gcp_list.txt").is_file()]
        return found[0] if len(found) == 1 else None

    def gone(self) -> tuple[RejectedPhoto, ...]:
        """Photos whose files are no longer the ones that were read."""
        return tuple(
            RejectedPhoto(name=p.name, reason=reason)
            for p in self.survey.photos
            if (reason := lost(p))
        )

    def failing(
        self, error: PhotoFailedError, gone: Sequence[RejectedPhoto], total: int
    ) -> tuple[RejectedPhoto, ...]:
        """Photos that cannot be used any more: first the one on which a step failed, then those
        that are `gone`.

        Raises:
            SkyquiltError: they are more than half of `total`, the photos at the start, so it is not
                the photos that are bad.
        """
        failed = {error.photo: error.reason} | {p.name: p.reason for p in gone}
        left = len(self.survey.photos) - len(failed)
        if 2 * left < total:
            name, reason = next(iter(failed.items()))
            raise SkyquiltError(
                f"{total - left} of {total} photos cannot be used any more, first {name}: {reason};"
                " check their disk and run the same command again to resume"
            )
        return tuple(RejectedPhoto(name=n, reason=r) for n, r in failed.items())

    def without(self, bad: Sequence[RejectedPhoto]) -> "SurveyInput":
        """The survey without some of its photos, which become rejected ones."""
        names = {p.name for p in bad}

        def kept(points: Sequence[PointObservation]) -> tuple[PointObservation, ...]:
            return tuple(o for o in points if o.photo not in names)

        survey = replace(
            self.survey,
            photos=tuple(p for p in self.survey.photos if p.name not in names),
            rejected=(*self.survey.rejected, *bad),
        )
        control = [replace(c, observations=kept(c.observations)) for c in self.control]
        distances = [
            replace(d, observations_a=kept(d.observations_a), observations_b=kept(d.observations_b))
            for d in self.distances
        ]
        return replace(
            self,
            survey=survey,
            control=tuple(c for c in control if c.observations),
            distances=tuple(d for d in distances if d.observations_a and d.observations_b),
            rank={name: k for name, k in self.rank.items() if name not in names},
        )


def read_input(
    source: Source | str, settings: InputSettings, read: ReadPhoto = read_photo
) -> SurveyInput:
    """Reads metadata and side files; a gcp_list.txt beside the photos is used automatically.
    `read` reads a file.

    Raises:
        UsageError, NoPhotosError, SideFileError: there is nothing to read, or it is malformed.
    """
    source = Path(source) if isinstance(source, str) else source
    _check_named(settings)
    survey = read_survey(
        source,
        geo=settings.geo,
        cameras=settings.cameras,
        thermal_unit=settings.thermal_unit,
        max_mp=settings.max_mp,
        clock_offset=settings.clock_offset,
        clips=True,
        read=read,
    )
    survey = of_one_band(survey, settings.band)
    if any(p.unit for p in survey.photos):
        photos, faults = Repair()(survey.photos, read_color)
        survey = replace(survey, photos=photos, notes=(*survey.notes, *faults))
    shutter = stated_shutter(settings.shutter, settings.shutter_readout_ms)
    if shutter is not None:
        survey = replace(
            survey,
            photos=tuple(replace(p, shutter=shutter) for p in survey.photos),
            clips=tuple(replace(c, shutter=shutter) for c in survey.clips),
        )
    given = SurveyInput(source=source, survey=survey, control=(), distances=(), rank={})
    return given if survey.clips else completed(given, settings)


def _check_named(settings: InputSettings) -> None:
    """Refuses options that name a file which is not there, before anything is read.

    Raises:
        UsageError: one does.
    """
    for option in ("gcp", "geo", "cameras", "distances"):
        _check_exists(option, getattr(settings, option))


def _check_exists(option: str, path: Path | None) -> None:
    if path is not None and not path.exists():
        raise UsageError(f"--{option} {path} does not exist; check the path")


def completed(given: SurveyInput, settings: InputSettings) -> SurveyInput:
    """The input with all that names photos, once all photos are known.

    Raises:
        SideFileError: a side file is malformed.
    """
    survey = given.survey
    if settings.lever_arm is not None:
        photos, notes = with_lever_arm(survey.photos, settings.lever_arm)
        survey = replace(survey, photos=photos, notes=(*survey.notes, *notes))
    names = [p.name for p in survey.photos]
    gcp = given.control_file(settings.gcp)
    control: tuple[ControlPoint, ...] = ()
    if gcp is not None:
        others = [p.name for p in survey.other_bands]
        control, notes = read_gcp_list(gcp, names, others)
        check_control(gcp, control, survey.photos)
        survey = replace(survey, notes=(*survey.notes, *notes))
    known = settings.distances
    return replace(
        given,
        survey=survey,
        control=control,
        distances=() if known is None else read_distances(known, names, control),
        rank={names[i]: k for k, i in enumerate(sequence_of(names, settings.sequence))},
    )


def frame_of(
    photos: Sequence[Photo], control: Sequence[ControlPoint], settings: MosaicSettings
) -> MapFrame:
    """The map frame of photos by the settings.

    Raises:
        UsageError: the CRS or the height datum asked for cannot be had.
    """
    picture = settings.picture
    level = not taken(settings.method, "vertical_datum")
    return choose_frame(photos, picture.crs, control, picture.vertical_datum, level)


def check_input(given: SurveyInput, output: Path, settings: MosaicSettings) -> SurveyInput:
    """Checks that options and output folder suit the survey, before anything is computed or
    replaced. The survey has notes on options that have no effect on its photos.

    Raises:
        UsageError, SideFileError: they do not.
    """
    source = given.source
    if isinstance(source, Path) and source.is_dir() and same_folder(source, output):
        raise UsageError(
            f"{output} contains the photos; choose another folder for the results, such as"
            f" {output / 'map'}"
        )
    # frames of clips, and what they report, are not known yet
    early = settings.changed(vertical_datum=None) if given.survey.clips else settings
    frame = frame_of(given.survey.photos, given.control, early)
    _check_exists("boundary", settings.picture.boundary)
    if settings.picture.boundary is not None and not given.survey.clips:
        if frame.crs is None:
            raise UsageError(
                "--boundary needs a georeferenced survey, and these photos have no positions;"
                " add --geo or --gcp"
            )
        from skyquilt.raster.boundary import read_boundary

        read_boundary(settings.picture.boundary, frame.crs)
    _check_jpeg(given, settings.output.compress)
    notes = (*given.survey.notes, *_idle(given, settings))
    return replace(given, survey=replace(given.survey, notes=notes))


def _check_jpeg(given: SurveyInput, compress: str) -> None:
    """Refuses JPEG for photos of which none can be stored so.

    Raises:
        UsageError: there are none with 8 bits in one or three bands.
    """
    if compress != "jpeg" or given.survey.clips or given.clips:
        return
    whys = [not_jpeg(p.dtype, p.channels) for p in given.survey.photos]
    if whys and all(whys):
        raise UsageError(whys[0])


def _idle(given: SurveyInput, settings: MosaicSettings) -> Iterator[str]:
    """Notes on options that have no effect on these photos."""
    photos, asked = given.survey.photos, dict(settings)
    clips = bool(given.survey.clips or given.clips)
    single = any(p.channels == 1 and p.path.suffix.lower() in TIFFS for p in photos)
    lossless = not clips and all(p.dtype != "uint8" for p in photos)
    for names, some, why in (
        (("frame_overlap", "write_frames"), clips, "there is no video"),
        (
            ("clock_offset",),
            clips or (settings.input.geo is not None and is_track(settings.input.geo)),
            "there is no video, and no track of positions by time",
        ),
        (("thermal_unit",), single, "no photo is a TIFF of one band"),
        (("balance_thermal",), any(p.unit for p in photos), "no photo has measured values"),
        (("quality",), not lossless, "these photos are stored without loss"),
    ):
        given_up = [n for n in names if not some and asked[n] != DEFAULTS[n]]
        yield from (f"--{option_of(name)} has no effect here: {why}." for name in given_up)
