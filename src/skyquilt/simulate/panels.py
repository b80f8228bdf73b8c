"""Painter of solar parks: rows of tables whose modules are all alike."""

import numpy as np

from skyquilt.simulate import materials as m
from skyquilt.simulate.canvas import Canvas
from skyquilt.simulate.layout import Layout

_PITCH_M = 8.0
_DEPTH_M = 3.6  # as seen from above; two modules, one above the other
_MODULE_M = 1.1
_FRAME_M = 0.08
_TABLE_M = 17.6  # sixteen modules, then a gap
_GAP_M = 0.6
_RISE = 0.45  # tangent of the tilt to the south
_LOW_M = 0.8
_BORDER_M = 3.0


def paint_panels(canvas: Canvas, layout: Layout) -> None:
    """Paints rows of tables along the map's x axis on all parcels of panels."""
    parcels = [p for p in layout.parcels if p.kind == "panels" and canvas.touches(p.outline, 0.0)]
    if not parcels:
        return
    x, y = canvas.grid.xs[None, :], canvas.grid.ys[:, None]
    up, along = np.mod(y, _PITCH_M), np.mod(x, _TABLE_M + _GAP_M)
    table = (up < _DEPTH_M) & (along < _TABLE_M)
    edge = (np.mod(along, _MODULE_M) < _FRAME_M) | (np.mod(up, _DEPTH_M / 2) < _FRAME_M)
    top = (canvas.ground + _LOW_M + _RISE * up).astype(np.float32)
    for parcel in parcels:
        inside = canvas.polygon(parcel.outline) > 0.99
        inside &= canvas.line(parcel.outline, 2 * _BORDER_M) == 0
        cover = inside & table
        canvas.lay(m.PANEL, cover, 0.02 * canvas.grain)
        canvas.lay(m.FRAME, cover & edge)
        canvas.height[...] = np.where(cover, top, canvas.height)
