"""Photo by photo: each new photo is linked to its neighbours among the earlier ones.

Stages are plain objects. They can be used one at a time, without a workflow, as photos arrive.

python examples/02_photo_by_photo.py PHOTOS
"""

import sys
from pathlib import Path

import numpy as np

import skyquilt
from skyquilt.alignment.priors import choose_frame, priors
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.sift import Sift
from skyquilt.matching.verify import Verify
from skyquilt.model.features import Features, Link
from skyquilt.photos.pixels import read_color

NEIGHBOURS = 4


def main(folder: Path) -> None:
    survey = skyquilt.read_survey(folder)
    for photo in survey.rejected:
        print(f"{photo.name} was left out: {photo.reason}")
    frame = choose_frame(survey.photos, None)
    place = np.array(
        [p.map_C[:2] for p in priors(survey.photos, frame)]
    )  # m in local UTM, NaN where unknown
    detect, match, verify = Sift(count=1000), Mutual(), Verify()
    features: list[Features] = []
    links: list[Link] = []
    for new, photo in enumerate(survey.photos):
        features.append(detect(read_color(photo)))
        told = []
        for old in nearest(place, new):
            link = verify(
                old,
                new,
                features[old],
                features[new],
                match(features[old], features[new]),
                photo.width,
            )
            if link:
                links.append(link)
                told.append(f"{survey.photos[old].name} ({len(link)})")
            else:
                told.append(f"not {survey.photos[old].name}: {link.reason}")
        print(f"{photo.name}: {', '.join(told) or 'the first'}")
    print(f"{len(survey.photos)} photos, {len(links)} links, frame {frame.crs}")


def nearest(place: np.ndarray, new: int) -> list[int]:
    """Earlier photos, nearest first; the last ones where positions are unknown."""
    distance = np.hypot(*(place[:new] - place[new]).T)
    order = np.argsort(
        np.where(np.isfinite(distance), distance, 1e9 - np.arange(new)), kind="stable"
    )
    return [int(k) for k in order[:NEIGHBOURS]]


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
