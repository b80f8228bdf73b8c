"""`flightline`: mosaics of flight lines are joined and georeferenced by regression (Arteaga et al.
2019).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from skyquilt.errors import AlignmentError
from skyquilt.geometry.transforms import fit, transfer
from skyquilt.model.camera import Camera
from skyquilt.model.estimate import NoEstimate
from skyquilt.model.features import Features
from skyquilt.model.photo import Photo
from skyquilt.model.poses import Alignment, Join, MapFrame, Pose, Prior
from skyquilt.papers.flightline_geometry import (
    by_distance,
    by_heading,
    middle_out,
    pairs_across,
    reversals,
)
from skyquilt.papers.lens_order import of_order, to_working, working_K
from skyquilt.papers.pieces import planar_pose
from skyquilt.papers.plane_registration import Estimator, Matcher, implausible, plane_alignment

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ByFlightline:
    """The complete method of A: flight lines, pairs across lines, homographies by STE per inlier,
    from the middle outwards, affine regression.
    """

    within: Matcher
    """Matches inside a line: the 150 best."""
    across: Matcher
    """Matches between lines: the 50 best of every pair."""
    estimate: Estimator
    """RANSAC by the symmetric transfer error per inlier; A's transformation is the homography."""
    split: Literal["heading", "distance"] = "heading"
    """How lines are separated: `distance` is A's method; `heading` also ends a line where the
    course turns.
    """
    distortion: str = "none"
    """Order of the lens model; A corrects none."""
    version: ClassVar[int] = 2
    name: ClassVar[str] = "flightline"

    def __call__(
        self,
        photos: Sequence[Photo],
        frame: MapFrame,
        priors: Sequence[Prior],
        features: Sequence[Features],
        order: Sequence[int],
    ) -> Alignment:
        """Aligns photos in the order of capture given (indices).

        Raises:
            AlignmentError: no positions, fewer than two lines, or (by distance) lines that reverse
                their direction.
        """
        xy = np.array([p.map_C[:2] for p in priors]).reshape(-1, 2)
        lost = {
            i: "it has no position, and method flightline needs one"
            for i in order
            if not np.isfinite(xy[i]).all()
        }
        order = [i for i in order if i not in lost]
        lines, notes = self._lines(order, xy, photos)
        cameras = {p.camera_key: of_order(p.lens, self.distortion) for p in photos}
        lens = [cameras[p.camera_key] for p in photos]
        work = _Work(method=self, photos=photos, lens=lens, features=features, notes=notes)
        strips = [s for line in lines for s in work.strips(line)]
        whole = work.joined(strips, self._pairs(order, xy, strips))
        poses, lost_too = _on_map(whole, xy, lens)
        alone = [i for s in strips for i in s if i not in whole]
        lost |= dict.fromkeys(alone, "its flight line is not linked to the others") | lost_too
        placed = plane_alignment(
            self.name,
            frame,
            photos,
            poses,
            True,
            cameras,
            [{i: np.eye(3) for i in poses}],
            work.joins,
            work.notes,
        )
        return replace(placed, rejected=lost)

    def _pairs(
        self, order: Sequence[int], xy: Array, strips: Sequence[dict[int, Array]]
    ) -> list[tuple[int, int]]:
        """Pairs of photos of different strips that may overlap: those of A, and for `heading` also
        pairs on both sides of a turn.

        Lines that only meet at their ends, around a field, are connected by obtuse triangles only.
        """
        pairs = pairs_across(xy, [list(s) for s in strips])
        if self.split == "distance":
            return pairs
        strip_of = {i: k for k, s in enumerate(strips) for i in s}
        turns = [(min(i, j), max(i, j)) for i, j in pairwise(order) if strip_of[i] != strip_of[j]]
        return sorted({*pairs, *turns})

    def _lines(
        self, order: list[int], xy: Array, photos: Sequence[Photo]
    ) -> tuple[list[list[int]], list[str]]:
        """Lines of two or more photos (indices), and messages about them."""
        if len(order) < 4:
            raise AlignmentError(
                f"method flightline needs positions of at least two flight lines, and {len(order)}"
                " photos have one;"
                " give positions with --geo, or use --method image"
            )
        cut = by_distance if self.split == "distance" else by_heading
        lines = [[order[k] for k in line] for line in cut(xy[order])]
        turned = [line for line in lines if reversals(xy, line) > 0]
        if self.split == "distance" and turned:
            worst = max(turned, key=len)
            raise AlignmentError(
                f"by shooting distance alone the photos {photos[worst[0]].name} to"
                f" {photos[worst[-1]].name} form one"
                f" flight line that turns back {reversals(xy, worst)} times; use --lines heading"
            )
        whole = [line for line in lines if len(line) > 1]
        if len(whole) < 2:
            raise AlignmentError(
                f"method flightline joins flight lines, and {len(order)} positions show"
                f" {len(whole)};"
                " use --method image or --method bundle"
            )
        single = [photos[line[0]].name for line in lines if len(line) == 1]
        notes = [
            f"{len(whole)} flight lines: {', '.join(str(len(line)) for line in whole)} photos."
        ]
        notes += (
            [f"between flight lines, each treated as a separate line: {', '.join(single)}."]
            if single
            else []
        )
        return lines, notes


