"""Reference image and reference DEM as functions of a map grid."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from pyproj import CRS

from cosp.arrays import Float32Array
from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.io import rasters
from cosp.io.heights import HeightSystem, ellipsoidal_heights

OnGrid = Callable[[PixelGrid], Float32Array]
_DEGREE_M = 111_200.0


def posting_m(path: str | Path) -> float:
    """Side of a pixel of a georeferenced raster on the ground, about.

    Raises
    ------
    InputError
        If the raster has no reference system.
    """
    info = rasters.info(path)
    if info.crs is None:
        raise InputError(f"{path}: the raster has no coordinate reference system")
    crs = CRS.from_user_input(info.crs)
    area = abs(info.grid.step_x * info.grid.step_y)
    if crs.is_geographic:
        middle = math.radians((info.grid.bounds[1] + info.grid.bounds[3]) / 2)
        return _DEGREE_M * math.sqrt(area * math.cos(middle))
    return math.sqrt(area) * float(crs.axis_info[0].unit_conversion_factor)


def image_on(path: str | Path, crs: str) -> OnGrid:
    """The first band of a reference image on any grid of a map projection in metres.

    NaN outside, and where a raster without a no-data value is 0. Averaged where the grid is coarser than the image.
    """
    posting = posting_m(path)
    blank = rasters.info(path).nodata is None

    def on_grid(grid: PixelGrid) -> Float32Array:
        resampling: Literal["average", "cubic"] = "average" if abs(grid.step_x) > 1.5 * posting else "cubic"
        values = rasters.read_on_grid(path, grid, crs, resampling=resampling)
        return np.where(values == 0, np.float32(np.nan), values) if blank else values

    return on_grid


def heights_on(path: str | Path, crs: str, heights: HeightSystem) -> OnGrid:
    """Ellipsoidal heights of a DEM on any grid of a map projection in metres; NaN where it has none."""
    return lambda grid: ellipsoidal_heights(path, grid, crs, heights)
