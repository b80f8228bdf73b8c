"""State of each photo in memory, and how it is stored and read."""

import json
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Transformer

from skyquilt.alignment.priors import empty_prior, photo_prior
from skyquilt.alignment.setup import TURNED
from skyquilt.live.doubled import LOOKED_BACK, DoubtedHeights, tell_doubled
from skyquilt.live.failures import concerning
from skyquilt.live.inbox import Inbox
from skyquilt.live.ledger import DAMAGED, STAND_IN, Ledger
from skyquilt.live.settings import LiveSettings
from skyquilt.matching.lens_kind import as_fisheye, fisheye_note
from skyquilt.model.camera import ADJUSTABLE, PARAMETERS, Camera
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.model.poses import MapFrame, Motion, Pose, Prior
from skyquilt.outside import real, whole
from skyquilt.photos.capture import stated_shutter
from skyquilt.photos.implausible_positions import on_sphere, raised, sphere, with_coarse_deviations
from skyquilt.photos.read import read_photo
from skyquilt.photos.survey import capture_order

FISHEYES = "fisheyes"
"""Name in the ledger of the cameras that proved to have a fisheye."""
GROUNDED = "it was taken on the ground, as its height above take-off tells"
MOST_M = 1e9
"""Largest coordinate in the map's frame."""
FAR_M = 100_000.0
"""A position farther than this from where the map began is not used: it is that of another flight,
and the map's projection is bent there.
"""
COARSE = "coarse positions"
"""Name in the ledger of the number of photos that a note named last for that."""
ON_MAP = ("placed", "refined")
"""States of photos that are drawn."""


@dataclass(kw_only=True, eq=False)
class Member:
    """One accepted photo."""

    id: int
    """Number, in order of acceptance."""
    photo: Photo
    """Data read from its file."""
    prior: Prior = field(default_factory=empty_prior)
    """Pose priors from its metadata in the map's frame; empty until there is a frame."""
    source: str
    """The folder or drone that it came from."""
    state: str
    """received, waiting, placed, refined, superseded or refused (no member is `kept`)."""
    pose: Pose | None = None
    """Its pose."""
    camera: str = ""
    """Name of its camera calibration."""
    tried: int = 0
    """Position in the order in which photos were compared with their neighbours, counted from 1; 0
    = not compared yet.
    """
    again: int = 0
    """Set to a count from 1 when an unplaced photo links to a new photo and must be compared
    again.
    """
    learned: tuple[float, float, float] | None = None
    """Errors found in its metadata: heading in degrees, height in m, position in m; NaN = not
    known.
    """
    links: set[int] = field(default_factory=set)
    """Photos it is linked to."""


class Queues:
    """Photos that wait for a processing step."""

    def __init__(self, members: Iterable[Member]) -> None:
        """Restores the queues as they were before a restart."""
        known = list(members)
        self.received = deque(m for m in known if m.state == "received")
        """To be placed by their metadata, in order of acceptance."""
        untried = [m for m in known if m.state in ("placed", "waiting") and not m.tried]
        self.untried = deque(sorted(untried, key=lambda m: (m.again, m.id)))
        """To be compared with their neighbours; refined ones once more."""
        lost = [m for m in known if m.state == "waiting" and m.tried]
        self.lost = sorted(lost, key=lambda m: m.tried)
        """Compared, but still without a pose."""

    @property
    def unrefined(self) -> int:
        """Number of photos in `untried` that are not refined yet."""
        return sum(m.state != "refined" for m in self.untried)

    def next_untried(self) -> Member | None:
        """The photo to compare next: one that is not refined yet before those that are to be once
        more, which already lie as the photos around them do.
        """
        first = next((m for m in self.untried if m.state != "refined"), None)
        return first or (self.untried[0] if self.untried else None)


