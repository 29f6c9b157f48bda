"""Compiled loops of the adjustment: observation rows that touch few of many unknowns."""

from __future__ import annotations

import numpy as np
from numba import njit

from cosp.arrays import FloatArray, IntArray


@njit(nogil=True, cache=True)
def _row(
    by_film: FloatArray,
    by_camera: FloatArray,
    functions: IntArray,
    values: FloatArray,
    width: int,
    columns: IntArray,
    row: FloatArray,
) -> None:
    """Columns and derivatives of one equation: (I, 2), (I, P), (I, S), (I, S) in, (I * (P + 2 S)) out."""
    n = 0
    for image in range(by_film.shape[0]):
        start = image * width
        for k in range(by_camera.shape[1]):
            columns[n] = start + k
            row[n] = by_camera[image, k]
            n += 1
        for s in range(functions.shape[1]):
            for c in range(2):
                columns[n] = start + by_camera.shape[1] + 2 * functions[image, s] + c
                row[n] = by_film[image, c] * values[image, s]
                n += 1


@njit(nogil=True, cache=True)
def accumulate(
    residuals: FloatArray,
    weights: FloatArray,
    by_film: FloatArray,
    by_camera: FloatArray,
    functions: IntArray,
    values: FloatArray,
    width: int,
    normal: FloatArray,
    right: FloatArray,
) -> None:
    """Add weighted equations to normal equations; of the matrix the lower triangle only.

    Parameters
    ----------
    residuals : (M, K) array
    weights : (M,) array
        Rows of weight 0 are left out.
    by_film : (M, K, I, 2) array
        Derivatives with respect to displacements on the films of I images.
    by_camera : (M, K, I, P) array
    functions, values : (M, I, S) arrays
        Those that may not be zero at the film points, rising where they are not.
    width : int
        Unknowns of an image.
    normal : (I * width, I * width) array
    right : (I * width,) array
    """
    images = by_film.shape[2]
    count = images * (by_camera.shape[3] + 2 * functions.shape[2])
    columns = np.empty(count, np.int64)
    row = np.empty(count)
    for m in range(residuals.shape[0]):
        weight = weights[m]
        if not weight > 0.0:
            continue
        for k in range(residuals.shape[1]):
            _row(by_film[m, k], by_camera[m, k], functions[m], values[m], width, columns, row)
            for a in range(count):
                scaled = weight * row[a]
                right[columns[a]] += scaled * residuals[m, k]
                for b in range(a + 1):
                    normal[columns[a], columns[b]] += scaled * row[b]


@njit(nogil=True, cache=True)
def variances(
    by_film: FloatArray,
    by_camera: FloatArray,
    functions: IntArray,
    values: FloatArray,
    width: int,
    covariance: FloatArray,
    variance: FloatArray,
) -> None:
    """Variances (M, K) of what equations compute, from the covariance (I * width, I * width) of the unknowns."""
    images = by_film.shape[2]
    count = images * (by_camera.shape[3] + 2 * functions.shape[2])
    columns = np.empty(count, np.int64)
    row = np.empty(count)
    for m in range(by_film.shape[0]):
        for k in range(by_film.shape[1]):
            _row(by_film[m, k], by_camera[m, k], functions[m], values[m], width, columns, row)
            total = 0.0
            for a in range(count):
                inner = 0.5 * covariance[columns[a], columns[a]] * row[a]
                for b in range(a):
                    inner += covariance[columns[a], columns[b]] * row[b]
                total += 2.0 * row[a] * inner
            variance[m, k] = total
