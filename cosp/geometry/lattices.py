"""Smooth functions on every pixel of a grid, from a few exact values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cosp.arrays import Float32Array, FloatArray
from cosp.geometry import kernels
from cosp.geometry.grids import PixelGrid


def smooth_on_grid(function: Callable[[FloatArray], FloatArray], grid: PixelGrid, degree: int = 3) -> FloatArray:
    """Values of a smooth function at every pixel centre, by a polynomial through its values at few places.

    Parameters
    ----------
    function : function of (M, M, 2) coordinates
        Gives (M, M, K) values.
    grid : PixelGrid
    degree : int
        Of the polynomial, in either direction; the places are Chebyshev's, where the error is about even.

    Returns
    -------
    (K, rows, columns) array
    """
    rows, of_rows = _chebyshev(grid.shape[0], degree)
    columns, of_columns = _chebyshev(grid.shape[1], degree)
    values = np.moveaxis(np.asarray(function(grid.points(rows[:, None], columns[None, :])), float), -1, 0)
    return np.asarray(of_rows @ values @ of_columns.T)


def between_nodes(
    values: FloatArray, first: tuple[float, float], step: tuple[float, float], shape: tuple[int, int]
) -> Float32Array:
    """A lattice at every pixel of a picture, bilinear between its nodes; its edge values go on beyond it.

    Parameters
    ----------
    values : (R, C) array
        NaN makes NaN of what lies beside it.
    first : (row, column)
        Place of the first pixel among the nodes.
    step : (row, column)
        How far among the nodes the next pixel is; positive.
    shape : (H, W)

    Returns
    -------
    (H, W) array
    """
    result = np.empty(shape, np.float32)
    kernels.between_nodes(np.ascontiguousarray(values, float), first, step, result)
    return result


def _chebyshev(length: int, degree: int) -> tuple[FloatArray, FloatArray]:
    """Places (M,) among pixels 0 to length - 1, and the weights (length, M) of their values at each pixel."""
    middle, half = (length - 1) / 2, max(length - 1, 1) / 2
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    fit = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, degree))
    return middle + half * nodes, np.polynomial.chebyshev.chebvander((np.arange(length) - middle) / half, degree) @ fit
