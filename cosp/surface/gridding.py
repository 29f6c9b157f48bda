"""Points to a raster of heights: robust, with an honest standard deviation."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray
from pyproj import Transformer

from cosp.arrays import Float32Array, FloatArray, IntArray
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from cosp.geometry.mapping import MapFrame
from cosp.imaging.windows import Window
from cosp.surface import kernels

HALO_CELLS = 4  # what `grid_points` needs around a tile to give the heights of the whole

_MOST_CONFIDENCE = 255
_SLOPE_WEIGHT = 0.1  # points; holds slopes where the points lie on a line, without a say elsewhere
_NEIGHBOURS_TO_FILL = 5  # of 8: closes holes of a cell and slits of one cell, does not grow the edge


_rooms = threading.local()


@dataclass(frozen=True)
class GriddedHeights:
    """Heights of a grid and how well they are known.

    Parameters
    ----------
    height_m : (R, C) float32 array
        NaN where no point lies in the cell and it is not a tiny hole.
    sigma_m : (R, C) float32 array
        Standard deviation of each height.
    count : (R, C) int array
        Points of the cell itself that were used; 0 in filled holes.
    """

    height_m: Float32Array
    sigma_m: Float32Array
    count: IntArray


@dataclass(frozen=True)
class CellPoints:
    """Points that lie near each other, in the cells of a grid.

    Parameters
    ----------
    values : (N, 4) float32 array
        Column, row, height in m, weight; a cell's centre lies at whole numbers.
    row0, column0 : int
        Cell of the grid at which rows and columns are 0.
    """

    values: Float32Array
    row0: int
    column0: int


def grid_points(
    points: FloatArray,
    grid: PixelGrid,
    *,
    weights: FloatArray | None = None,
    kernel_cells: float,
    gate_sigmas: float,
    point_sigma_m: float,
    points_per_independent: float,
) -> GriddedHeights:
    """Heights at the cell centres of a grid from points on a surface; see `grid_cells` for how.

    Parameters
    ----------
    points : (N, 3) array, m
        Easting, northing, height; NaN are left out. Points just outside the grid are not used.
    grid : PixelGrid
    weights : (N,) array, optional
        Inverse variance of each point, as a multiple of that of `point_sigma_m`; points of weight 0 are left out. All
        1 when left out.
    kernel_cells, gate_sigmas, point_sigma_m, points_per_independent
        As of `grid_cells`.
    """
    values = np.empty((len(points), 4), np.float32)
    kernels.points_in_cells(
        np.ascontiguousarray(points, dtype=float),
        np.ones(len(points), np.float32) if weights is None else np.asarray(weights, np.float32),
        cells_of(grid),
        values,
    )
    return grid_cells(
        [CellPoints(values, 0, 0)],
        Window(0, grid.shape[0], 0, grid.shape[1]),
        kernel_cells=kernel_cells,
        gate_sigmas=gate_sigmas,
        point_sigma_m=point_sigma_m,
        points_per_independent=points_per_independent,
    )


def cells_of(grid: PixelGrid) -> tuple[float, float, float, float]:
    """Coordinates (x, y) of the centre of cell (0, 0), and cells per unit of either."""
    return grid.x0, grid.y0, 1 / grid.step_x, 1 / grid.step_y


def confidence_weights(least_confidence: int) -> FloatArray:
    """Weights (256,) of points by the confidence of their match, whose noise falls as that rises; 0 below the least."""
    weights = (np.arange(_MOST_CONFIDENCE + 1) / _MOST_CONFIDENCE) ** 2
    weights[:least_confidence] = 0.0
    return weights


def grid_cells(
    pieces: Sequence[CellPoints],
    window: Window,
    *,
    kernel_cells: float,
    gate_sigmas: float,
    point_sigma_m: float,
    points_per_independent: float,
) -> GriddedHeights:
    """Heights at the cell centres of a window of a grid from points on a surface.

    Each height is that of a plane fitted to the points of the cell and its eight neighbours, the neighbours with
    less weight: slopes leave no bias however unevenly the points lie. Gross errors are kept out by
    a gate about medians. Cells without points are filled only where at least five direct neighbours have some.

    Parameters
    ----------
    pieces : sequence of CellPoints
        Their points outside the window are not used.
    window : Window
        May reach beyond the grid.
    kernel_cells : float
        Standard deviation, in cells, of the Gaussian of the distance between cells that weighs the neighbours' points.
    gate_sigmas : float
        Points farther from the local surface than this many robust standard deviations are left out; half the relief of
        the neighbouring cells is added, so that ridges stay.
    point_sigma_m : float
        Matching noise as standard deviation of the height of a point of weight 1. The scatter within a cell is never
        believed to be less, since neighbouring pixels err together.
    points_per_independent : float
        Number of neighbouring points that carry the information of one, for the same reason.

    Notes
    -----
    Windows with a halo of `HALO_CELLS` cells give the heights of the whole.
    """
    ordered, starts = _by_cell(pieces, window)
    return GriddedHeights(
        *kernels.planes_of_cells(
            ordered,
            starts,
            window.shape,
            point_sigma_m,
            gate_sigmas,
            math.exp(-1 / (2 * kernel_cells**2)),
            _SLOPE_WEIGHT,
            _NEIGHBOURS_TO_FILL,
            points_per_independent,
        )
    )


def _room(name: str, size: int, dtype: DTypeLike) -> NDArray[Any]:
    """Memory (size,) of this thread, what it held before: fresh memory would be cleared each time it is asked for."""
    kept = getattr(_rooms, name, None)
    if kept is None or kept.size < size:
        kept = np.empty(size + size // 8, dtype)
        setattr(_rooms, name, kept)
    return kept[:size]


def _by_cell(pieces: Sequence[CellPoints], window: Window) -> tuple[Float32Array, IntArray]:
    """Points (N, 4) in the order of the window's cells, places from the cell's centre, and where each cell starts.

    A few more than there are, which belong to no cell.
    """
    counts = np.zeros(window.shape[0] * window.shape[1] + 1, np.uint32)
    # Unsigned: what cannot be negative need not be looked at as places from the end.
    ends = list(accumulate((len(piece.values) for piece in pieces), initial=0))
    room = _room("cells", ends[-1], np.uint32)
    cells = [room[first:last] for first, last in pairwise(ends)]
    for piece, of_piece in zip(pieces, cells, strict=True):
        shift = (piece.row0 - window.row0, piece.column0 - window.column0)
        kernels.count_by_cell(piece.values, *shift, window.shape, of_piece, counts)
    starts = np.zeros(len(counts), np.int32)
    np.cumsum(counts[:-1], dtype=np.int32, out=starts[1:])
    ordered = _room("ordered", 4 * (int(starts[-1]) + kernels.MORE_POINTS), np.float32).reshape(-1, 4)
    ordered[starts[-1] :] = 0
    place = starts[:-1].astype(np.uint32)
    for piece, of_piece in zip(pieces, cells, strict=True):
        kernels.place_by_cell(piece.values, of_piece, place, ordered)
    return ordered, starts


def map_boxes(frame: LocalFrame, crs: str, low_m: FloatArray, high_m: FloatArray) -> tuple[MapFrame, FloatArray]:
    """Boxes on the map around boxes in the local frame, and the change between the two.

    Parameters
    ----------
    frame : LocalFrame
    crs : str
    low_m, high_m : (N, 3) arrays, m
        Least and greatest local coordinates of each box.

    Returns
    -------
    map_frame : MapFrame
        Valid in all boxes.
    boxes : (N, 4) array, m
        xmin, ymin, xmax, ymax.
    """
    ends = np.stack([low_m, high_m])
    picks = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, -1).T
    corners = np.stack([np.stack([ends[p, :, axis] for axis, p in enumerate(pick)], axis=-1) for pick in picks])
    lonlath = frame.geodetic_from_local(corners)
    placed = Transformer.from_crs("EPSG:4979", crs, always_xy=True).transform(*np.moveaxis(lonlath, -1, 0))[:2]
    boxes = np.stack([*(p.min(axis=0) for p in placed), *(p.max(axis=0) for p in placed)], axis=-1)
    everything = (*boxes[:, :2].min(axis=0), *boxes[:, 2:].max(axis=0))
    return MapFrame(frame, crs, everything), boxes


def boxes_meeting(boxes: FloatArray, bounds: tuple[float, float, float, float]) -> list[int]:
    """Numbers of the boxes (N, 4) that share ground with bounds (xmin, ymin, xmax, ymax)."""
    xmin, ymin, xmax, ymax = bounds
    meets = (boxes[:, 0] <= xmax) & (boxes[:, 2] >= xmin) & (boxes[:, 1] <= ymax) & (boxes[:, 3] >= ymin)
    return [int(n) for n in np.flatnonzero(meets)]
