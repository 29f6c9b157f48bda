"""Smooth fields through scattered, faulty measurements on a grid of nodes."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import ndimage

from cosp.arrays import FloatArray
from cosp.geometry.robust import tukey_weights

# Weight of "no change from the coarser field", as a part of what a fully measured neighbourhood weighs.
_PRIOR = 0.02
_ROBUST_STEPS = 5
# The coarsest field is this much smoother than the finest; in between halves.
_SCALES = (8.0, 4.0, 2.0, 1.0)


def local_median(values: FloatArray, radius: int) -> NDArray[np.float64]:
    """Median of the measured (not NaN) nodes within a square about each node; NaN where there is none.

    Parameters
    ----------
    values : (rows, columns) array
    radius : int
        The square has 2 radius + 1 nodes a side.
    """
    size = 2 * radius + 1
    padded = np.pad(np.asarray(values, np.float64), radius, constant_values=np.nan)
    windows = sliding_window_view(padded, (size, size)).reshape(*values.shape, size * size)
    ordered = np.sort(windows, axis=-1)  # NaN last
    count = np.isfinite(windows).sum(axis=-1)
    low = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0)[..., None], axis=-1)[..., 0]
    high = np.take_along_axis(ordered, (count // 2)[..., None], axis=-1)[..., 0]
    return np.where(count > 0, (low + high) / 2, np.nan)


def smooth_field(values: FloatArray, weights: FloatArray, *, sigma_nodes: float) -> NDArray[np.float64]:
    """A smooth field through the measured nodes, defined at every node.

    Local planes under a Gaussian window, coarse to fine: each scale is fitted to what the one before left, and holds on
    to it where there is nothing to fit. Planes, not means, so that a slope goes on unbent at the border. Tukey weights
    take out what does not fit.

    Parameters
    ----------
    values : (rows, columns) array
        NaN where not measured; at least one node must be.
    weights : (rows, columns) array
        Relative weight of each node.
    sigma_nodes : float
        Standard deviation of the finest Gaussian window, in nodes.
    """
    measured = np.isfinite(values)
    if not measured.any():
        raise ValueError("no node was measured: there is nothing to draw a field through")
    filled = np.where(measured, values, 0.0)
    given = np.where(measured, weights, 0.0)
    robust = given
    field = np.zeros(values.shape)
    for step in range(_ROBUST_STEPS):
        field = np.full(values.shape, float(np.median(values[measured])))
        for scale in _SCALES:
            field = field + _local_planes(filled - field, robust, sigma_nodes * scale)
        residuals = (filled - field)[measured]
        sigma = 1.4826 * float(np.median(np.abs(residuals)))
        if sigma == 0.0 or step == _ROBUST_STEPS - 1:
            break
        factors = np.zeros(values.shape)
        factors[measured] = tukey_weights(residuals / sigma)
        robust = given * factors
    return field


def _local_planes(values: FloatArray, weights: FloatArray, sigma: float) -> NDArray[np.float64]:
    """Value at each node of the weighted plane through its neighbourhood, drawn towards 0 where that is empty."""
    reach = max(1, round(3 * sigma))
    offset = np.arange(-reach, reach + 1, dtype=float)
    gauss = np.exp(-0.5 * (offset / sigma) ** 2)
    gauss /= gauss.sum()

    def moments(field: FloatArray, highest: int) -> dict[tuple[int, int], FloatArray]:
        """Sums about each node of field x row^i x column^j for i + j up to the highest order."""
        found = {}
        for i in range(highest + 1):
            down = ndimage.correlate1d(field, gauss * (offset / sigma) ** i, axis=0, mode="constant")
            for j in range(highest + 1 - i):
                along = gauss * (offset / sigma) ** j
                found[i, j] = np.asarray(ndimage.correlate1d(down, along, axis=1, mode="constant"))
        return found

    typical = float(weights[weights > 0].mean()) if (weights > 0).any() else 1.0
    prior = _PRIOR * typical
    w, z = moments(weights, 2), moments(weights * values, 1)
    n00, n11, n22 = w[0, 0] + prior, w[2, 0] + prior, w[0, 2] + prior
    n01, n02, n12 = w[1, 0], w[0, 1], w[1, 1]
    # Cramer on the normal equations of value and two slopes, of which the value is wanted.
    minor0, minor1, minor2 = n11 * n22 - n12 * n12, n12 * n02 - n01 * n22, n01 * n12 - n11 * n02
    determinant = n00 * minor0 + n01 * minor1 + n02 * minor2
    return np.asarray((z[0, 0] * minor0 + z[1, 0] * minor1 + z[0, 1] * minor2) / determinant)
