"""Reference image and reference DEM as functions of a map grid."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from pyproj import CRS, Transformer

from cosp.arrays import Float32Array, FloatArray
from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.geometry.lattices import smooth_on_grid
from cosp.imaging.resampling import sample
from cosp.imaging.windows import Window
from cosp.io import rasters
from cosp.io.heights import HeightSystem, ellipsoidal_heights

OnGrid = Callable[[PixelGrid], Float32Array]
# Pixels a side of a block, and blocks that are kept: 24 MB.
_BLOCK = 512
_KEPT_BLOCKS = 24
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

    return _by_blocks(on_grid, _bounds_on(path, crs))


def heights_on(path: str | Path, crs: str, heights: HeightSystem) -> OnGrid:
    """Ellipsoidal heights of a DEM on any grid of a map projection in metres; NaN where it has none.

    Bilinear between the DEM's own pixels, averaged where the grid is coarser than they are.
    """
    posting = posting_m(path)
    fine = _between_pixels(path, crs, heights)

    def on_grid(grid: PixelGrid) -> Float32Array:
        if abs(grid.step_x) <= posting and max(grid.shape) <= _BLOCK:
            return fine(grid)
        return ellipsoidal_heights(path, grid, crs, heights)

    return on_grid


def _bounds_on(path: str | Path, crs: str) -> tuple[float, float, float, float]:
    """Bounds of a raster on a map, xmin, ymin, xmax, ymax."""
    info = rasters.info(path)
    found = Transformer.from_crs(str(info.crs), crs, always_xy=True).transform_bounds(*info.grid.bounds)
    return (float(found[0]), float(found[1]), float(found[2]), float(found[3]))


def _by_blocks(on_grid: OnGrid, bounds: tuple[float, float, float, float]) -> OnGrid:
    """The same raster, read by blocks of which the last few are kept: many small grids of one posting cost few reads.

    Only grids whose pixel edges lie on whole multiples of the posting share blocks; others, and those larger than a
    block, are read by themselves. Blocks are cut at the bounds of the raster: a warp whose target reaches beyond its
    source takes a wrong width for its kernel.
    """

    @lru_cache(_KEPT_BLOCKS)
    def block(step: float, row: int, column: int) -> Float32Array:
        grid = PixelGrid((column * _BLOCK + 0.5) * step, -(row * _BLOCK + 0.5) * step, step, -step, (_BLOCK, _BLOCK))
        rows, columns = grid.pixels(np.array([[bounds[0], bounds[3]], [bounds[2], bounds[1]]]))
        row0, column0 = (max(math.floor(places[0]), 0) for places in (rows, columns))
        row1, column1 = (min(math.ceil(places[1]) + 1, _BLOCK) for places in (rows, columns))
        values = np.full(grid.shape, np.nan, np.float32)
        if row1 > row0 and column1 > column0:
            values[row0:row1, column0:column1] = on_grid(grid.window(row0, row1, column0, column1))
        return values

    def from_blocks(grid: PixelGrid) -> Float32Array:
        step = grid.step_x
        place_row, place_column = -grid.y0 / step - 0.5, grid.x0 / step - 0.5
        row0, column0 = round(place_row), round(place_column)
        aligned = max(abs(place_row - row0), abs(place_column - column0)) < 1e-6 and grid.step_y == -step
        if not aligned or max(grid.shape) > _BLOCK:
            return on_grid(grid)
        rows, columns = grid.shape
        wanted = Window(row0, row0 + rows, column0, column0 + columns)
        result = np.empty(grid.shape, np.float32)
        for i in range(row0 // _BLOCK, (row0 + rows - 1) // _BLOCK + 1):
            for j in range(column0 // _BLOCK, (column0 + columns - 1) // _BLOCK + 1):
                whole = Window(i * _BLOCK, (i + 1) * _BLOCK, j * _BLOCK, (j + 1) * _BLOCK)
                part = whole.common(wanted)
                result[part.inside(wanted).slices] = block(step, i, j)[part.inside(whole).slices]
        return result

    return from_blocks


def _between_pixels(path: str | Path, crs: str, heights: HeightSystem) -> OnGrid:
    """Bilinear heights of a DEM on a grid finer than itself, from blocks of its own pixels."""
    info = rasters.info(path)
    own_crs = str(info.crs)
    to_own = None if own_crs == crs else Transformer.from_crs(crs, own_crs, always_xy=True)

    @lru_cache(_KEPT_BLOCKS)
    def block(row: int, column: int) -> Float32Array:
        row0, column0 = row * _BLOCK, column * _BLOCK
        # One pixel more than the block, so that a place between two blocks lies in one of them.
        row1, column1 = (min(start + _BLOCK + 1, n) for start, n in zip((row0, column0), info.shape, strict=True))
        grid = info.grid.window(row0, row1, column0, column1)
        return ellipsoidal_heights(path, grid, own_crs, heights)

    def own_points(xy: FloatArray) -> FloatArray:
        return xy if to_own is None else np.stack(to_own.transform(xy[..., 0], xy[..., 1]), axis=-1)

    def on_grid(grid: PixelGrid) -> Float32Array:
        rows, columns = info.grid.pixels(np.moveaxis(smooth_on_grid(own_points, grid), 0, -1))
        result = np.full(grid.shape, np.nan, np.float32)
        # Within half a pixel of the border the outermost pixel holds.
        inside = (rows >= -0.5) & (rows <= info.shape[0] - 0.5) & (columns >= -0.5) & (columns <= info.shape[1] - 0.5)
        if not inside.any():
            return result
        rows, columns = np.clip(rows, 0, info.shape[0] - 1), np.clip(columns, 0, info.shape[1] - 1)
        row_block, column_block = (np.floor(places / _BLOCK).astype(int) for places in (rows, columns))
        for i in range(int(row_block[inside].min()), int(row_block[inside].max()) + 1):
            for j in range(int(column_block[inside].min()), int(column_block[inside].max()) + 1):
                chosen = inside & (row_block == i) & (column_block == j)
                if chosen.any():
                    values = _bilinear(block(i, j), rows - i * _BLOCK, columns - j * _BLOCK)
                    result[chosen] = values[chosen]
        return result

    return on_grid


def _bilinear(values: Float32Array, rows: FloatArray, columns: FloatArray) -> Float32Array:
    """Values between pixels; beside a gap from those pixels that hold one, where these weigh at least half."""
    known = np.isfinite(values)
    if known.all():
        return np.asarray(sample(values, rows, columns, interpolation="linear"), np.float32)
    weight = sample(known.astype(np.float32), rows, columns, interpolation="linear")
    total = sample(np.where(known, values, np.float32(0)), rows, columns, interpolation="linear")
    return np.where(weight >= 0.5, total / np.maximum(weight, 0.5), np.float32(np.nan)).astype(np.float32)
