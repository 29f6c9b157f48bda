"""How good a model is, and where it could have been: footprint, texture, statistics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

from cosp.arrays import BoolArray, FloatArray
from cosp.dem.differencing import difference_statistics, statistics_by_slope
from cosp.geometry.grids import PixelGrid

_STRIP_ROWS = 512
_BLOCK_CELLS = 16


def seen_by(
    film_mm: Callable[[FloatArray, FloatArray, FloatArray], FloatArray],
    heights_m: FloatArray,
    grid: PixelGrid,
    film_bounds_mm: tuple[float, float, float, float],
) -> BoolArray:
    """Cells of a grid that lie on a film.

    Parameters
    ----------
    film_mm : function
        Film points (..., 2) of eastings, northings and heights (arrays of one shape); NaN off the film.
    heights_m : (R, C) array
        NaN is not seen.
    grid : PixelGrid
    film_bounds_mm : (xmin, ymin, xmax, ymax)
        Of the film as it is, clipped ends left out.
    """
    seen = np.zeros(grid.shape, bool)
    for row0 in range(0, grid.shape[0], _STRIP_ROWS):
        row1 = min(row0 + _STRIP_ROWS, grid.shape[0])
        part = grid.window(row0, row1, 0, grid.shape[1])
        seen[row0:row1] = _seen_in_strip(film_mm, heights_m[row0:row1], part, film_bounds_mm)
    return seen


def _seen_in_strip(
    film_mm: Callable[[FloatArray, FloatArray, FloatArray], FloatArray],
    heights_m: FloatArray,
    grid: PixelGrid,
    film_bounds_mm: tuple[float, float, float, float],
) -> BoolArray:
    """`seen_by` in a strip: cells are looked up where the corners of their block, at its extreme heights, disagree."""
    xmin, ymin, xmax, ymax = film_bounds_mm
    measured = np.isfinite(heights_m)
    rows, columns = (np.arange(0, length, _BLOCK_CELLS) for length in grid.shape)
    last_rows, last_columns = np.append(rows[1:], grid.shape[0]) - 1, np.append(columns[1:], grid.shape[1]) - 1
    extremes_m = [
        extreme.reduceat(extreme.reduceat(heights_m, rows, axis=0), columns, axis=1) for extreme in (np.fmin, np.fmax)
    ]
    corners = np.stack(
        [
            film_mm(xy[..., 0], xy[..., 1], height_m)
            for xy in (grid.points(r[:, None], c) for r in (rows, last_rows) for c in (columns, last_columns))
            for height_m in extremes_m
        ]
    )
    x, y = corners[..., 0], corners[..., 1]
    with np.errstate(invalid="ignore"):
        inside: BoolArray = np.all(_within(corners, film_bounds_mm), axis=0)
        beyond: BoolArray = np.any([side.all(axis=0) for side in (x < xmin, x > xmax, y < ymin, y > ymax)], axis=0)

    def cells(blocks: BoolArray) -> BoolArray:
        return np.repeat(np.repeat(blocks, last_rows - rows + 1, axis=0), last_columns - columns + 1, axis=1)

    seen = cells(inside) & measured
    doubtful = np.nonzero(cells(~(inside | beyond)) & measured)
    xy = grid.points(*doubtful)
    seen[doubtful] = _within(film_mm(xy[:, 0], xy[:, 1], heights_m[doubtful]), film_bounds_mm)
    return seen


def _within(film_mm: FloatArray, bounds_mm: tuple[float, float, float, float]) -> BoolArray:
    xmin, ymin, xmax, ymax = bounds_mm
    x, y = film_mm[..., 0], film_mm[..., 1]
    with np.errstate(invalid="ignore"):
        return (x >= xmin) & (x <= xmax) & (y >= ymin) & (y <= ymax)


def textured(grey: FloatArray, *, least_grey: float, window_cells: int) -> BoolArray:
    """Cells of an orthophoto with something to match: local standard deviation of at least `least_grey` grey values.

    Parameters
    ----------
    grey : (R, C) array
        0 or NaN is no data and is not textured.
    least_grey : float
    window_cells : int
        Side of the square in which the deviation is taken.
    """
    known = np.nan_to_num(grey) > 0
    values = np.where(known, grey, 0).astype(np.float32)
    size = (window_cells, window_cells)
    share = cv2.blur(known.astype(np.float32), size)
    mean = cv2.blur(values, size) / np.maximum(share, 1e-6)
    square = cv2.blur(values**2, size) / np.maximum(share, 1e-6)
    return np.asarray(known & (np.sqrt(np.maximum(square - mean**2, 0)) >= least_grey))


def statistics(
    difference_m: FloatArray,
    asked: BoolArray,
    has_texture: BoolArray,
    slope: FloatArray,
    *,
    edges_deg: Sequence[float],
    cell_area_m2: float,
) -> dict[str, Any]:
    """Statistics of differences as `quality.json` holds them: all, on textured ground, by slope.

    Parameters
    ----------
    difference_m, slope : (R, C) arrays, m and degrees
    asked : (R, C) boolean array
        Stable ground seen by both films.
    has_texture : (R, C) boolean array
    edges_deg : floats
        Of the bins of slope.
    cell_area_m2 : float
    """
    return {
        **difference_statistics(difference_m, asked, cell_area_m2=cell_area_m2),
        "textured": difference_statistics(difference_m, asked & has_texture, cell_area_m2=cell_area_m2),
        "by_slope": statistics_by_slope(difference_m, asked, slope, edges_deg),
    }
