"""A film that can be asked for grey values at film points, whole in memory or read by windows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosp.arrays import Float32Array, FloatArray
from cosp.geometry.grids import PixelGrid
from cosp.imaging.resampling import block_mean, sample
from cosp.imaging.windows import Window

# Columns of a film taken at once when it is reduced: whole rows of a 7 um film stay below 64 MB.
_READ_COLUMNS = 8192
_REACH_PX = 3
# Pieces of a buffered film: a few tens of megabytes at 7 um.
_PIECE_COLUMNS = 1024
_KEPT_PIECES = 6


@dataclass(frozen=True)
class FilmImage:
    """Grey values of a film on a grid of millimetres; 0 is outside the picture.

    Parameters
    ----------
    grid : PixelGrid
    read : function of a Window
        Gives the pixels (rows, columns) of a window that lies inside the grid.
    """

    grid: PixelGrid
    read: Callable[[Window], NDArray[Any]]

    @classmethod
    def from_array(cls, pixels: NDArray[Any], grid: PixelGrid) -> FilmImage:
        """A film that is in memory."""
        return cls(grid, lambda window: pixels[window.slices])

    @property
    def pixel_mm(self) -> float:
        """Side of a pixel."""
        return abs(self.grid.step_x)

    def reduced(self, factor: int) -> FilmImage:
        """The film as means of factor x factor pixels, in memory; read window by window."""
        rows, columns = self.grid.shape
        step = max(factor, _READ_COLUMNS // factor * factor)
        parts = [
            block_mean(self.read(Window(0, rows, start, min(start + step, columns))), factor)
            for start in range(0, columns, step)
        ]
        return FilmImage.from_array(np.concatenate(parts, axis=1), self.grid.coarsened(factor))

    def buffered(self) -> FilmImage:
        """The same film, read by pieces along it of which the last few are kept, for many small windows in turn."""
        rows, columns = self.grid.shape
        read = self.read
        lock = Lock()  # what two threads want at once is read once

        @lru_cache(_KEPT_PIECES)
        def piece(number: int) -> NDArray[Any]:
            first = number * _PIECE_COLUMNS
            return read(Window(0, rows, first, min(first + _PIECE_COLUMNS, columns)))

        def read_buffered(window: Window) -> NDArray[Any]:
            numbers = range(window.column0 // _PIECE_COLUMNS, (window.column1 - 1) // _PIECE_COLUMNS + 1)
            first = numbers.start * _PIECE_COLUMNS
            chosen = slice(window.column0 - first, window.column1 - first)
            with lock:
                pieces = [piece(number)[window.row0 : window.row1] for number in numbers]
            return (pieces[0] if len(pieces) == 1 else np.concatenate(pieces, axis=1))[:, chosen]

        return FilmImage(self.grid, read_buffered)

    def laid(self, *, turned: bool, mirrored: bool) -> FilmImage:
        """The same pixels as a film that is turned by 180 degrees, mirrored across its length (y), or both."""
        return FilmImage(self.grid.flipped(x=turned, y=turned != mirrored), self.read)

    def part(self, low_x_mm: float, high_x_mm: float) -> FilmImage:
        """The film between two places along it, as far as it reaches; at least one column."""
        columns = self.grid.shape[1]
        _, ends = self.grid.pixels(np.array([[low_x_mm, 0.0], [high_x_mm, 0.0]]))
        first = int(np.clip(np.floor(ends.min()), 0, columns - 1))
        last = int(np.clip(np.ceil(ends.max()) + 1, first + 1, columns))
        grid = self.grid.window(0, self.grid.shape[0], first, last)
        read = self.read
        return FilmImage(grid, lambda w: read(Window(w.row0, w.row1, w.column0 + first, w.column1 + first)))

    def sample(self, film_mm: FloatArray) -> Float32Array:
        """Grey values at film points (..., 2) in mm; NaN outside the picture."""
        rows, columns = self.grid.pixels(film_mm)
        shape = self.grid.shape
        with np.errstate(invalid="ignore"):
            inside = (rows > -0.5) & (rows < shape[0] - 0.5) & (columns > -0.5) & (columns < shape[1] - 0.5)
        result = np.full(rows.shape, np.nan, np.float32)
        if not inside.any():
            return result
        window = Window(
            int(rows[inside].min() + 0.5), int(rows[inside].max() + 0.5) + 1,
            int(columns[inside].min() + 0.5), int(columns[inside].max() + 0.5) + 1,
        ).grown(_REACH_PX, shape)  # fmt: skip
        pixels = np.asarray(self.read(window))
        local_rows, local_columns = rows - window.row0, columns - window.column0
        values = sample(pixels.astype(np.float32), local_rows, local_columns, interpolation="cubic")
        if not pixels.all():
            inside &= sample((pixels > 0).astype(np.uint8), local_rows, local_columns, interpolation="nearest") > 0
        values[~inside] = np.nan
        return np.asarray(values, np.float32)