@dataclass(kw_only=True)
class _Work:
    """Homographies of one survey, computed on demand."""

    method: ByFlightline
    photos: Sequence[Photo]
    lens: Sequence[Camera]
    features: Sequence[Features]
    notes: list[str]

    def __post_init__(self) -> None:
        self.joins: list[Join] = []

    def strips(self, line: Sequence[int]) -> list[dict[int, Array]]:
        """Mosaics of a line (one if it is not interrupted): plane_H_work (3, 3) of each photo's
        working image.
        """
        strips: list[list[int]] = [[line[0]]]
        step: dict[int, Array] = {}  # photo -> before_H_photo
        for before, photo in pairwise(line):
            found = self._pair(photo, before)
            if isinstance(found, NoEstimate):
                names = self.photos[photo].name, self.photos[before].name
                self.notes.append(
                    f"the flight line breaks between {names[1]} and {names[0]} ({found.reason})."
                )
                strips.append([photo])
            else:
                step[photo] = found
                strips[-1].append(photo)
        return [_from_middle(strip, step) for strip in strips]

    def _pair(self, photo: int, onto: int) -> Array | NoEstimate:
        """onto_H_photo (3, 3) between working images of two photos of a line."""
        matches = self.method.within(self.features[photo], self.features[onto])
        px = self.features[photo].px[matches.index_a]
        a = to_working(self.lens[photo], px)
        b = to_working(self.lens[onto], self.features[onto].px[matches.index_b])
        found = self.method.estimate(a, b)
        if isinstance(found, NoEstimate):
            return found
        if reason := implausible(found.b_H_a, working_K(self.lens[photo])[:2, 2]):
            return NoEstimate(reason=reason)
        kept = found.inliers
        self.joins.append(
            Join(
                photo=photo,
                onto=onto,
                matches=len(matches),
                inliers=int(kept.sum()),
                ste_px2=found.ste_per_inlier,
                score=np.nan,
                moved_m=np.nan,
                px=px[kept],
                d_px=b[kept] - transfer(found.b_H_a, a[kept]),
                levelled=np.ones(int(kept.sum()), bool),
            )
        )
        return found.b_H_a

    def joined(
        self, strips: Sequence[dict[int, Array]], pairs: Sequence[tuple[int, int]]
    ) -> dict[int, Array]:
        """All strips in the plane of the middle one: plane_H_work per photo; strips without links
        are left out.
        """
        strip_of = {i: k for k, s in enumerate(strips) for i in s}
        matched: dict[tuple[int, int], list[tuple[Array, Array]]] = {}
        for i, j in pairs:
            if strip_of[i] != strip_of[j]:
                a, b = (i, j) if strip_of[i] < strip_of[j] else (j, i)
                low, high = strip_of[a], strip_of[b]
                matched.setdefault((low, high), []).append(
                    self._between(a, b, strips[low][a], strips[high][b])
                )
        order = middle_out([k for k in range(len(strips)) if len(strips[k]) > 1] or [0])
        order += [k for k in range(len(strips)) if k not in order]
        whole = {order[0]: np.eye(3)}
        waiting = order[1:]
        while waiting:
            placed = next((k for k in waiting if self._attach(k, whole, matched)), None)
            if placed is None:
                break
            waiting.remove(placed)
        for k in waiting:
            first, last = self.photos[min(strips[k])].name, self.photos[max(strips[k])].name
            self.notes.append(
                f"the flight line {first} to {last} is not linked to the others; it is left out."
            )
        return {i: H @ strips[k][i] for k, H in whole.items() for i in strips[k]}

    def _attach(
        self,
        k: int,
        whole: dict[int, Array],
        matched: dict[tuple[int, int], list[tuple[Array, Array]]],
    ) -> bool:
        """Places strip k by its matches with all placed strips; False if that fails."""
        a, b = [], []
        for other, H in whole.items():
            for low, high in matched.get((min(k, other), max(k, other)), []):
                own, fixed = (low, high) if k < other else (high, low)
                a.append(own)
                b.append(transfer(H, fixed))
        if not a:
            return False
        found = self.method.estimate(np.concatenate(a), np.concatenate(b))
        if isinstance(found, NoEstimate) or implausible(
            found.b_H_a, np.concatenate(a)[found.inliers].mean(0)
        ):
            return False
        whole[k] = found.b_H_a
        return True

    def _between(self, a: int, b: int, plane_H_a: Array, plane_H_b: Array) -> tuple[Array, Array]:
        """The 50 best matches of two photos of neighbouring lines, each on the plane of its own
        strip.
        """
        matches = self.method.across(self.features[a], self.features[b])
        pa = to_working(self.lens[a], self.features[a].px[matches.index_a])
        pb = to_working(self.lens[b], self.features[b].px[matches.index_b])
        return transfer(plane_H_a, pa), transfer(plane_H_b, pb)


