"""Compiled loops of the imaging floor."""

from __future__ import annotations

import numpy as np
from numba import njit

from cosp.arrays import Float32Array, FloatArray


@njit(nogil=True, cache=True)
def box_energy(images: Float32Array, energy: FloatArray) -> None:
    """Squares of what the pixels under a box deviate from their mean, summed, at every place where the box fits.

    images : (N, C, H, W); each channel has means of its own, and their sums are added.
    energy : (N, H - h + 1, W - w + 1), which tells the size of the box; filled.
    """
    rows, columns = energy.shape[1:]
    height, width = images.shape[2] - rows + 1, images.shape[3] - columns + 1
    # Of the columns of the lines under the box.
    sums = np.empty(images.shape[3])
    squares = np.empty(images.shape[3])
    energy[:] = 0.0
    for n in range(images.shape[0]):
        for image in images[n]:
            sums[:] = 0.0
            squares[:] = 0.0
            for y in range(image.shape[0]):
                line = image[y]
                for x in range(line.size):
                    value = np.float64(line[x])
                    sums[x] += value
                    squares[x] += value * value
                if y < height - 1:
                    continue
                under, square = 0.0, 0.0
                for x in range(width - 1):
                    under += sums[x]
                    square += squares[x]
                for x in range(columns):
                    under += sums[x + width - 1]
                    square += squares[x + width - 1]
                    energy[n, y - height + 1, x] += square - under * under / (height * width)
                    under -= sums[x]
                    square -= squares[x]
                line = image[y - height + 1]
                for x in range(line.size):
                    value = np.float64(line[x])
                    sums[x] -= value
                    squares[x] -= value * value
