"""Compiled loops of the geometry floor."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cosp.arrays import FloatArray


@njit(nogil=True, cache=True)
def evaluate_lattice(
    lattice: FloatArray, x0: float, y0: float, step: float, points: FloatArray, result: FloatArray
) -> None:
    """Value at height zero plus height times slope, both bilinear in a lattice.

    Parameters
    ----------
    lattice : (rows, columns, 6) array
        Three values at height zero, then their change per unit of height.
    x0, y0, step : float
        Place of lattice node (0, 0) and distance of the nodes.
    points : (N, 3) array
    result : (N, 3) array
        Filled; NaN outside the lattice.
    """
    rows, columns = lattice.shape[0], lattice.shape[1]
    for i in range(points.shape[0]):
        u = (points[i, 0] - x0) / step
        v = (points[i, 1] - y0) / step
        h = points[i, 2]
        if not (u >= 0.0 and v >= 0.0 and u <= columns - 1 and v <= rows - 1):
            result[i, 0] = np.nan
            result[i, 1] = np.nan
            result[i, 2] = np.nan
            continue
        c = min(int(math.floor(u)), columns - 2)
        r = min(int(math.floor(v)), rows - 2)
        s = u - c
        t = v - r
        for k in range(3):
            low = (1.0 - s) * lattice[r, c, k] + s * lattice[r, c + 1, k]
            high = (1.0 - s) * lattice[r + 1, c, k] + s * lattice[r + 1, c + 1, k]
            value = (1.0 - t) * low + t * high
            low = (1.0 - s) * lattice[r, c, k + 3] + s * lattice[r, c + 1, k + 3]
            high = (1.0 - s) * lattice[r + 1, c, k + 3] + s * lattice[r + 1, c + 1, k + 3]
            result[i, k] = value + h * ((1.0 - t) * low + t * high)
