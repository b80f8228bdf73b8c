"""How far a registration's correlation stands out among all other shifts of the same pictures."""

import numpy as np
import scipy.fft

from skyquilt.model.registration import Matrix
from skyquilt.spectral.orientation import Orientation, spectra, warped

_NEAR = 2
"""Px about the registered place in which its peak is looked for."""
_OWN = 0.03
"""Share of the picture about the registered place that belongs to its peak."""
_LEAST = 0.3
"""Share of the overlap below which a shift does not count."""


def distinctness(a: Orientation, b: Orientation, b_H_a: Matrix) -> float:
    """The peak at a registration over the RMS of all far shifts.

    Unlike the correlation it can be compared between pictures: smooth ones correlate by chance,
    too.
    """
    fields, valid = warped(a, b_H_a, b.shape)
    shape = (scipy.fft.next_fast_len(2 * b.shape[0]), scipy.fft.next_fast_len(2 * b.shape[1]))
    cross = (spectra(fields, shape) * np.conj(spectra(b.fields, shape))).sum(0)
    masks = scipy.fft.fft2(valid, s=shape) * np.conj(scipy.fft.fft2(b.valid, s=shape))
    overlap = scipy.fft.ifft2(masks).real
    field = scipy.fft.ifft2(cross).real
    z = np.where(overlap > _LEAST * overlap[0, 0], field / np.sqrt(np.maximum(overlap, 1)), 0)
    far = overlap > _LEAST * overlap[0, 0]
    own = np.arange(-max(4, int(_OWN * b.shape[0])), max(4, int(_OWN * b.shape[0])) + 1)
    far[np.ix_(own, own)] = False
    near = np.arange(-_NEAR, _NEAR + 1)
    noise = float(np.sqrt((z[far] ** 2).mean())) if far.any() else 0.0
    return float(z[np.ix_(near, near)].max()) / max(noise, 1e-9)
