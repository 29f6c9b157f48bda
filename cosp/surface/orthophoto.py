"""Orthophotos: film brought onto the map through heights, hidden ground left empty."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cosp.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from cosp.geometry.grids import PixelGrid
from cosp.geometry.lattices import between_nodes
from cosp.imaging.resampling import sample
from cosp.imaging.windows import Window
from cosp.surface import kernels

_SAME_CELL = 1e-6  # cells by which places may differ from rounding alone
_NODE_CELLS = 32  # the direction to the lens changes by a millionth per metre: linear between such nodes
_NODES_ABOUT = 9  # a side; between them the edge of a tile on the film is straight to a few pixels
_FILM_NODE_CELLS = 8  # film points are linear between such nodes to a hundredth of a pixel, at postings of 30 m too


def direction_to_lens(
    locate: Callable[[FloatArray, float], FloatArray],
    grid: PixelGrid,
    film_mm: Callable[[FloatArray, float], FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Map distance per metre of height towards the lens, at every cell of a grid.

    Parameters
    ----------
    locate : function
        Easting and northing (..., 2) of film points (..., 2) at an ellipsoidal height.
    grid : PixelGrid
    film_mm : function
        Film points (..., 2) of eastings and northings (..., 2) at an ellipsoidal height.

    Returns
    -------
    east, north : arrays of the grid's shape
        Metres on the map per metre of height; NaN off the film.
    """
    rise_m = 1000.0
    rows, columns = (np.arange(0, n + _NODE_CELLS, _NODE_CELLS) for n in grid.shape)
    nodes = grid.points(rows[:, None], columns[None, :])
    moved = (locate(film_mm(nodes, 0.0), rise_m) - nodes) / rise_m
    step = (1 / _NODE_CELLS, 1 / _NODE_CELLS)
    east, north = (between_nodes(moved[..., i], (0.0, 0.0), step, grid.shape) for i in range(2))
    return east, north


def on_surface(
    values_of: Callable[[FloatArray, FloatArray], FloatArray], grid: PixelGrid, heights_m: FloatArray
) -> FloatArray:
    """What varies smoothly with place and height, at the cells of a grid on a surface, from few cells at three heights.

    Between nodes bilinear, in height a parabola through the lowest, the middle and the highest of the surface.

    Parameters
    ----------
    values_of : function
        Values (..., K) at eastings and northings (..., 2) and ellipsoidal heights (...).
    grid : PixelGrid
    heights_m : array of the grid's shape
        NaN gives NaN.

    Returns
    -------
    (K, rows, columns) array
    """
    low, high = (float(f.reduce(heights_m, axis=None)) for f in (np.fmin, np.fmax))
    half = max((high - low) / 2, 1.0)
    middle = (low + high) / 2
    rows, columns = (np.arange(0, n + _FILM_NODE_CELLS, _FILM_NODE_CELLS) for n in grid.shape)
    nodes = grid.points(rows[:, None], columns[None, :])
    below, at, above = (values_of(nodes, np.full(nodes.shape[:2], middle + k * half)) for k in (-1, 0, 1))
    step = (1 / _FILM_NODE_CELLS, 1 / _FILM_NODE_CELLS)
    part = (heights_m - middle) / half
    found = []
    for i in range(at.shape[-1]):
        constant, slope, bend = (
            between_nodes(values[..., i], (0.0, 0.0), step, grid.shape)
            for values in (at, (above - below) / 2, (above + below) / 2 - at)
        )
        found.append(constant + part * (slope + part * bend))
    return np.stack(found)


def film_of_cells(
    film_mm: Callable[[FloatArray, FloatArray], FloatArray], grid: PixelGrid, heights_m: FloatArray
) -> FloatArray:
    """Film points (rows, columns, 2), in mm, of the cells of a grid on a surface; see `on_surface`."""
    if not np.isfinite(heights_m).any():
        return np.full((*grid.shape, 2), np.nan)
    return np.moveaxis(on_surface(film_mm, grid, heights_m), 0, -1)


def film_about(
    film_mm: Callable[[FloatArray, FloatArray], FloatArray], grid: PixelGrid, lowest_m: float, highest_m: float
) -> FloatArray:
    """Film points of a few cells of a grid at two heights: between them lies all that its ground can be seen at."""
    rows, columns = (np.linspace(-0.5, n - 0.5, _NODES_ABOUT) for n in grid.shape)
    nodes = grid.points(rows[:, None], columns[None, :])
    return np.stack([film_mm(nodes, np.full(nodes.shape[:2], h)) for h in (lowest_m, highest_m)])


def hidden_from_lens(
    heights_m: FloatArray,
    window: Window,
    grid: PixelGrid,
    east: FloatArray,
    north: FloatArray,
    *,
    tolerance_m: float,
) -> BoolArray:
    """Cells of a window that the lens does not see because terrain stands before them.

    Parameters
    ----------
    heights_m : (R, C) array
        Of the whole grid, so that far ridges count; NaN hides nothing.
    window : Window
    grid : PixelGrid
    east, north : arrays of the window's shape
        From `direction_to_lens` of the window's grid.
    tolerance_m : float
        Terrain must rise this far above the line of sight; matching noise must not hide ground.

    Returns
    -------
    boolean array of the window's shape
    """
    top = float(np.nanmax(heights_m)) if np.isfinite(heights_m).any() else 0.0
    return kernels.hidden_cells(
        np.asarray(heights_m, np.float32),
        np.ascontiguousarray(east / grid.step_x),
        np.ascontiguousarray(north / grid.step_y),
        tolerance_m,
        top,
        window.row0,
        window.row1,
        window.column0,
        window.column1,
    )


