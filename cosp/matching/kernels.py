"""Compiled loops of matching, the only module of the package that needs a compiler."""

# Compiled code has types of its own.
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import numpy as np
from numba import njit

from cosp.arrays import Float32Array, IntArray


@njit(nogil=True, cache=True)
def highest_sums(surfaces: Float32Array, offsets: IntArray) -> tuple[Float32Array, IntArray]:
    """Highest sum of shifted surfaces at each place.

    Parameters
    ----------
    surfaces : (blocks, rows, columns) array
    offsets : (guesses, blocks, 2) array
        Rows and columns by which each guess reads a surface away from the place; what lies outside counts as 0.

    Returns
    -------
    highest : (rows, columns) float32 array
    guess : (rows, columns) int array
        Which guess it is of.
    """
    blocks, rows, columns = surfaces.shape
    highest = np.full((rows, columns), -np.inf, np.float32)
    guess = np.zeros((rows, columns), np.int32)
    total = np.empty(columns, np.float32)
    for number in range(len(offsets)):
        for row in range(rows):
            total[:] = 0
            for block in range(blocks):
                source, right = row + offsets[number, block, 0], offsets[number, block, 1]
                if 0 <= source < rows and abs(right) < columns:
                    part = total[max(-right, 0) : columns - max(right, 0)]
                    part += surfaces[block, source, max(right, 0) : columns - max(-right, 0)]
            for column in range(columns):
                if total[column] > highest[row, column]:
                    highest[row, column] = total[column]
                    guess[row, column] = number
    return highest, guess
