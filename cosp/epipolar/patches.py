"""Many small windows of a rectified image at once, from the image itself or straight from the film."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from threading import Lock
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from cosp.arrays import ByteArray
from cosp.epipolar import kernels
from cosp.epipolar.rectification import EpipolarMap
from cosp.geometry.grids import PixelGrid
from cosp.imaging.resampling import block_mean
from cosp.imaging.windows import Window

Reader = Callable[[Window], ByteArray]
_HALO_PX = 4  # what interpolation between reduced pixels reaches
# Reduced pixels from one place of a window to the next whose film point is worked out; in between bilinear, which is
# within 0.0025 of such a pixel at every size.
_NODE_PX = 8
_FAR_PX = -1e6  # stands for "nowhere"
_AT_ONCE = 256  # windows resampled in one call
_TILE_PX = 2048  # side of the parts of an image that are reduced at a time; a multiple of every factor


class Patches(Protocol):
    """Windows of one size of an image reduced by a factor, (N, h, w); 0 where the film is not."""

    def __call__(
        self, row: NDArray[np.intp], column: NDArray[np.intp], size: tuple[int, int], factor: int
    ) -> ByteArray:
        """Windows with the given first rows and columns (N,), in reduced pixels; they lie near each other."""


class Reduced:
    """An image at several sizes: each part of it is read once for all reduced ones, when it is first asked for.

    Parameters
    ----------
    read : function
        Grey values of a window of the image.
    shape : (rows, columns) of the image
    """

    def __init__(self, read: Reader, shape: tuple[int, int]) -> None:
        self._read = read
        self._shape = shape
        self._halved: dict[tuple[int, int], list[ByteArray]] = {}
        self._locks: defaultdict[tuple[int, int], Lock] = defaultdict(Lock)

    def __call__(self, window: Window, factor: int) -> ByteArray:
        """Grey values of a window, in pixels reduced by a power of two; 0 outside the image."""
        picture = np.zeros(window.shape, np.uint8)
        inside = window.grown(0, (-(-self._shape[0] // factor), -(-self._shape[1] // factor)))
        if min(inside.shape) <= 0:
            return picture
        if factor == 1:
            picture[inside.inside(window).slices] = self._read(inside)
            return picture
        side = _TILE_PX // factor
        for row in range(inside.row0 // side, -(-inside.row1 // side)):
            for column in range(inside.column0 // side, -(-inside.column1 // side)):
                reduced = self._tile(row, column, factor)
                tile = Window(
                    row * side, row * side + reduced.shape[0], column * side, column * side + reduced.shape[1]
                )
                part = tile.common(inside)
                picture[part.inside(window).slices] = reduced[part.inside(tile).slices]
        return picture

    def _tile(self, row: int, column: int, factor: int) -> ByteArray:
        """A part of the image, reduced by a factor; halved again and again from what is there."""
        with self._locks[row, column]:
            halved = self._halved.setdefault((row, column), [])
            while len(halved) < factor.bit_length() - 1:
                if not halved:
                    r, c = row * _TILE_PX, column * _TILE_PX
                    larger = self._read(Window(r, r + _TILE_PX, c, c + _TILE_PX).grown(0, self._shape))
                else:
                    larger = halved[-1]
                halved.append(block_mean(larger, 2))
            return halved[factor.bit_length() - 2]


def image_patches(read: Reader, shape: tuple[int, int]) -> Patches:
    """Patches of a rectified image that is there.

    Parameters
    ----------
    read : function
        Grey values of a window of the image.
    shape : (rows, columns) of the image
    """
    reduced = Reduced(read, shape)

    def patches(row: NDArray[np.intp], column: NDArray[np.intp], size: tuple[int, int], factor: int) -> ByteArray:
        window = Window(int(row.min()), int(row.max()) + size[0], int(column.min()), int(column.max()) + size[1])
        windows = np.empty((len(row), *size), np.uint8)
        kernels.cut(reduced(window, factor), row - window.row0, column - window.column0, windows)
        return windows

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
    reduced = Reduced(read_film, film_grid.shape)

    def patches(row: NDArray[np.intp], column: NDArray[np.intp], size: tuple[int, int], factor: int) -> ByteArray:
        windows = np.zeros((len(row), *size), np.uint8)
        # Centres of reduced pixels of each window, in pixels of the image: lines of the nodes of one row.
        rows, columns = (
            factor * (first[:, None] + np.arange(0, n + _NODE_PX, _NODE_PX) + 0.5) - 0.5
            for first, n in ((row, size[0]), (column, size[1]))
        )
        film_mm = epipolar_map.film(rows.reshape(-1, 1), np.repeat(columns, rows.shape[1], axis=0))
        film_rows, film_columns = film_grid.pixels(film_mm.reshape(*rows.shape, columns.shape[1], 2))
        known = np.isfinite(film_rows)
        if not known.any():
            return windows
        # Places in reduced pixels of the film.
        film_rows, film_columns = ((places + 0.5) / factor - 0.5 for places in (film_rows, film_columns))
        shape = tuple(-(-n // factor) for n in film_grid.shape)
        shown = Window(
            int(film_rows[known].min()) - _HALO_PX,
            int(film_rows[known].max()) + _HALO_PX,
            int(film_columns[known].min()) - _HALO_PX,
            int(film_columns[known].max()) + _HALO_PX,
        ).grown(0, (shape[0], shape[1]))
        if min(shown.shape) <= 0:
            return windows
        picture = reduced(shown, factor)
        places = np.empty((2, _AT_ONCE, *size), np.float32)
        for start in range(0, len(row), _AT_ONCE):
            part = slice(start, min(start + _AT_ONCE, len(row)))
            at_rows, at_columns = places[:, : part.stop - start]
            kernels.within_windows(film_rows[part] - shown.row0, _NODE_PX, _FAR_PX, at_rows)
            kernels.within_windows(film_columns[part] - shown.column0, _NODE_PX, _FAR_PX, at_columns)
            # Black outside, as the film's own surroundings; all windows of a part as one tall picture.
            grey = cv2.remap(
                picture,
                at_columns.reshape(-1, size[1]),
                at_rows.reshape(-1, size[1]),
                cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_CONSTANT,
            )
            windows[part] = grey.reshape(-1, *size)
        return windows

    return patches