class Members:
    """All accepted photos, the blocks of linked photos, the frame and the cameras. `save` stores
    changes.
    """

    def __init__(self, ledger: Ledger, inbox: Inbox, settings: LiveSettings) -> None:
        """Reads the ledger; `settings`: those with which the photos were accepted."""
        self.ledger, self.inbox, self.settings = ledger, inbox, settings
        self._shutter = stated_shutter(settings.shutter, settings.shutter_readout_ms)
        self.by_id: dict[int, Member] = {}
        self.block_of: dict[int, int] = {}
        self.blocks: dict[int, set[int]] = {}
        self.cameras: dict[str, Camera] = {}
        self.fisheyes = _multiples(ledger.meta(FISHEYES))
        self.frame: MapFrame | None = None
        self.near: list[int] = []
        """Numbers of the photos with a position near the place where the map began, ascending."""
        self._began = np.full(3, np.nan)
        self._heights = DoubtedHeights(ledger)
        self._last = 0
        self._to_map: Transformer | None = None
        self._to_wgs: Transformer | None = None
        if found := ledger.meta("frame"):
            self.set_frame(MapFrame(**{**found, "origin": tuple(found["origin"])}))
        for key, body in ledger.rows("select key, body from camera order by key"):
            if camera := camera_from(body):
                self.cameras[str(key)] = camera
        self.take_up()
        for a, b in ledger.rows("select a, b from link where body is not null order by a, b"):
            self.joined(int(a), int(b))

    @property
    def placeless(self) -> bool:
        """Whether there is a map, and nothing says where on Earth it is."""
        return self.frame is not None and self.frame.crs is None

    def set_frame(self, frame: MapFrame) -> None:
        """Sets the map's frame; it does not change afterwards."""
        self.frame, self.near = frame, []
        self._to_wgs = Transformer.from_crs(frame.crs or STAND_IN, 4326, always_xy=True)
        self._to_map, self._began = None, np.full(3, np.nan)
        if frame.crs is not None:
            self._to_map = Transformer.from_crs(4326, frame.crs, always_xy=True)
            longitude, latitude = self._to_wgs.transform(*frame.origin)
            self._began = sphere(np.array([[latitude, longitude]]))[0]
        for member in self.by_id.values():
            member.prior = self._prior(member)
            self._note_near(member)
        self._doubt_positions(list(self.by_id.values()))

    def _doubt_positions(self, new: Sequence[Member]) -> None:
        """Gives positions that are rounded, or repeat the one before as those of a slow or stuck
        receiver do, deviations as large as they are (`with_coarse_deviations`). Photos are noted
        whenever there are twice as many of them.
        """
        coarse, notes = 0, list[str]()
        for key in dict.fromkeys(m.photo.camera_key for m in new):
            alike = (m for m in reversed(self.by_id.values()) if m.photo.camera_key == key)
            located = (m for m in alike if np.isfinite(m.prior.map_C[0]))
            own = list(islice(located, LOOKED_BACK + len(new)))
            own.sort(key=lambda m: capture_order(m.photo))
            photos, said = with_coarse_deviations([m.photo for m in own])
            if len({p.position for p in photos}) < 2:
                continue  # there is no step to tell how far photos are apart
            for member, photo in zip(own, photos, strict=True):
                sigma = member.prior.sigma_C
                if photo.position is not None and sigma[0] != photo.position.sigma_xy_m:
                    sigma = np.array([*[photo.position.sigma_xy_m] * 2, sigma[2]])
                    member.prior = replace(member.prior, sigma_C=sigma)
            coarse += sum(a is not m.photo for a, m in zip(photos, own, strict=True))
            notes += said
        tell_doubled(self.ledger, COARSE, coarse, lambda: [f"So far: {note}" for note in notes])

    def _prior(self, member: Member) -> Prior:
        """The prior of a photo in the map's frame; a position far away is not used, nor heights
        that are doubted.
        """
        assert self.frame is not None
        photo = self._heights.doubted(member.id, member.photo)
        if self.distance_m(photo) > FAR_M:
            photo = replace(photo, position=None)
        return photo_prior(photo, self.frame, self._to_map)

    def on_ground(self, member: Member) -> bool:
        """Whether a photo was taken on the ground: its height above take-off, which is believed
        since photos of its camera tell others, tells so.
        """
        photo = self._heights.doubted(member.id, member.photo)
        return photo.above_takeoff_m is not None and not raised(photo)

    def _note_near(self, member: Member) -> None:
        if member.photo.position is not None and self.distance_m(member.photo) <= FAR_M:
            self.near.append(member.id)

    def distance_m(self, photo: Photo) -> float:
        """Distance in m from a photo's position to where the map began; 0 where one of them is not
        known.
        """
        if photo.position is None:
            return 0.0
        return float(np.nan_to_num(np.linalg.norm(on_sphere([photo])[0] - self._began)))

    def far_note(self, photo: Photo) -> str:
        """Why a photo's position is not used; empty where it is."""
        distance = self.distance_m(photo)
        if distance <= FAR_M:
            return ""
        return f"its position lies {distance / 1000:.0f} km from the map and is not used"

    def take_up(self) -> list[Member]:
        """Photos that were accepted since the last call, in order."""
        query = (
            "select id, name, source, file, state, pose, camera, about from photo where id > ?"
            " and state != 'kept' order by id"
        )
        new = []
        for number, name, source, file, state, pose, camera, about in self.ledger.rows(
            query, self._last
        ):
            self._last = int(number)
            photo = read_photo(
                self.inbox.folder / Path(str(file)).name,
                name=str(name),
                thermal_unit=self.settings.thermal_unit,
                most_mp=self.settings.most_mp,
            )
            if isinstance(photo, RejectedPhoto):
                if state != "refused":
                    self.inbox.check()
                    self.ledger.lost(int(number), str(name), str(source), photo.reason)
                continue
            try:
                known = pose_from(json.loads(pose)) if pose else None
                more = _about(json.loads(about) if about else {})
            except DAMAGED:
                why = "what is stored of it is damaged"
                self.ledger.set_photo(number, state="refused", reason=why, pose=None, footprint="")
                continue
            photo = self._seen(replace(photo, shutter=self._shutter or photo.shutter))
            member = Member(
                id=int(number),
                photo=photo,
                source=str(source),
                state=str(state),
                camera=str(camera or ""),
                pose=known,
                **more,
            )
            if self.frame is not None and state != "refused":
                with concerning(member.id):
                    member.prior = self._prior(member)
                    self._note_near(member)
            self.by_id[member.id] = member
            self.block_of[member.id] = member.id
            self.blocks[member.id] = {member.id}
            new.append(member)
        latest = islice(reversed(self.by_id.values()), LOOKED_BACK + len(new))
        risen, mended = self._heights.look({m.id: m.photo for m in latest}, len(new))
        for m in self.by_id.values() if risen else [self.by_id[i] for i in mended]:
            if self.frame is not None and (m.id in mended or m.photo.camera_key in risen):
                m.prior = self._prior(m)
        if new and self.frame is not None:
            self._doubt_positions(new)
        return new

    def _seen(self, photo: Photo) -> Photo:
        """The photo with the lens that photos of its camera show."""
        multiple = self.fisheyes.get(photo.camera_key)
        if multiple is None:
            return photo
        told = replace(photo, shown_lens=None).lens
        return replace(photo, shown_lens=as_fisheye(told, multiple))

    def bend(self, camera: str, multiple: float) -> None:
        """A camera (`camera_key`) proved to have a fisheye, of a focal length of so many times the
        reported one: calibrations found without that are dropped. `save_fisheye` stores it.
        """
        self.fisheyes[camera] = multiple
        for member in self.by_id.values():
            if member.photo.camera_key == camera:
                member.photo = self._seen(member.photo)
        for key in (camera, camera + TURNED):
            self.cameras.pop(key, None)

    def save_fisheye(self, camera: str) -> None:
        """Stores that a camera proved to have a fisheye (inside a transaction of the ledger)."""
        with self.ledger.change() as db:
            self.ledger.put_meta(FISHEYES, self.fisheyes)
            for key in (camera, camera + TURNED):
                db.execute("delete from camera where key = ?", (key,))
            self.ledger.tell("note", {"text": fisheye_note(camera)})

    def joined(self, a: int, b: int) -> None:
        """Records a link. A block is named by its first photo, whatever the order in which its
        links were found.
        """
        if a not in self.by_id or b not in self.by_id:
            return
        self.by_id[a].links.add(b)
        self.by_id[b].links.add(a)
        one, other = sorted((self.block_of[a], self.block_of[b]))
        if one == other:
            return
        self.blocks[one] |= self.blocks[other]
        for i in self.blocks.pop(other):
            self.block_of[i] = one

    def parted(self, a: int, b: int) -> None:
        """Forgets a link, and divides the block that it alone held together."""
        self.by_id[a].links.discard(b)
        self.by_id[b].links.discard(a)
        left = self.blocks.pop(self.block_of[a])
        while left:
            block, rim = set[int](), {min(left)}
            while rim:
                block |= rim
                rim = {j for i in rim for j in self.by_id[i].links} - block
            left -= block
            name = min(block)
            self.blocks[name] = block
            for i in block:
                self.block_of[i] = name

    def block(self, photo: int) -> set[int]:
        """All photos that are connected with this one by links."""
        return self.blocks[self.block_of[photo]]

    def camera(self, member: Member) -> Camera:
        """The calibration of a photo: as estimated by the map, otherwise from the photo's
        metadata.
        """
        known = self.cameras.get(member.camera) or self.cameras.get(member.photo.camera_key)
        photo = member.photo
        if known is not None:
            return known
        return photo.lens

    def on_map(self) -> Iterator[Member]:
        """Photos that are drawn, in order."""
        return (m for m in self.by_id.values() if m.state in ON_MAP and m.pose is not None)

    def save(self, member: Member, **more: Any) -> None:
        """Stores the state of a photo (inside a transaction of the ledger)."""
        self.ledger.set_photo(
            member.id,
            state=member.state,
            camera=member.camera,
            pose=json.dumps(pose_record(member.pose)) if member.pose is not None else None,
            **more,
        )

    def save_cameras(self, cameras: dict[str, Camera]) -> None:
        """Stores calibrations (inside a transaction of the ledger)."""
        self.cameras.update(cameras)
        with self.ledger.change() as db:
            for key, camera in cameras.items():
                body = {n: float(getattr(camera, n)) for n in PARAMETERS}
                body["readout_s"] = camera.readout_s
                body |= {"width": camera.width, "height": camera.height}
                db.execute("insert or replace into camera values (?, ?)", (key, json.dumps(body)))

    def lonlat(self, xy: np.ndarray) -> list[list[float]]:
        """Longitude and latitude of map coordinates (n, 2) in m; of a map without a place, where
        the page draws it (`STAND_IN`).
        """
        assert self.frame is not None
        assert self._to_wgs is not None
        x0, y0 = self.frame.origin
        lon, lat = self._to_wgs.transform(np.asarray(xy)[:, 0] + x0, np.asarray(xy)[:, 1] + y0)
        return [[round(float(a), 8), round(float(b), 8)] for a, b in zip(lon, lat, strict=True)]


