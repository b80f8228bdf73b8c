"""First pose of a photo from its metadata, corrected by the errors found in earlier photos of the
same source.
"""

from bisect import bisect_left
from collections import defaultdict, deque
from datetime import UTC
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.motion import headings_by_course
from skyquilt.alignment.priors import choose_frame
from skyquilt.alignment.setup import TURNED
from skyquilt.errors import UsageError
from skyquilt.geometry.frames import (
    angle_difference_deg,
    angles_from_cam_R_map,
    cam_R_map_from_angles,
)
from skyquilt.live.common_tilt import common_tilt
from skyquilt.live.drifting_positions import RAYLEIGH, foreseen, leap_m, unforeseen_m
from skyquilt.live.members import Member, Members
from skyquilt.live.settings import LiveSettings
from skyquilt.model.poses import Pose, Prior
from skyquilt.ortho.height_cells import HeightCells
from skyquilt.photos.survey import capture_order

NOMINAL_M = 50.0
"""Assumed height above ground in m where the metadata do not contain one."""
RECENT = 15
"""Number of recent photos of one source from which the correction of the next photo is computed."""
LOOSE, LOOSE_HIGH = 0.03, 0.2
"""Standard deviation of positions, as a share of a photo's width on the ground, and of heights, as
one of that above it, from which half of all photos lie visibly beside their neighbours.
"""
LOOSE_DEG = 10.0
"""The same of the median error of headings: seams lie about a third of a width from the middle."""
LEVEL, LEVEL_M, FEWEST = 2.0, 3.0, 3
"""Drones that flew level by what is refined, so many times better than heights are reported, go on
at that level; deviation (m) of reported heights from which that is asked; photos that tell it.
"""


