"""Compiled loops of the geometry floor."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from cosp.arrays import Float32Array, FloatArray


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


@njit(nogil=True, cache=True)
def between_nodes(
    values: FloatArray,
    first: tuple[float, float],
    step: tuple[float, float],
    result: Float32Array,
) -> None:
    """Fill a picture, (H, W), with a lattice, (R, C), bilinear between its nodes.

    `first` is the place (row, column) of the first pixel among the nodes, `step` how far the next ones are; steps are
    positive. Beyond the lattice the values of its edge go on.
    """
    height, width = result.shape
    last_row, last_column = values.shape[0] - 1, values.shape[1] - 1
    low = min(max(int(first[1]), 0), last_column)
    high = min(max(int(first[1] + step[1] * (width - 1)), 0) + 2, last_column + 1)
    line = np.empty(last_column + 2)
    for y in range(height):
        place = min(max(first[0] + step[0] * y, 0.0), float(last_row))
        i = min(int(place), max(last_row - 1, 0))
        part = place - i
        upper, lower = values[i], values[min(i + 1, last_row)]
        for j in range(low, high):
            line[j] = upper[j] + part * (lower[j] - upper[j])
        line[last_column + 1] = line[last_column]
        x = 0
        while x < width:
            place = first[1] + step[1] * x
            # A run of pixels between the same two nodes, or beyond the lattice.
            if place < 0.0 or place >= last_column:
                j = 0 if place < 0.0 else last_column
                slope = 0.0
                stop = min(int(math.ceil(-first[1] / step[1])), width) if place < 0.0 else width
            else:
                j = int(place)
                slope = line[j + 1] - line[j]
                stop = min(int(math.ceil((j + 1 - first[1]) / step[1])), width)
            stop = max(stop, x + 1)
            value = line[j] + slope * (first[1] - j)
            slope *= step[1]
            for k in range(x, stop):
                result[y, k] = value + slope * k
            x = stop
