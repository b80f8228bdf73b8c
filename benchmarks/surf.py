"""Skyquilt's SURF compared with OpenCV's detectors: time, repeatability and matching score under
known transformations.

    python benchmarks/surf.py [PHOTO ...] [-o FILE]

Without photos, a simulated texture is used. A photo is reduced to 1000 px and transformed; the true
transformation is known. OpenCV's own SURF cannot be compared, since no wheel contains it. If
mahotas is installed, its SURF is measured too.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from skyquilt.geometry.transforms import transfer
from skyquilt.imaging.grey import shrink, to_grey8
from skyquilt.matching.binary_features import Akaze, Orb
from skyquilt.matching.matchers import Mutual
from skyquilt.matching.sift import Sift
from skyquilt.model.features import Features
from skyquilt.papers.harris import Harris
from skyquilt.papers.surf import Surf

try:
    from mahotas.features import surf as mahotas_surf
except ImportError:
    mahotas_surf = None

COUNT = 1500
METHODS = {
    "SIFT": Sift(count=COUNT, longest=1000),
    "SURF": Surf(count=COUNT),
    "SURF-128": Surf(count=COUNT, length=128),
    "U-SURF": Surf(count=COUNT, upright=True),
    "Harris": Harris(count=COUNT),
    "ORB": Orb(count=COUNT),
    "AKAZE": Akaze(count=COUNT),
}


def by_mahotas(image):
    """Another implementation of SURF, for comparison."""
    p = mahotas_surf.surf(image, 4, 6, 1, threshold=0.1, max_points=COUNT)
    return Features(
        px=p[:, [1, 0]].astype(float),
        size=20 * p[:, 2].astype(np.float32),
        descriptors=p[:, 6:].astype(np.float32),
        scale=1.0,
    )


if mahotas_surf is not None:
    METHODS["mahotas SURF"] = by_mahotas
WARPS = {
    "rotation 10": (10, 1, 0),
    "rotation 45": (45, 1, 0),
    "rotation 90": (90, 1, 0),
    "rotation 137": (137, 1, 0),
    "scale 0.8": (0, 0.8, 0),
    "scale 0.6": (0, 0.6, 0),
    "scale 0.5": (0, 0.5, 0),
    "scale 0.6, 30": (30, 0.6, 0),
    "blur 1": (0, 1, 1.0),
    "blur 2": (0, 1, 2.0),
    "noise": (0, 1, -1),
}


def warped(image, angle, scale, blur):
    """The image turned and scaled about its centre, blurred (or noisy where negative); b_H_a (3,
    3).
    """
    h, w = image.shape
    H = np.vstack([cv2.getRotationMatrix2D(((w - 1) / 2, (h - 1) / 2), angle, scale), [0, 0, 1]])
    soft = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / scale**2 - 1)) if scale < 1 else image
    out = cv2.warpAffine(soft, H[:2], (w, h), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    if blur > 0:
        out = cv2.GaussianBlur(out, (0, 0), blur)
    if blur < 0:
        noise = np.random.default_rng(0).normal(0, 6, image.shape)
        out = np.clip(0.8 * out + 15 + noise, 0, 255).astype(np.uint8)
    return out, H


def scores(method, image, angle, scale, blur, near=2.0):
    """(repeatability, matching score, precision): shares of the keypoints of `image` that the warp
    still shows.

    Repeated: the warp has a keypoint within `near` px of the place. Matched: and it is what Mutual
    pairs it with.
    """
    other, H = warped(image, angle, scale, blur)
    a, b = method(image), method(other)
    expected = transfer(H, a.px)
    h, w = image.shape
    margin = 20
    shown = ((expected > margin) & (expected < (w - margin, h - margin))).all(1)
    distance = np.sqrt(((expected[:, None] - b.px[None]) ** 2).sum(-1))
    repeated = (distance.min(1) < near) & shown
    found = Mutual()(a, b)
    right = distance[found.index_a, found.index_b] < near
    total = shown.sum()
    return (
        repeated.sum() / total,
        (right & shown[found.index_a]).sum() / total,
        right.mean() if len(right) else 0.0,
    )


def cpu_ms(method, image, runs=9):
    """Median CPU time of a run in ms, the first left out; OpenCV in one thread."""
    times = []
    for _ in range(runs + 1):
        start = time.process_time()
        method(image)
        times.append(time.process_time() - start)
    return 1000 * float(np.median(times[1:]))


def simulated():
    """Fields and paths from the simulator's generator of ground."""
    import tempfile

    from skyquilt import simulate as sim

    with tempfile.TemporaryDirectory() as folder:
        from dataclasses import replace

        settings = sim.preset("demo")
        settings = replace(settings, route=replace(settings.route, photos=1))
        for _ in sim.simulate(settings, Path(folder) / "s"):
            pass
        return cv2.imread(str(next((Path(folder) / "s" / "photos").glob("*.[jJ]*"))), 0)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    images = [
        to_grey8(shrink(cv2.imread(str(p)), 1000)[0][..., ::-1].copy()) for p in arguments.photos
    ] or [simulated()]
    lines = [
        f"{len(images)} photo(s), {COUNT} keypoints at most, longest side 1000 px, one thread",
        "",
    ]
    reference = cpu_ms(METHODS["SIFT"], images[0])
    raw = cv2.SIFT.create(COUNT)
    bare = cpu_ms(lambda g: raw.detectAndCompute(g, None), images[0])
    lines += ["| method | CPU ms | over OpenCV's SIFT | keypoints |", "|---|---|---|---|"]
    lines.append(f"| cv2.SIFT | {bare:.0f} | 1.00 | {COUNT} |")
    for name, method in METHODS.items():
        ms = reference if name == "SIFT" else cpu_ms(method, images[0])
        lines.append(f"| {name} | {ms:.0f} | {ms / bare:.2f} | {len(method(images[0]))} |")
    lines += ["", "repeatability / matching score / precision in %, means over the photos", ""]
    lines += ["| warp | " + " | ".join(METHODS) + " |", "|---" * (len(METHODS) + 1) + "|"]
    for name, warp in WARPS.items():
        row = []
        for method in METHODS.values():
            row.append(
                "{:.0f} / {:.0f} / {:.0f}".format(
                    *(100 * np.mean([scores(method, i, *warp) for i in images], axis=0))
                )
            )
        lines.append(f"| {name} | " + " | ".join(row) + " |")
    text = "\n".join(lines)
    print(text)
    if arguments.output:
        arguments.output.write_text(text + "\n")


if __name__ == "__main__":
    main()
