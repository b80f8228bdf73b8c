"""One view of the board per pose, from single frames or from the frames of a heated sweep."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from numpy.typing import NDArray

from skyquilt.calibration.assemble import Assemble
from skyquilt.calibration.find_board import FindBoard, grey_float
from skyquilt.calibration.series import StoodStill, mostly_still, runs
from skyquilt.engine.clock import Steps
from skyquilt.engine.workers import Workers
from skyquilt.errors import RefusedError, UnreadablePhotoError
from skyquilt.model.board import Board, BoardView, RejectedView
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.photos.pixels import read_color

SERIES = ("auto", "views", "folders")
"""How frames of one pose are grouped: detected automatically, never, or by folder."""
_SWEEP = 3
"""Fewest frames of a pose that are assembled."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """The board in every pose, or the reason why it was not found, with the images that were
    searched.
    """

    views: tuple[BoardView, ...]
    """Poses with the board."""
    rejected: tuple[RejectedView, ...]
    """Poses without the board."""
    pictures: dict[str, NDArray[Any]]
    """Name of a view -> its image (H, W), single or assembled."""
    frames: int
    """Number of frames searched."""


def one_camera(photos: Sequence[Photo]) -> None:
    """Refuses frames that are not from one camera.

    Raises:
        RefusedError: they have several sizes or cameras.
    """
    sizes = Counter((p.width, p.height) for p in photos).most_common()
    if len(sizes) > 1:
        listed = ", ".join(f"{n} of {w}x{h}" for (w, h), n in sizes)
        raise RefusedError(
            f"the frames have different sizes ({listed} px): one camera is calibrated at a time;"
            " put each camera's frames into a folder of its own"
        )
    keys = Counter(p.camera_key for p in photos).most_common()
    if len(keys) > 1:
        listed = ", ".join(f"{n} by '{key}'" for key, n in keys)
        raise RefusedError(
            f"the frames are by different cameras ({listed}): one camera is calibrated at a time;"
            " put each camera's frames into a folder of its own"
        )


def look(
    photos: Sequence[Photo],
    board: Board,
    find: FindBoard,
    series: str,
    workers: Workers,
    assemble: Assemble,
) -> Steps[Seen]:
    """Finds the board in every pose, whose frames are assembled to one image."""
    yield 0, len(photos)
    poses, unreadable = grouped(photos, series)
    views: list[BoardView] = []
    rejected = [RejectedView(name=r.name, reason=r.reason) for r in unreadable]
    pictures: dict[str, NDArray[Any]] = {}
    done = 0

    def one(pose: Sequence[Photo]) -> tuple[BoardView | RejectedView, NDArray[Any] | None]:
        return _view(pose, board, find, assemble)

    for pose, (found, picture) in zip(poses, workers.each(one, poses), strict=True):
        if isinstance(found, BoardView) and picture is not None:
            views.append(found)
            pictures[found.name] = picture
        elif isinstance(found, RejectedView):
            rejected.append(found)
        done += len(pose)
        yield done, len(photos)
    return Seen(views=tuple(views), rejected=tuple(rejected), pictures=pictures, frames=len(photos))


def grouped(photos: Sequence[Photo], series: str) -> tuple[list[list[Photo]], list[RejectedPhoto]]:
    """Frames grouped by pose; frames that can no longer be read are left out."""
    ordered = sorted(photos, key=_folder)  # stable: in order of capture inside a folder
    folders = [list(g) for _, g in groupby(ordered, key=_folder)]
    if series == "folders":
        return folders, []
    if series == "views":
        return [[p] for p in ordered], []
    poses: list[list[Photo]] = []
    unreadable: list[RejectedPhoto] = []
    for folder in folders:
        kept, structures = _structures(folder, unreadable)
        parts = runs(structures, StoodStill())
        if len(folders) > 1 and mostly_still(parts):
            parts = [list(range(len(kept)))]
        poses += [[kept[i] for i in part] for part in parts]
    return poses, unreadable


def _structures(
    folder: Sequence[Photo], unreadable: list[RejectedPhoto]
) -> tuple[list[Photo], list[NDArray[Any]]]:
    still, kept, structures = StoodStill(), [], []
    for photo in folder:
        try:
            structures.append(still.structure(read_color(photo)))
            kept.append(photo)
        except UnreadablePhotoError as error:
            unreadable.append(RejectedPhoto(name=photo.name, reason=str(error)))
    return kept, structures


def _folder(photo: Photo) -> str:
    return photo.name.rpartition("/")[0]


def _view(
    pose: Sequence[Photo], board: Board, find: FindBoard, assemble: Assemble
) -> tuple[BoardView | RejectedView, NDArray[Any] | None]:
    """Finds the board in one pose: in the frame, or in the image assembled from its frames."""
    name = pose[0].name if len(pose) == 1 else f"{pose[0].name} and {len(pose) - 1} more"
    try:
        alone = len(pose) < _SWEEP
        picture = grey_float(read_color(pose[0])) if alone else assemble(_read(pose), board)
    except UnreadablePhotoError as error:
        return RejectedView(name=name, reason=str(error)), None
    return find(name, picture, board, frames=len(pose)), picture


def _read(pose: Sequence[Photo]) -> Iterator[NDArray[Any]]:
    for photo in pose:
        yield read_color(photo)
