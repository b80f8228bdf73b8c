"""The interior orientation of a camera, and the distortion terms that lens models use."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

PARAMETERS = ("focal", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "aspect", "fisheye")
"""Order of the intrinsics in every parameter vector and covariance of the project. The last one
tells the kind of lens; it is never estimated.
"""
ADJUSTABLE = PARAMETERS[:-1]
"""The intrinsics that may be estimated."""
SQUARE = PARAMETERS[:-2]
"""The intrinsics of a camera with square pixels: what views of a board determine."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Pinhole or fisheye with Brown's distortion in OpenCV's direction (undistorted -> distorted).

    Coordinates in the image plane (units of the focal length) are those of a pinhole everywhere. A
    fisheye shows a ray at the angle from its axis in rad where a pinhole shows it at the tangent;
    Brown's polynomial follows in both, so a fisheye without tangential terms is OpenCV's fisheye
    model (Kannala and Brandt 2006) with three of its four coefficients.

    Pixel centres lie at integer coordinates: the image spans [-0.5, width - 0.5] x [-0.5, height -
    0.5].
    """

    width: int
    """Image width in px."""
    height: int
    """Image height in px."""
    focal: float
    """Focal length in px along the rows (fx)."""
    cx: float
    """Principal point, x, in px."""
    cy: float
    """Principal point, y, in px."""
    k1: float = 0.0
    """Radial coefficient of r^2 (r in units of the focal length)."""
    k2: float = 0.0
    """Radial coefficient of r^4."""
    k3: float = 0.0
    """Radial coefficient of r^6."""
    p1: float = 0.0
    """Tangential coefficient, OpenCV's p1."""
    p2: float = 0.0
    """Tangential coefficient, OpenCV's p2."""
    aspect: float = 1.0
    """Focal length along the columns (fy) over that along the rows."""
    fisheye: float = 0.0
    """1.0 for a fisheye (equidistant), 0.0 for a pinhole."""
    readout_s: float = 0.0
    """Time in s from the exposure of the first row to that of the last; 0 = all rows at once."""
    sigma_readout_s: float | None = field(default=None, compare=False)
    """Standard deviation of `readout_s` in s."""
    sigmas: tuple[float, ...] | None = field(default=None, compare=False)
    """Standard deviations of `PARAMETERS` in that order, where an adjustment or a source gives
    them.
    """

    @property
    def vector(self) -> NDArray[np.float64]:
        """The intrinsics as (10,), in the order of `PARAMETERS`."""
        return np.array([getattr(self, name) for name in PARAMETERS], dtype=np.float64)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The (3, 3) matrix K in px."""
        return np.array(
            [[self.focal, 0, self.cx], [0, self.focal * self.aspect, self.cy], [0, 0, 1]],
            dtype=np.float64,
        )

    @classmethod
    def ideal(cls, *, width: int, height: int, focal: float) -> "Camera":
        """A camera without distortion whose principal point is the image centre."""
        return cls(width=width, height=height, focal=focal, cx=(width - 1) / 2, cy=(height - 1) / 2)

    def rescaled(self, width: int, height: int) -> "Camera":
        """The same lens on an image of another size in px with the same field of view."""
        s = max(width, height) / max(self.width, self.height)
        if s == 1.0:
            return self
        sigmas = self.sigmas and (*(v * s for v in self.sigmas[:3]), *self.sigmas[3:])
        return replace(
            self,
            width=width,
            height=height,
            focal=self.focal * s,
            cx=(self.cx + 0.5) * s - 0.5,
            cy=(self.cy + 0.5) * s - 0.5,
            sigmas=sigmas,
        )

    def reduced(self, width: int, height: int) -> "Camera":
        """The lens on a picture that shows all of the image on fewer px: both sides are rounded, so
        its px may be a little oblong.
        """
        across, down = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            focal=self.focal * across,
            aspect=self.aspect * down / across,
            cx=(self.cx + 0.5) * across - 0.5,
            cy=(self.cy + 0.5) * down - 0.5,
            sigmas=None,
        )

    def mirrored(self) -> "Camera":
        """The calibration of the same camera's files turned by 180 degrees."""
        cx, cy = self.width - 1 - self.cx, self.height - 1 - self.cy
        return replace(self, cx=cx, cy=cy, p1=-self.p1, p2=-self.p2)


@dataclass(frozen=True, kw_only=True)
class Order:
    """Which of Brown's terms a lens model has; the others are zero."""

    radial: int
    """Radial coefficients: terms up to r^(2 radial)."""
    tangential: bool
    """Whether it has tangential coefficients."""
    aspect: bool = False
    """Whether focal lengths along rows and columns may differ."""

    @property
    def terms(self) -> tuple[bool, bool, bool, bool, bool]:
        """Which of k1, k2, k3, p1, p2 the model has."""
        k1, k2, k3 = (self.radial > k for k in range(3))
        return k1, k2, k3, self.tangential, self.tangential


ORDERS = {
    "none": Order(radial=0, tangential=False),
    "2": Order(radial=1, tangential=False),
    "4": Order(radial=2, tangential=False),
    "6": Order(radial=3, tangential=False),
    "6t": Order(radial=3, tangential=True),
    "full": Order(radial=3, tangential=True, aspect=True),
}
"""By name: radial terms up to r^0, r^2, r^4, r^6, r^6 with tangential terms, and that with the
aspect ratio.
"""


def order_named(name: str) -> Order:
    """The order with this name.

    Raises:
        ValueError: there is none.
    """
    if name not in ORDERS:
        raise ValueError(f"one of {', '.join(ORDERS)} expected, got {name!r}")
    return ORDERS[name]
