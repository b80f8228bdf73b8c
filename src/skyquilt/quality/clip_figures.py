"""The figures of clips: which frames were chosen, and why."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from skyquilt.model.clip import ChosenFrame, ChosenFrames
from skyquilt.quality.placement import finite


def clip_figures(clips: Sequence[ChosenFrames]) -> dict[str, Any]:
    """`clips` of metrics.json; empty where there are none."""
    return {"clips": [_clip(c) for c in clips]} if clips else {}


def _clip(clip: ChosenFrames) -> dict[str, Any]:
    overlaps = [f.overlap for f in clip.chosen if np.isfinite(f.overlap)]
    return {
        "name": clip.clip,
        "frames_looked_at": clip.looked,
        "frames_chosen": len(clip.chosen),
        "frames_with_position": clip.placed,
        "blurred": clip.blurred,
        "standing_still": clip.still,
        "overlap_wanted": clip.overlap,
        "overlap_median": round(float(np.median(overlaps)), 4) if overlaps else None,
        "clock_offset_s": round(clip.offset_s, 3),
        "clock_offset_sigma_s": finite(clip.offset_sigma_s),
        "clock_offset_source": clip.offset_source,
        "focal_prior_px": round(clip.focal.px, 1),
        "focal_prior_sigma_px": round(clip.focal.sigma_px, 1),
        "focal_source": clip.focal.source,
        "readout_prior_ms": round(1000 * clip.shutter.readout_s, 2),
        "readout_prior_sigma_ms": round(1000 * clip.shutter.sigma_s, 2),
        "readout_source": clip.shutter.source,
        "frames": [_frame(clip, f) for f in clip.chosen],
    }


def _frame(clip: ChosenFrames, frame: ChosenFrame) -> dict[str, Any]:
    return {
        "name": clip.name(frame),
        "time_s": round(frame.time_s, 4),
        "overlap": finite(frame.overlap),
        "sharpness": round(frame.sharp, 3),
        "why": frame.reason,
    }
