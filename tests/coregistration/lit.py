"""Rough ground of many materials under two suns: in colour under the one, in warmth under the
other.

A light of its own, apart from the simulator's: Lambert's cosine and hard shadows in linear light, a
sky as blue as asked for, the camera's gamma. Warmth follows the sun on the slope. Colours and
temperatures belong to the material.
"""

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from tests.coregistration.scenes import layout


def relief(labels, rng):
    """(h, w) heights in px: every material rough in its own way, in rows or at random, some
    standing a few px high.
    """
    y, x = np.mgrid[: labels.shape[0], : labels.shape[1]].astype(float)
    z, clods = np.zeros(labels.shape), 2.5 * gaussian_filter(rng.standard_normal(labels.shape), 1.5)
    for k in range(labels.max() + 1):
        mine = labels == k
        if k % 3 == 0:
            angle, length = rng.uniform(0, np.pi), rng.uniform(5, 9)
            z[mine] = 0.5 * np.cos(
                2 * np.pi * (x[mine] * np.cos(angle) + y[mine] * np.sin(angle)) / length
            )
        else:
            z[mine] = clods[mine]
        z[mine] += rng.uniform(1, 4) if k % 4 == 1 else 0
    return gaussian_filter(z, 0.7)


def sunlit(z, azimuth_deg, height_deg):
    """(h, w) cosine of the sun on the slope, 0 in shadow."""
    a, h = np.radians(azimuth_deg), np.radians(height_deg)
    sun = np.array([np.cos(h) * np.cos(a), np.cos(h) * np.sin(a), np.sin(h)])
    gy, gx = np.gradient(z)
    facing = np.clip((sun[2] - sun[0] * gx - sun[1] * gy) / np.sqrt(1 + gx**2 + gy**2), 0, None)
    rows, columns = z.shape
    y, x = np.mgrid[:rows, :columns].astype(np.float32)
    dark = np.zeros(z.shape, bool)
    for step in range(1, int(np.ptp(z) / np.tan(h)) + 2):
        there = cv2.remap(
            z.astype(np.float32),
            x + np.float32(step * np.cos(a)),
            y + np.float32(step * np.sin(a)),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        dark |= there > z + step * np.tan(h) + 0.05
    return np.where(dark, 0, facing)


def rough_ground(seed, b_H_a, morning=(-60.0, 40.0), later=(75.0, 30.0), sky=(0.25, 0.32, 0.45)):
    """An RGB picture a, 8 bits, and the warmth b as float32, moved by a transform; suns by azimuth
    and height in degrees.
    """
    rng = np.random.default_rng(seed)
    labels = layout(500, 560, seed)
    z = relief(labels, rng)
    reflects = rng.uniform(0.08, 0.5, (labels.max() + 1, 3))[labels]
    reflects *= (
        1 + 0.25 * np.tanh(z - gaussian_filter(z, 4))[..., None]
    )  # hollows are darker, in all bands
    light = sunlit(z, *morning)[..., None] * np.array([1.0, 0.95, 0.85]) + np.array(sky)
    linear = gaussian_filter(reflects * light, (0.7, 0.7, 0))
    a = 255 * np.clip(linear / np.percentile(linear, 99.5), 0, 1) ** (1 / 2.2) + rng.normal(
        0, 1.5, linear.shape
    )
    warmth = rng.uniform(0, 8, labels.max() + 1)[labels] + 8 * sunlit(z, *later)
    b = gaussian_filter(warmth, 0.8) + rng.normal(0, 0.05, warmth.shape)
    moved = cv2.warpPerspective(b.astype(np.float32), b_H_a, b.shape[::-1], flags=cv2.INTER_CUBIC)
    return np.clip(a, 0, 255).astype(np.uint8), moved