class Metadata:
    """Computes first poses and learns corrections from photos whose poses were refined."""

    def __init__(self, members: Members, heights: HeightCells, settings: LiveSettings) -> None:
        """Reads what was learned before a restart, in the same order."""
        self.members, self.heights, self.settings = members, heights, settings
        self._recent: dict[str, dict[int, Member]] = defaultdict(dict)
        """Photos of each source that were refined last, the last one at the end."""
        self._misfit: deque[float] = deque(maxlen=60)
        for member in sorted(members.by_id.values(), key=lambda m: m.tried):
            self._remember(member)

    def frame_from(self, member: Member) -> str:
        """Defines the map's frame from a photo that has a position; returns a warning, or nothing.

        Where that photo's height cannot be converted to the datum asked for, the map counts heights
        as the photo does: a flight is not held up for a datum.
        """
        asked, datum = self.settings, self.settings.vertical_datum
        try:
            frame, warning = choose_frame([member.photo], asked.crs, (), datum), ""
        except UsageError as error:
            if datum is None:
                raise
            frame = choose_frame([member.photo], asked.crs)
            named = frame.vertical_datum.replace("_", " ")
            warning = f"The growing map counts heights from: {named}. {error}"
        self.members.set_frame(frame)
        return warning

    def first(self, member: Member) -> Pose | None:
        """A pose from metadata, corrected by the errors found in earlier photos of the same source;
        None if the photo has no position.
        """
        prior = member.prior
        if not np.isfinite(prior.map_C[:2]).all():
            return None
        turn, lift, level = self._corrections(member)
        yaw = prior.yaw_deg - turn if np.isfinite(prior.yaw_deg) else self._flown(member)
        datum = self.members.frame.vertical_datum if self.members.frame else "unknown"
        z = prior.map_C[2]
        if np.isfinite(level):
            z = level
        elif np.isfinite(lift):
            z = z + lift
        elif not np.isfinite(z) or (datum == "takeoff" and z < 3):
            z = self.ground_at(prior.map_C) + NOMINAL_M
        if abs(turn) > 90:
            R = cam_R_map_from_angles(yaw, 0.0, 0.0)
        else:
            R = self._tilted(member) @ _told_R(prior, yaw)
        x, y = prior.map_C[:2] + foreseen(*self._errors(member))
        return Pose(cam_R_map=R, map_C=np.array([x, y, z]))

    def _tilted(self, member: Member) -> NDArray[np.float64]:
        """The turn (3, 3) by which recent photos of the source look elsewhere than they tell."""
        known = [
            (_told_R(m.prior, angles_from_cam_R_map(m.pose.cam_R_map)[0]), m.pose.cam_R_map)
            for m in self._recent[_source(member)].values()
            if m.pose is not None and m.id != member.id and not m.camera.endswith(TURNED)
        ]
        told, found = np.array(known).reshape(-1, 2, 3, 3).swapaxes(0, 1)
        return common_tilt(told, found)

    def _errors(self, member: Member) -> tuple[NDArray[np.float64], int]:
        """By how many metres (n, 2) the positions of recent photos of the source err, in the order
        in which they were taken, and the place of a photo among them.
        """
        known = sorted(
            (capture_order(m.photo), *(m.pose.map_C - m.prior.map_C)[:2].tolist())
            for m in self._recent[_source(member)].values()
            if m.pose is not None and m.id != member.id and np.isfinite(m.prior.map_C[:2]).all()
        )
        off = np.array([found[1:] for found in known], np.float64).reshape(-1, 2)
        return off, bisect_left([found[0] for found in known], capture_order(member.photo))

    def _leap_m(self, member: Member) -> float:
        """By how many metres the position of a photo lies further from the one before than its
        drone flies.
        """
        known = sorted(
            (_seconds(m), *m.prior.map_C[:2].tolist())
            for m in self._recent[_source(member)].values()
            if m.id != member.id and np.isfinite([_seconds(m), *m.prior.map_C[:2]]).all()
        )
        way = np.array(known, np.float64).reshape(-1, 3)
        return leap_m(way[:, 1:], way[:, 0], member.prior.map_C[:2], _seconds(member))

    def _flown(self, member: Member) -> float:
        """The heading in degrees of a photo that reports none, by its direction of flight, as
        recent photos of the source are headed; 0 where these do not tell it.
        """
        known, poses = [], []
        for other in self._recent[_source(member)].values():
            if other.pose is not None and other.id != member.id:
                known.append(other)
                poses.append(other.pose)
        if not known:
            return 0.0
        C = np.array([pose.map_C[:2] for pose in poses])
        off = C - np.array([m.prior.map_C[:2] for m in known])
        off = off[np.isfinite(off).all(1)]
        own = member.prior.map_C[:2] + (np.median(off, axis=0) if len(off) else 0.0)
        yaw = [*(angles_from_cam_R_map(pose.cam_R_map)[0] for pose in poses), np.nan]
        photos = [*(m.photo for m in known), member.photo]
        told = headings_by_course(photos, np.vstack([C, own]), np.array(yaw))[-1]
        return float(told) if np.isfinite(told) else 0.0

    def _corrections(self, member: Member) -> tuple[float, float, float]:
        """Error of the headings (deg) and heights (m) that recent photos of the source reported,
        and the height (m) at which they flew if that tells more, otherwise NaN.
        """
        turns, lifts, z = self._learned(member)
        last = turns[-3:][np.isfinite(turns[-3:])]
        unit = np.exp(1j * np.radians(last))
        agreed = len(last) > 0 and abs(unit.mean()) > 0.97
        turn = float(np.degrees(np.angle(unit.mean()))) if agreed else 0.0
        known = np.isfinite(lifts)
        lift = float(np.median(lifts[known])) if known.any() else np.nan
        told = np.isfinite(member.prior.map_C[2])
        flown = z[known] if told else z
        steady = _level(lifts[known], flown) if told else len(flown) > 0
        level = float(np.median(flown)) if steady else np.nan
        return (turn if abs(turn) > 10 else 0.0), lift, level

    def _learned(self, member: Member) -> NDArray[np.float64]:
        """(3, n) of recent photos of the same source: errors of their headings (deg) when they were
        refined, and of their heights (m; NaN where none is told), and these heights, as the map has
        them now.
        """
        rows = []
        for other in self._recent[_source(member)].values():
            if other.learned is not None and other.pose is not None:
                z, told = float(other.pose.map_C[2]), float(other.prior.map_C[2])
                rows.append((other.learned[0], z - told, z))
        return np.array(rows, np.float64).reshape(-1, 3).T

    def loose(self, member: Member, pose: Pose) -> bool:
        """Whether a photo will most likely lie beside its neighbours by this pose, from its
        metadata: its heading is not known, its position leaps, or positions, heights or headings of
        photos before it were badly off, each in another way. False where there is no photo to be
        linked with.
        """
        if not any(m.tried for m in self.members.on_map()):
            return False
        if not np.isfinite(member.prior.yaw_deg):
            return True
        above = max(float(pose.map_C[2]) - self.ground_at(pose.map_C), 2.0)
        visible = LOOSE * above * member.photo.width / member.photo.focal.px
        if unforeseen_m(self._errors(member)[0], self.scatter()) > visible:
            return True
        if self._leap_m(member) > visible:
            return True
        turns, lifts, z = self._learned(member)
        if _astray_deg(turns[np.isfinite(turns)]) > LOOSE_DEG:
            return True
        if np.isfinite(member.prior.map_C[2]):
            z, lifts = z[np.isfinite(lifts)], lifts[np.isfinite(lifts)]
        else:
            lifts = z
        if len(z) < FEWEST:
            return False
        return float(min(_scatter(lifts), _scatter(z))) > LOOSE_HIGH * above

    def learn(self, member: Member) -> None:
        """Compares the metadata of a photo with its refined pose; stores the differences in
        `member.learned`.
        """
        assert member.pose is not None
        yaw, _, _ = angles_from_cam_R_map(member.pose.cam_R_map)
        off = member.pose.map_C - member.prior.map_C
        turn = (
            angle_difference_deg(member.prior.yaw_deg, yaw)
            if np.isfinite(member.prior.yaw_deg)
            else np.nan
        )
        lift = float(off[2]) if np.isfinite(off[2]) else float(member.pose.map_C[2])
        member.learned = float(turn), lift, float(np.hypot(off[0], off[1]))
        self._remember(member)

    def _remember(self, member: Member) -> None:
        if member.learned is None:
            return
        recent = self._recent[_source(member)]
        recent.pop(member.id, None)
        recent[member.id] = member
        if len(recent) > RECENT:
            del recent[next(iter(recent))]
        misfit = member.learned[2]
        if np.isfinite(misfit):
            self._misfit.append(misfit)

    def ground_at(self, xyz: NDArray[Any]) -> float:
        """Height of the ground near a place in m."""
        reach = 60.0
        x, y = float(xyz[0]), float(xyz[1])
        near = (
            self.heights.median((x - reach, y - reach, x + reach, y + reach))
            if np.isfinite(x + y)
            else None
        )
        return near if near is not None else float(self.members.ledger.meta("ground", 0.0))

    def scatter(self) -> float:
        """Standard deviation per axis, in m, of reported positions, estimated from the refined
        photos.
        """
        return float(np.median(self._misfit)) / RAYLEIGH if len(self._misfit) >= 5 else 0.0


