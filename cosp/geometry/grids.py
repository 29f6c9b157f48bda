"""Regular grids of pixels, on film (millimetres) or on a map (units of its reference system)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from cosp.arrays import FloatArray


@dataclass(frozen=True)
class PixelGrid:
    """Where the pixels of a raster lie: the centre of pixel (0, 0) and the step per column and per row.

    Parameters
    ----------
    x0, y0 : float
        Coordinates of the centre of pixel (0, 0).
    step_x, step_y : float
        Change of x per column and of y per row; `step_y` is negative where rows run down.
    shape : (rows, columns)
    """

    KIND: ClassVar[str] = "pixel_grid"
    VERSION: ClassVar[int] = 1

    x0: float
    y0: float
    step_x: float
    step_y: float
    shape: tuple[int, int]

    @classmethod
    def covering(cls, bounds: tuple[float, float, float, float], posting: float) -> PixelGrid:
        """North-up grid over (xmin, ymin, xmax, ymax) with pixel edges on whole multiples of the posting."""
        left, bottom = (math.floor(round(v / posting, 6)) for v in bounds[:2])
        right, top = (math.ceil(round(v / posting, 6)) for v in bounds[2:])
        shape = (max(top - bottom, 1), max(right - left, 1))
        return cls((left + 0.5) * posting, (top - 0.5) * posting, posting, -posting, shape)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Outer edges: xmin, ymin, xmax, ymax."""
        rows, columns = self.shape
        xs = (self.x0 - self.step_x / 2, self.x0 + (columns - 0.5) * self.step_x)
        ys = (self.y0 - self.step_y / 2, self.y0 + (rows - 0.5) * self.step_y)
        return (min(xs), min(ys), max(xs), max(ys))

    def points(self, rows: ArrayLike, columns: ArrayLike) -> FloatArray:
        """Coordinates (..., 2) of places given in rows and columns (broadcast together)."""
        row, column = np.broadcast_arrays(np.asarray(rows, float), np.asarray(columns, float))
        return np.stack([self.x0 + column * self.step_x, self.y0 + row * self.step_y], axis=-1)

    def pixels(self, xy: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Rows and columns (fractional) of points (..., 2)."""
        places = np.asarray(xy, float)
        return (places[..., 1] - self.y0) / self.step_y, (places[..., 0] - self.x0) / self.step_x

    def centres(self) -> FloatArray:
        """Coordinates of every pixel centre, (rows, columns, 2)."""
        rows, columns = self.shape
        return self.points(np.arange(rows)[:, None], np.arange(columns)[None, :])

    def window(self, row0: int, row1: int, column0: int, column1: int) -> PixelGrid:
        """The part of the grid between two rows and two columns; may reach beyond it."""
        return PixelGrid(
            self.x0 + column0 * self.step_x,
            self.y0 + row0 * self.step_y,
            self.step_x,
            self.step_y,
            (row1 - row0, column1 - column0),
        )

    def flipped(self, *, x: bool, y: bool) -> PixelGrid:
        """The same pixels with the sign of x, of y or of both changed."""
        sign_x, sign_y = (-1 if x else 1), (-1 if y else 1)
        return PixelGrid(sign_x * self.x0, sign_y * self.y0, sign_x * self.step_x, sign_y * self.step_y, self.shape)

    def coarsened(self, factor: int) -> PixelGrid:
        """Grid of blocks of factor x factor pixels; the last block may be partly outside."""
        shift = (factor - 1) / 2
        rows, columns = (-(-n // factor) for n in self.shape)
        return PixelGrid(
            self.x0 + shift * self.step_x,
            self.y0 + shift * self.step_y,
            self.step_x * factor,
            self.step_y * factor,
            (rows, columns),
        )
