"""What a run tells about photos that were added, and what it leaves for more of them."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from skyquilt.model.event import Note
from skyquilt.model.photo import RejectedPhoto
from skyquilt.ortho.earlier import same_pose
from skyquilt.ortho.ground import Ground
from skyquilt.ortho.orthomosaic import used_photos
from skyquilt.photos.left_out import told_left_out
from skyquilt.report.tables import added_sentence
from skyquilt.workflows.finished import Finished, control_key, stamps_of
from skyquilt.workflows.flow import AlignedPhotos, DrawnMap
from skyquilt.workflows.keys import photo_key


def finished(
    aligned: AlignedPhotos, ground: Ground, drawn: DrawnMap, recipe: str, output: Path
) -> Finished:
    """The record of a map in `output`; its results are in the store."""
    return Finished(
        recipe=recipe,
        control=control_key(aligned.given.control),
        photos=tuple(photo_key(p) for p in aligned.photos),
        names=tuple(p.name for p in aligned.photos),
        frame=aligned.frame,
        alignment=aligned.key,
        surface=ground.key,
        labels=drawn.key,
        grid=ground.grid,
        exposure=drawn.exposure,
        shown=tuple(used_photos(ground.views)),
        files=stamps_of(output),
    )


def added_figures(aligned: AlignedPhotos, ground: Ground) -> dict[str, Any]:
    """The entry `added` of metrics.json."""
    earlier = aligned.earlier
    if earlier is None:
        return {}
    before, now = earlier.alignment_of(aligned.photos).poses, aligned.alignment.poses
    moved = sum(i in now and not same_pose(now[i], p) for i, p in before.items())
    share = 1.0 if ground.growth is None else min(1.0, ground.growth.share(ground.grid))
    return {
        "added": {
            "photos": len(aligned.photos) - len(earlier.finished.photos),
            "to": len(earlier.finished.photos),
            "moved": moved,
            "share_made_anew": round(share, 4),
        }
    }


def added_note(figures: Mapping[str, Any]) -> Note:
    """The same in a sentence."""
    if not figures:
        return Note(text="The map could not be continued, so all of it is made anew.")
    return Note(text=added_sentence(figures["added"]))


def nothing_to_do(
    output: Path, what: str, rejected: Sequence[RejectedPhoto], former: Mapping[str, Any]
) -> Iterator[Note]:
    """What a run tells that finds `what` it would make in `output`: files that joined since, but
    cannot be used, by their reasons. `rejected`: those of now; `former`: the metrics of the map.
    """
    known = former.get("photos_rejected")
    lost = [r for r in rejected if not isinstance(known, Mapping) or r.name not in known]
    yield from (Note(text=text, warning=True) for text in told_left_out(lost))
    yield Note(text=f"{output} already contains {what}; nothing to do")