def sample_film(film: ByteArray, film_grid: PixelGrid, film_mm: FloatArray, hidden: BoolArray) -> ByteArray:
    """Grey values of the film at film points, 0 where there is none or the ground is hidden.

    Parameters
    ----------
    film : (R, C) uint8 array
        0 means outside of the exposed area.
    film_grid : PixelGrid
        Of `film`, in millimetres.
    film_mm : (..., 2) array
    hidden : (...) boolean array
    """
    rows, columns = film_grid.pixels(film_mm)
    grey = sample(film, rows, columns, interpolation="cubic", border=0)
    # The kernel overshoots beside dark film and may reach 0, which stands for no data.
    exposed = sample(film, rows, columns, interpolation="nearest", border=0) > 0
    return np.where(exposed & ~hidden, np.maximum(grey, 1), 0).astype(np.uint8)


def fill_heights(heights_m: FloatArray, reference_m: FloatArray, shift_m: float) -> Float32Array:
    """Heights with holes filled from another model that is moved by a shift."""
    return np.where(np.isfinite(heights_m), heights_m, reference_m + shift_m).astype(np.float32)


def median_shift(heights_m: FloatArray, reference_m: FloatArray) -> float:
    """By how much heights lie above those of another model, in the median; 0 where they share nothing."""
    difference = heights_m - reference_m
    known = np.isfinite(difference)
    return float(np.median(difference[known])) if known.any() else 0.0


def reach_of_occlusion(lowest_m: float, highest_m: float, east: FloatArray, north: FloatArray, grid: PixelGrid) -> int:
    """Cells over which terrain up to the highest can hide ground from the lowest up, seen along given directions.

    Parameters
    ----------
    lowest_m, highest_m : float
        Of the ground in question and of all terrain.
    east, north : arrays
        From `direction_to_lens`.
    """
    moved = max(float(np.nanmax(np.abs(a), initial=0.0)) for a in (east, north))
    return int(np.ceil(max(highest_m - lowest_m, 0.0) * moved / grid.step_x)) + 2


def cells_below(grid: PixelGrid, part: PixelGrid) -> Window:
    """The window of a grid that another one lies in, with a cell about it for what lies between cells."""
    xmin, ymin, xmax, ymax = part.bounds
    rows, columns = grid.pixels(np.array([[xmin, ymax], [xmax, ymin]]))
    return Window(
        int(np.floor(rows.min())) - 1,
        int(np.ceil(rows.max())) + 2,
        int(np.floor(columns.min())) - 1,
        int(np.ceil(columns.max())) + 2,
    ).grown(0, grid.shape)


def heights_on(heights_m: Float32Array, grid: PixelGrid, part: PixelGrid) -> Float32Array:
    """Heights at the cells of another grid; bilinear, the model's own where both grids agree."""
    same = _same_cells(grid, part)
    if same is not None:
        return heights_m[same.slices]
    return np.asarray(
        sample(heights_m, *grid.pixels(part.centres()), interpolation="linear", border=np.nan), np.float32
    )


def nearest_on(values: BoolArray, grid: PixelGrid, part: PixelGrid) -> BoolArray:
    """Marks of a grid at the cells of another one, the nearest each."""
    same = _same_cells(grid, part)
    if same is not None:
        return values[same.slices]
    rows, columns = grid.pixels(part.centres())
    return np.asarray(sample(values.astype(np.uint8), rows, columns, interpolation="nearest") > 0)


def _same_cells(grid: PixelGrid, part: PixelGrid) -> Window | None:
    """The window of a grid whose cells those of another one are; None if they lie between its cells or beyond."""
    if (grid.step_x, grid.step_y) != (part.step_x, part.step_y):
        return None
    place = grid.pixels(np.array([part.x0, part.y0]))
    row, column = (round(float(v)) for v in place)
    window = Window(row, row + part.shape[0], column, column + part.shape[1])
    if max(abs(place[0] - row), abs(place[1] - column)) > _SAME_CELL or window != window.grown(0, grid.shape):
        return None
    return window


def film_window(film_grid: PixelGrid, film_mm: FloatArray, reach_px: int = 6) -> Window | None:
    """The part of a film that holds the given film points and what a resampling kernel reaches; None if none does."""
    ends = [[f(film_mm[..., i], axis=None) for i in range(2)] for f in (np.fmin.reduce, np.fmax.reduce)]
    if not np.isfinite(ends).all():
        return None
    rows, columns = film_grid.pixels(ends)
    bounds = Window(
        int(np.floor(max(rows.min(), -1e6))) - reach_px,
        int(np.ceil(min(rows.max(), 1e6))) + reach_px + 1,
        int(np.floor(max(columns.min(), -1e6))) - reach_px,
        int(np.ceil(min(columns.max(), 1e6))) + reach_px + 1,
    ).grown(0, film_grid.shape)
    return bounds if min(bounds.shape) > 0 else None
