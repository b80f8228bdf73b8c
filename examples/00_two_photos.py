"""Match two photos and print how they are linked.

python examples/00_two_photos.py A.jpg B.jpg
"""

import sys
from pathlib import Path

import numpy as np

from skyquilt.matching.matchers import Mutual
from skyquilt.matching.sift import Sift
from skyquilt.matching.verify import Verify
from skyquilt.model.photo import Photo, RejectedPhoto
from skyquilt.photos.pixels import read_color
from skyquilt.photos.read import read_photo


def place(photo: Photo) -> str:
    if photo.position is None:
        return "no position"
    return f"at {photo.position.latitude_deg:.6f}, {photo.position.longitude_deg:.6f}"


def main(first: Path, second: Path) -> None:
    a, b = read_photo(first), read_photo(second)
    for photo in (a, b):
        if isinstance(photo, RejectedPhoto):  # a file that is no photo is a value with its reason
            sys.exit(f"{photo.name} was left out: {photo.reason}")
        print(f"{photo.name}: {photo.width} x {photo.height} px, {place(photo)}")
        print(f"  focal length {photo.focal.px:.0f} px, known from: {photo.focal.source}")

    detect, match, verify = Sift(), Mutual(), Verify()
    features_a, features_b = detect(read_color(a)), detect(read_color(b))
    matches = match(features_a, features_b)
    link = verify(0, 1, features_a, features_b, matches, a.width)
    print(f"{len(features_a)} and {len(features_b)} features, {len(matches)} matches")
    if not link:
        print(f"no link: {link.reason}")
        return
    print(
        f"linked by {len(link)} matches; b shows the ground {abs(link.b_S_a):.3f} times as large as"
        " a,"
    )
    print(f"turned by {np.degrees(np.angle(link.b_S_a)):.1f} degrees")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
