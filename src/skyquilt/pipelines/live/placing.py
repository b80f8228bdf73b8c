"""Where a photo is: first by its metadata, then by its links to a bounded number of neighbours."""

from collections import OrderedDict, defaultdict, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyquilt.alignment.bundle import Bundle
from skyquilt.alignment.incremental import Incremental, Settled, Window
from skyquilt.alignment.priors import choose_frame
from skyquilt.config import Methods
from skyquilt.errors import AlignmentError
from skyquilt.geometry.frames import angle_difference_deg, angles_from_cam_R_map, cam_R_map_from_angles
from skyquilt.model.camera import Camera
from skyquilt.model.features import Features, Link
from skyquilt.model.poses import Alignment, Pose
from skyquilt.pipelines.intake import THUMBNAIL, Looked, look
from skyquilt.pipelines.live.settings import NEIGHBOURS, YOUNG, LiveSettings
from skyquilt.pipelines.live.state import Member, Members
from skyquilt.run.codec import decode, encode
from skyquilt.run.pixel_cache import PixelCache
from skyquilt.run.store import Store, digest
from skyquilt.surface.cells import HeightCells

NOMINAL_M = 50.0
"""Height above ground where nothing tells it."""
RING = 12
"""Held photos around those that may move."""
MOVING = 4
"""Linked photos that settle together with a new one."""
FEATURES_KEPT = 48
"""Photos whose features stay at hand."""
RECENT = 15
"""Photos of one source by which the next one's metadata are corrected."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Change:
    """What placing one photo did."""

    moved: dict[int, Pose]
    """New poses, by photo."""
    cameras: dict[str, Camera]
    """New calibrations."""
    camera_of: dict[int, str]
    """Calibrations of the photos moved."""
    links: dict[tuple[int, int], Link | None]
    """Pairs compared; None = they do not match."""
    xyz: NDArray[np.float64]
    """(P, 3) ground points in m."""
    reason: str = ""
    """Why the photo is not held by links, where it is not."""


class Placing:
    """First placement, linking, and settling of single photos."""

    def __init__(
        self, members: Members, heights: HeightCells, methods: Methods, store: Store, settings: LiveSettings,
        pixels: PixelCache,
    ) -> None:  # fmt: skip
        self.members, self.heights, self.methods = members, heights, methods
        self.store, self.settings, self.pixels = store, settings, pixels
        self.settle = Incremental()
        self.young = Bundle(per_photo=150, sharpen=None)
        self._features: OrderedDict[int, Features] = OrderedDict()
        self._grid: dict[tuple[int, int], set[int]] = defaultdict(set)
        self._cell_of: dict[int, tuple[int, int]] = {}
        self._recent: dict[str, deque[tuple[float, float]]] = defaultdict(lambda: deque(maxlen=RECENT))
        self._misfit: deque[float] = deque(maxlen=60)
        for member in members.on_map():
            if member.tried:
                self.indexed(member)
        for member in sorted(members.by_id.values(), key=lambda m: m.tried):
            self._remember(member)

    # -- metadata ---------------------------------------------------------------------------------------------

    def frame_from(self, member: Member) -> bool:
        """Makes the map's frame from the first photo that knows where it is."""
        if self.members.frame is None and member.photo.position is not None:
            self.members.set_frame(choose_frame([member.photo], self.settings.crs))
        return self.members.frame is not None

    def first(self, member: Member) -> Pose | None:
        """A pose from metadata, corrected by what earlier photos of the same source have shown; None without place."""
        prior = member.prior
        if prior is None or not np.isfinite(prior.map_C[:2]).all():
            return None
        turn, lift = self._corrections(member)
        yaw = prior.yaw_deg - turn if np.isfinite(prior.yaw_deg) else 0.0
        datum = self.members.frame.vertical_datum if self.members.frame else "unknown"
        z = prior.map_C[2]
        if np.isfinite(lift):
            z = z + lift if np.isfinite(z) else lift
        elif not np.isfinite(z) or (datum == "takeoff" and z < 3):
            z = self.ground_at(prior.map_C) + NOMINAL_M
        R = cam_R_map_from_angles(
            yaw, 0.0 if abs(turn) > 90 else prior.pitch_deg, 0.0 if abs(turn) > 90 else prior.roll_deg
        )
        return Pose(cam_R_map=R, map_C=np.array([prior.map_C[0], prior.map_C[1], z]))

    def _corrections(self, member: Member) -> tuple[float, float]:
        """How far recent photos of the source reported headings (deg) and heights (m) wrongly."""
        found = self._recent.get(f"{member.source}|{member.photo.camera_key}")
        if not found:
            return 0.0, np.nan
        turns = np.array([t for t, _ in found][-3:])
        turns = turns[np.isfinite(turns)]
        unit = np.exp(1j * np.radians(turns))
        agreed = len(turns) > 0 and abs(unit.mean()) > 0.97
        turn = float(np.degrees(np.angle(unit.mean()))) if agreed else 0.0
        lifts = np.array([x for _, x in found])
        lift = float(np.median(lifts[np.isfinite(lifts)])) if np.isfinite(lifts).any() else np.nan
        return (turn if abs(turn) > 10 else 0.0), lift

    def learn(self, member: Member) -> None:
        """Compares what a photo that has just settled reported with where it is; `member.learned` keeps it."""
        assert member.pose is not None
        assert member.prior is not None
        yaw, _, _ = angles_from_cam_R_map(member.pose.cam_R_map)
        off = member.pose.map_C - member.prior.map_C
        turn = (
            angle_difference_deg(member.prior.yaw_deg, yaw) if np.isfinite(member.prior.yaw_deg) else np.nan
        )
        lift = float(off[2]) if np.isfinite(off[2]) else float(member.pose.map_C[2])
        member.learned = float(turn), lift, float(np.hypot(off[0], off[1]))
        self._remember(member)

    def _remember(self, member: Member) -> None:
        if member.learned is None:
            return
        turn, lift, misfit = member.learned
        self._recent[f"{member.source}|{member.photo.camera_key}"].append((turn, lift))
        if np.isfinite(misfit):
            self._misfit.append(misfit)

    def ground_at(self, xyz: NDArray) -> float:
        """Height of the ground near a place in m."""
        reach = 60.0
        x, y = float(xyz[0]), float(xyz[1])
        near = (
            self.heights.median((x - reach, y - reach, x + reach, y + reach)) if np.isfinite(x + y) else None
        )
        return near if near is not None else float(self.members.ledger.meta("ground", 0.0))

    # -- neighbours -------------------------------------------------------------------------------------------

    @property
    def cell(self) -> float:
        """Side in m of the cells of the index of places."""
        return 30.0

    def indexed(self, member: Member) -> None:
        """Enters a photo that others may be compared with, or moves it."""
        if member.pose is None:
            return
        c, r = np.floor(member.pose.map_C[:2] / self.cell).astype(int).tolist()
        old = self._cell_of.get(member.id)
        if old is not None and old != (c, r):
            self._grid[old].discard(member.id)
        self._cell_of[member.id] = (c, r)
        self._grid[c, r].add(member.id)

    @staticmethod
    def aim(pose: Pose, ground: float) -> NDArray[np.float64]:
        """Where the middle of a photo lies (2,) in m on a ground of that height."""
        ray = pose.cam_R_map[2]
        drop = (ground - pose.map_C[2]) / min(float(ray[2]), -0.3)
        return np.asarray(pose.map_C[:2] + ray[:2] * drop)

    def neighbours(self, member: Member, pose: Pose | None, most: int = NEIGHBOURS) -> list[int]:
        """Photos of the same spectrum, compared before, nearest first; the latest where nothing tells the place."""
        if pose is None:
            return self._latest(member, most)
        photo = member.photo
        ground = self.ground_at(pose.map_C)
        at = self.aim(pose, ground)
        above = max(float(pose.map_C[2]) - ground, 2.0)
        reach = above * max(photo.width, photo.height) / photo.focal.px + 2 * self.scatter()
        found = []
        for i in self._near(at, reach + above):
            other = self.members.by_id[i]
            if i == member.id or other.photo.band != photo.band or other.state == "superseded":
                continue
            apart = np.inf if other.pose is None else float(np.hypot(*(self.aim(other.pose, ground) - at)))
            if apart <= reach:
                found.append((apart, i))
        return [i for _, i in sorted(found)[:most]]

    def _near(self, at: NDArray, reach: float) -> list[int]:
        """Photos taken from above a square around a place; cameras that look aslant stand beside what they see."""
        rings = int(np.ceil(reach / self.cell))
        c, r = np.floor(at / self.cell).astype(int).tolist()
        return [i for dc in range(-rings, rings + 1) for dr in range(-rings, rings + 1)
                for i in self._grid.get((c + dc, r + dr), ())]  # fmt: skip

    def _latest(self, member: Member, most: int) -> list[int]:
        found = []
        for i in reversed(self.members.by_id):
            other = self.members.by_id[i]
            if (
                other.tried
                and other.pose is not None
                and other.photo.band == member.photo.band
                and i != member.id
            ):
                found.append((other.source != member.source, i))
            if len(found) >= most:
                break
        return [i for _, i in sorted(found, key=lambda f: f[0])]

    def scatter(self) -> float:
        """Deviation per axis in m of reported positions as the map has shown it."""
        return float(np.median(self._misfit)) / 1.18 if len(self._misfit) >= 5 else 0.0

    # -- links ------------------------------------------------------------------------------------------------

    def has_features(self, number: int) -> bool:
        """Whether a photo's features are at hand."""
        return number in self._features

    def features(self, number: int) -> Features:
        """Features of a photo: at hand, from the store, or found now."""
        if number in self._features:
            self._features.move_to_end(number)
            return self._features[number]
        photo = self.members.by_id[number].photo
        key = digest(photo.digest, self.methods.sift, THUMBNAIL)
        looked: Looked = self.store.get_or(
            "features", key, lambda: look(photo, number, self.pixels, self.methods, self.store)
        )
        self._features[number] = looked.features
        while len(self._features) > FEATURES_KEPT:
            self._features.popitem(last=False)
        return looked.features

    def compared(self, member: Member, others: Sequence[int]) -> dict[tuple[int, int], Link | None]:
        """Links to others; None where a pair does not match."""
        own = self.features(member.id)
        found: dict[tuple[int, int], Link | None] = {}
        for i in others:
            theirs = self.features(i)
            matches = self.methods.mutual(theirs, own)
            link = self.methods.verify(i, member.id, theirs, own, matches, self.members.by_id[i].photo.width)
            found[i, member.id] = link if isinstance(link, Link) else None
        return found

    def links_among(self, ids: Iterable[int]) -> list[Link]:
        """Known links between these photos."""
        inside = set(ids)
        pairs = sorted({(min(i, j), max(i, j)) for i in inside for j in self.members.by_id[i].links & inside})
        return [k for a, b in pairs if (k := self.link(a, b)) is not None]

    def link(self, a: int, b: int) -> Link | None:
        """A known link; None where there is none."""
        for i, j in ((a, b), (b, a)):
            row = self.members.ledger.row("select body from link where a = ? and b = ?", i, j)
            if row is not None and row[0] is not None:
                return link_from(row[0])
        return None

    # -- settling ---------------------------------------------------------------------------------------------

    def refine(self, member: Member) -> Change:
        """Compares a photo with its neighbours and settles it among them; nothing is written."""
        links = self.compared(member, self.neighbours(member, member.pose))
        good = {key: k for key, k in links.items() if k is not None}
        if not good:
            why = "no neighbour shows the same ground recognisably" if links else "nothing is near it yet"
            return Change(moved={}, cameras={}, camera_of={}, links=links, xyz=np.zeros((0, 3)), reason=why)
        return self._joined(member, links, good)

    def _joined(
        self, member: Member, links: dict[tuple[int, int], Link | None], good: dict[tuple[int, int], Link]
    ) -> Change:
        whole = {member.id}
        for a, _ in good:
            whole |= self.members.block(a)
        if self.settings.reposition and len(whole) <= YOUNG:
            done = self._bundled(sorted(whole), good)
            if isinstance(done, Alignment):
                ids = sorted(whole)
                return Change(
                    moved={ids[k]: p for k, p in done.poses.items()}, cameras=dict(done.cameras),
                    camera_of={ids[k]: done.camera_of[k] for k in done.poses}, links=links, xyz=done.ties.xyz,
                    reason=done.rejected.get(ids.index(member.id), ""),
                )  # fmt: skip
        return self._settled(member, links, good)

    def _bundled(self, ids: Sequence[int], good: dict[tuple[int, int], Link]) -> Alignment | None:
        """A small block bundled as a whole."""
        where = {i: k for k, i in enumerate(ids)}
        links = [_renumbered(k, where) for k in [*self.links_among(ids), *good.values()]]
        members = [self.members.by_id[i] for i in ids]
        priors = [m.prior for m in members if m.prior is not None]
        assert self.members.frame is not None
        try:
            return self.young(
                [m.photo for m in members], self.members.frame, priors, [self.features(i) for i in ids], links
            )
        except (AlignmentError, np.linalg.LinAlgError, ValueError):
            return None

    def _settled(
        self, member: Member, links: dict[tuple[int, int], Link | None], good: dict[tuple[int, int], Link]
    ) -> Change:
        """A photo that joins a larger block: its window adjusted, everything around it held."""
        direct = sorted({a for a, _ in good if self.members.by_id[a].pose is not None})
        by_strength = sorted(direct, key=lambda a: (-len(good[a, member.id]), a))
        moving = set(by_strength[:MOVING]) if self.settings.reposition else set()
        ring = {
            j for i in moving for j in self.members.by_id[i].links if self.members.by_id[j].pose is not None
        }
        ring -= {member.id, *direct}
        kept = sorted(ring, key=lambda j: (-len(self.members.by_id[j].links & moving), j))[:RING]
        ids = sorted({member.id, *direct, *kept})
        held = frozenset(ids) - moving - {member.id}
        done = self.settle(self.window(member, ids, held, list(good.values())))
        if not isinstance(done, Settled):
            return Change(
                moved={}, cameras={}, camera_of={}, links=links, xyz=np.zeros((0, 3)), reason=done.reason
            )
        for key in done.dropped:
            links[ids[key[0]], ids[key[1]]] = None
        moved = {ids[k]: p for k, p in done.poses.items()}
        camera_of = {i: self.members.by_id[i].camera for i in moved} | {member.id: done.camera}
        return Change(moved=moved, cameras={}, camera_of=camera_of, links=links, xyz=done.xyz)

    def window(
        self, member: Member, ids: Sequence[int], held: frozenset[int], more: Sequence[Link]
    ) -> Window:
        """A window of these photos; `more` links than those written down."""
        where = {i: k for k, i in enumerate(ids)}
        members = [self.members.by_id[i] for i in ids]
        known = {(k.a, k.b) for k in more}
        links = [*(k for k in self.links_among(ids) if (k.a, k.b) not in known), *more]
        placed = {where[m.id]: m.pose for m in members if m.pose is not None and m.id != member.id}
        cameras: dict[str, Camera] = {}
        for m in members:
            cameras[m.photo.camera_key] = self.members.cameras.get(m.photo.camera_key) or self.members.camera(
                m
            )
            if m.camera:
                cameras[m.camera] = self.members.camera(m)
        at = (
            member.pose.map_C
            if member.pose is not None
            else members[0].pose.map_C
            if members[0].pose
            else np.zeros(3)
        )
        return Window(
            photos=[m.photo for m in members], priors=[m.prior for m in members if m.prior is not None],
            features=[self.features(i) for i in ids], links=[_renumbered(k, where) for k in links], poses=placed,
            cameras=cameras, camera_of={where[m.id]: m.camera for m in members}, new=where[member.id],
            held=frozenset(where[i] for i in held), ground=self.ground_at(at), sigma_xy=self.scatter(),
        )  # fmt: skip


def _renumbered(link: Link, where: dict[int, int]) -> Link:
    return Link(
        a=where[link.a], b=where[link.b], index_a=link.index_a, index_b=link.index_b, b_S_a=link.b_S_a
    )


def link_bytes(link: Link) -> bytes:
    """A link for the ledger."""
    return encode(
        {"a": link.a, "b": link.b, "ia": link.index_a.astype(np.int32), "ib": link.index_b.astype(np.int32),
         "s": complex(link.b_S_a)}
    )  # fmt: skip


def link_from(body: bytes) -> Link:
    """The link of such bytes."""
    d = decode(body, {})
    return Link(
        a=d["a"], b=d["b"], index_a=d["ia"].astype(np.int64), index_b=d["ib"].astype(np.int64), b_S_a=d["s"]
    )