def _from_middle(strip: Sequence[int], before_H_photo: dict[int, Array]) -> dict[int, Array]:
    """plane_H_work of every photo of a strip on the working image of its middle one, products taken
    middle-out.
    """
    order = middle_out(strip)
    place = {photo: k for k, photo in enumerate(strip)}
    plane = {order[0]: np.eye(3)}
    for photo in order[1:]:
        k = place[photo]
        if k > place[order[0]]:
            H = plane[strip[k - 1]] @ before_H_photo[photo]
        else:
            H = plane[strip[k + 1]] @ np.linalg.inv(before_H_photo[strip[k + 1]])
        plane[photo] = H / H[2, 2]
    return plane


def _on_map(
    whole: dict[int, Array], xy: Array, lens: Sequence[Camera]
) -> tuple[dict[int, Pose], dict[int, str]]:
    """Poses by affine regression of the photos' centres to their positions (A 16-21).

    A first rotates the mosaic by the angle between the first two photos of the central line in both
    systems, so that the regression starts near the identity. A linear regression has the same
    solution for any start, so here the rotation is part of the affine transformation, as is the
    inversion of y (A 16).
    """
    used = list(whole)
    middle = np.array([transfer(whole[i], working_K(lens[i])[None, :2, 2])[0] for i in used])
    map_H_plane = fit("affine", middle, xy[used])
    if map_H_plane is None:
        raise AlignmentError(
            "the positions of the photos lie on one line, so that no regression can place the"
            " mosaic;"
            " use --method image"
        )
    poses, lost = {}, {}
    for i in used:
        try:
            poses[i] = planar_pose(map_H_plane @ whole[i] @ working_K(lens[i]))
        except ValueError:
            lost[i] = "its registration in the mosaic is degenerate"
    return poses, lost
