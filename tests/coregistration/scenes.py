"""One layout seen in two spectra: edges in the same places, brightness on either side of them
unrelated.
"""

import cv2
import numpy as np


def layout(height=400, width=480, seed=0):
    """(height, width) labels of overlapping polygons, strips and discs on a patchwork of fields."""
    rng = np.random.default_rng(seed)
    labels = np.zeros((height, width), np.int32)
    for k in range(1, 90):
        x, y = rng.integers(0, width), rng.integers(0, height)
        size = rng.integers(8, 60)
        if k % 5 == 0:
            end = (int(rng.integers(0, width)), int(rng.integers(0, height)))
            cv2.line(labels, (int(x), int(y)), end, k, int(rng.integers(2, 7)))
        elif k % 5 == 1:
            cv2.circle(labels, (int(x), int(y)), int(size // 2), k, -1)
        else:
            angle = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 6))))
            corners = np.c_[x + size * np.cos(angle), y + size * np.sin(angle)]
            cv2.fillPoly(labels, [np.rint(corners).astype(np.int32)], k)
    return labels


def spectrum(labels, seed, noise=3.0, blur=0.8):
    """(height, width) float32: every label its own random brightness, some of them alike."""
    rng = np.random.default_rng(1000 + seed)
    levels = rng.choice(np.linspace(30, 220, 7), labels.max() + 1)
    picture = cv2.GaussianBlur(levels[labels].astype(np.float32), (0, 0), blur)
    return picture + rng.normal(0, noise, labels.shape).astype(np.float32)


def turned(scale, degrees, shape_a, shape_b, shift=(0.0, 0.0)):
    """b_H_a of a similarity about both middles."""
    c, s = scale * np.cos(np.radians(degrees)), scale * np.sin(np.radians(degrees))
    ca = np.array([(shape_a[1] - 1) / 2, (shape_a[0] - 1) / 2])
    cb = np.array([(shape_b[1] - 1) / 2, (shape_b[0] - 1) / 2]) + shift
    t = cb - np.array([[c, -s], [s, c]]) @ ca
    return np.array([[c, -s, t[0]], [s, c, t[1]], [0, 0, 1]])


def pair(b_H_a, shape_b=(400, 480), seed=0, noise=3.0, shape_a=(400, 480)):
    """Pictures a and b, 8 bits, of one layout in two spectra; b is black where a ends."""
    labels = layout(*shape_a, seed=seed)
    a = spectrum(labels, seed, noise)
    b = spectrum(labels, seed + 1, noise)
    size = (shape_b[1], shape_b[0])
    b = cv2.warpPerspective(b, b_H_a, size, flags=cv2.INTER_CUBIC)
    return np.clip(a, 0, 255).astype(np.uint8), np.clip(b, 0, 255).astype(np.uint8)


def error(found, truth, shape=(400, 480)):
    """Largest distance in px of b at nine points of a."""
    x, y = np.meshgrid(np.linspace(60, shape[1] - 60, 3), np.linspace(60, shape[0] - 60, 3))
    p = np.stack([x.ravel(), y.ravel(), np.ones(9)])
    q, r = found @ p, truth @ p
    return float(np.linalg.norm(q[:2] / q[2] - r[:2] / r[2], axis=0).max())