def _source(member: Member) -> str:
    return f"{member.source}|{member.photo.camera_key}"


def _seconds(member: Member) -> float:
    """When a photo was taken by its own clock, in s; NaN where it does not tell."""
    time = member.photo.time
    return time.replace(tzinfo=UTC).timestamp() if time is not None else np.nan


def _told_R(prior: Prior, yaw_deg: float) -> NDArray[np.float64]:
    """Where a photo looks by the tilt that it tells, headed so."""
    return cam_R_map_from_angles(yaw_deg, prior.pitch_deg, prior.roll_deg)


def _scatter(values: NDArray[np.float64]) -> float:
    """Median deviation from the median."""
    return float(np.median(np.abs(values - np.median(values))))


def _astray_deg(turns: NDArray[np.float64]) -> float:
    """Median error in degrees of headings beside what they err by in the mean; 0 of few."""
    if len(turns) < FEWEST:
        return 0.0
    unit = np.exp(1j * np.radians(turns))
    return float(np.degrees(np.median(np.abs(np.angle(unit * unit.sum().conj())))))


def _level(lifts: NDArray[np.float64], z: NDArray[np.float64]) -> bool:
    """Whether the heights of photos (m) scatter far less than the errors of reported ones."""
    return len(z) >= FEWEST and _scatter(lifts) > max(LEVEL * _scatter(z), LEVEL_M)