def _multiples(said: Any) -> dict[str, float]:
    """Focal lengths of fisheyes over the reported ones, by camera; without damaged ones."""
    found = said.items() if isinstance(said, dict) else ()
    read = {str(camera): real(multiple, 0.1, 10) for camera, multiple in found}
    return {camera: multiple for camera, multiple in read.items() if multiple is not None}


def _about(said: dict[str, Any]) -> dict[str, Any]:
    """The fields of a member that are stored as JSON in its row."""
    learned = said.get("learned")
    return {
        "tried": int(said.get("tried", 0)),
        "again": int(said.get("again", 0)),
        "learned": None
        if learned is None
        else tuple(np.nan if v is None else float(v) for v in learned),
    }


def about_record(member: Member, why: str) -> dict[str, Any]:
    """The JSON record stored in the row of a photo that was compared with its neighbours."""
    learned = None
    if member.learned is not None:
        learned = [v if np.isfinite(v) else None for v in member.learned]
    return {"tried": member.tried, "again": member.again, "learned": learned, "why": why}


def pose_record(pose: Pose) -> dict[str, list[float]]:
    """A pose as JSON record; floats are preserved exactly."""
    record = {"R": pose.cam_R_map.ravel().tolist(), "C": pose.map_C.tolist()}
    if pose.motion is not None:
        moved = pose.motion
        record |= {"shift": moved.shift_m.tolist(), "turn": moved.turn_rad.tolist()}
    return record


