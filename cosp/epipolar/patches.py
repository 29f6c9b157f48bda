"""Many small windows of a rectified image at once, from the image itself or straight from the film."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cosp.arrays import ByteArray, Float32Array
from cosp.epipolar.rectification import EpipolarMap
from cosp.geometry.grids import PixelGrid
from cosp.imaging.resampling import block_mean, sample
from cosp.imaging.windows import Window

Reader = Callable[[Window], ByteArray]
_HALO_PX = 4  # what interpolation between reduced pixels reaches


class Patches(Protocol):
    """Windows of one size of an image reduced by a factor, (N, h, w); 0 where the film is not."""

    def __call__(
        self, row: NDArray[np.intp], column: NDArray[np.intp], size: tuple[int, int], factor: int
    ) -> Float32Array:
        """Windows with the given first rows and columns (N,), in reduced pixels; they lie near each other."""


def image_patches(read: Reader, shape: tuple[int, int]) -> Patches:
    """Patches of a rectified image that is there.

    Parameters
    ----------
    read : function
        Grey values of a window of the image.
    shape : (rows, columns) of the image
    """

    def patches(row: NDArray[np.intp], column: NDArray[np.intp], size: tuple[int, int], factor: int) -> Float32Array:
        window = Window(int(row.min()), int(row.max()) + size[0], int(column.min()), int(column.max()) + size[1])
        full = Window(*(factor * edge for edge in (window.row0, window.row1, window.column0, window.column1)))
        inside = full.grown(0, shape)
        picture = np.zeros(full.shape, np.uint8)
        if min(inside.shape) > 0:
            picture[inside.inside(full).slices] = read(inside)
        rows, columns = _pixels_of(row - window.row0, column - window.column0, size)
        return np.asarray(block_mean(picture, factor)[rows, columns], np.float32)

    return patches


def film_patches(read_film: Reader, film_grid: PixelGrid, epipolar_map: EpipolarMap) -> Patches:
    """Patches of a rectified image that need not be there: only what they show is resampled, from the reduced film.

    Parameters
    ----------
    read_film : function
        Grey values of a window of the film raster.
    film_grid : PixelGrid
        Of the film raster, mm.
    epipolar_map : EpipolarMap
    """

    def patches(row: NDArray[np.intp], column: NDArray[np.intp], size: tuple[int, int], factor: int) -> Float32Array:
        rows, columns = _pixels_of(row, column, size)
        lines = (len(row) * size[0], size[1])
        # The centre of a reduced pixel, in pixels of the image.
        centre_rows = factor * (rows.reshape(-1, 1) + 0.5) - 0.5
        centre_columns = factor * (np.broadcast_to(columns, (len(row), *size)).reshape(lines) + 0.5) - 0.5
        film_rows, film_columns = film_grid.pixels(epipolar_map.film(centre_rows, centre_columns))
        known = np.isfinite(film_rows)
        if not known.any():
            return np.zeros((len(row), *size), np.float32)
        reach = _HALO_PX * factor
        shown = Window(
            (int(film_rows[known].min()) - reach) // factor * factor,
            int(film_rows[known].max()) + reach,
            (int(film_columns[known].min()) - reach) // factor * factor,
            int(film_columns[known].max()) + reach,
        ).grown(0, film_grid.shape)
        if min(shown.shape) <= 0:
            return np.zeros((len(row), *size), np.float32)
        grey = sample(
            block_mean(read_film(shown), factor),
            (film_rows - shown.row0 + 0.5) / factor - 0.5,
            (film_columns - shown.column0 + 0.5) / factor - 0.5,
        )
        return np.asarray(grey.reshape(len(row), *size), np.float32)

    return patches


def _pixels_of(
    row: NDArray[np.intp], column: NDArray[np.intp], size: tuple[int, int]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows (N, h, 1) and columns (N, 1, w) of the pixels of windows."""
    return row[:, None, None] + np.arange(size[0])[:, None], column[:, None, None] + np.arange(size[1])
