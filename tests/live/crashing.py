"""A replay in a process of its own that kills itself: at a named point, at a write that is torn, or
at a moment.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from skyquilt.live import inbox
from skyquilt.live import ledger as crash_points
from skyquilt.live.folder_watch import Watch
from skyquilt.live.live_map import LiveMap
from skyquilt.live.settings import LiveSettings
from skyquilt.server.published_files import PublishedFiles
from skyquilt.server.survey import LiveSurvey


def die(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def arm(point: str, count: int) -> None:
    """Dies when a point is reached for the count-th time; `torn` dies in the middle of writing a
    photo's file.
    """
    left = [count]

    def watcher(name: str) -> None:
        left[0] -= name == point
        if left[0] == 0:
            die()

    crash_points.watcher = watcher
    if point == "torn":
        honest = inbox.Inbox.bring

        def torn(self, blocks):
            left[0] -= 1
            if left[0] == 0:
                (self.folder / "torn.partial").write_bytes(next(iter(blocks))[:1000])
                die()
            return honest(self, blocks)

        inbox.Inbox.bring = torn


def main(folder: Path, photos: Path, point: str, count: int) -> None:
    began = time.monotonic()
    if point == "time":
        signal.signal(signal.SIGALRM, die)
        signal.setitimer(signal.ITIMER_REAL, count / 1000)
    elif point:
        arm(point, count)
    live = LiveMap(folder, LiveSettings(deterministic=True, features=600))
    watch = Watch(folder=photos, intake=live.intake)
    names = sorted(p.name for p in photos.glob("*.jpg"))
    while True:
        # one file at a time, in order of names: the order of acceptance is then the same in every
        # replay
        for _ in watch.look():
            break
        if live.work() is not None:
            continue
        if live.ledger.row("select count(*) from photo")[0] >= len(names) and live.work() is None:
            break
        time.sleep(0.01)
    signal.setitimer(
        signal.ITIMER_REAL, 0
    )  # the work is done; dying while it is reported would mean nothing
    PublishedFiles(LiveSurvey(folder), folder).step(now=True)
    poses = {
        m.photo.name: [m.pose.map_C.tolist(), m.pose.cam_R_map.tolist()]
        for m in live.members.on_map()
    }
    for layer in live.tiles.layers():
        for level in range(9):
            for address in live.tiles.addresses(layer, level):
                assert live.tiles.get(address) is not None
    sys.stdout.write(
        json.dumps(
            {"poses": poses, "states": live.ledger.counts(), "seconds": time.monotonic() - began}
        )
    )
    live.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]))