def pose_from(record: dict[str, list[float]]) -> Pose:
    """Reads a pose from its JSON record; raises one of `DAMAGED` where it is none."""
    motion = None
    if "shift" in record:
        shift, turn = (_numbers(record[k], 3) for k in ("shift", "turn"))
        motion = Motion(shift_m=shift, turn_rad=turn)
    R = _numbers(record["R"], 9).reshape(3, 3)
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3:
        raise ValueError("it is no rotation")
    return Pose(cam_R_map=R, map_C=_numbers(record["C"], 3), motion=motion)


def _numbers(values: list[float], count: int) -> np.ndarray:
    found = np.array([real(v, -MOST_M, MOST_M) for v in values[: count + 1]], float)
    if len(found) != count or not np.isfinite(found).all():
        raise ValueError("it is no list of numbers")
    return found


def camera_from(body: str) -> Camera | None:
    """Reads a calibration from its JSON record; None where it is damaged."""
    try:
        said = json.loads(body)
        focal = real(said["focal"], 10, 1e6)
        size = [whole(said[k], 1, 10**5) for k in ("width", "height")]
        rest = [real(said[k], -1e6, 1e6) for k in (*ADJUSTABLE, "readout_s")]
        rest.append(real(said.get("fisheye", 0.0), 0, 1))
        return None if None in (focal, *size, *rest) else Camera(**said)
    except DAMAGED:
        return None
