"""A model brought onto a reference: one shift for all, then an affine transformation per tile."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import xdem
from affine import Affine
from pyproj import CRS
from scipy.ndimage import map_coordinates

from cosp.arrays import BoolArray, Float32Array, FloatArray
from cosp.dem.least_squares_matching import AffineShift, SurfaceMatch, match_surfaces
from cosp.dem.terrain import slope_deg
from cosp.geometry.grids import PixelGrid
from cosp.geometry.statistics import nmad
from cosp.imaging.windows import Window, cosine_weights

_LOG = logging.getLogger(__name__)

_STRIP_ROWS = 1024
_STEEP_ENOUGH_DEG = 3.0  # slopes below say nothing about shifts in plan


@dataclass(frozen=True)
class TileMatch:
    """What was found for one tile.

    Parameters
    ----------
    window : Window
    method : str
        "affine", or "shift" where the tile follows the shift of the whole model.
    share : float
        Share of the tile's cells that are stable and have a height in both models.
    transformation : AffineShift
    match : SurfaceMatch or None
    """

    window: Window
    method: str
    share: float
    transformation: AffineShift
    match: SurfaceMatch | None


def whole_shift(
    heights_m: FloatArray,
    reference_m: FloatArray,
    stable: BoolArray,
    grid: PixelGrid,
    crs: str,
    *,
    outlier_m: float,
    least_cells: int,
    most_cells: int,
    rng: np.random.Generator,
) -> tuple[FloatArray, str]:
    """East, north, up that bring a model onto a reference, (3,) in metres, and how that was found.

    By the cosine of aspect in differences over tangent of slope where there is enough sloping stable ground
    ("nuth_kaab"), as a median height alone where there is not ("vertical"), zero without any common cell ("none").

    Parameters
    ----------
    heights_m, reference_m : (R, C) arrays
        On one grid.
    stable : (R, C) boolean array
    grid : PixelGrid
    crs : str
    outlier_m : float
        Differences farther than this from their median are left out.
    least_cells : int
        Sloping stable cells that are needed for a shift in plan.
    most_cells : int
        A larger number is thinned.
    rng : Generator
        Chooses the cells kept when there are more.

    References
    ----------
    [NuthKaab2011] equation 3, as in xDEM.
    """
    difference = np.asarray(reference_m, np.float32) - np.asarray(heights_m, np.float32)
    usable = stable & np.isfinite(difference)
    if not usable.any():
        return np.zeros(3), "none"
    median = float(np.median(difference[usable]))
    with np.errstate(invalid="ignore"):
        usable &= np.abs(difference - median) <= outlier_m
        sloping = usable & (slope_deg(reference_m, grid.step_x, grid.step_y) >= _STEEP_ENOUGH_DEG)
    vertical = np.array([0.0, 0.0, float(np.median(difference[usable]))])
    if int(sloping.sum()) < least_cells:
        return vertical, "vertical"
    # A block of rows and columns that holds all of the stable cells keeps xDEM's work small.
    rows, columns = np.nonzero(sloping.any(1))[0], np.nonzero(sloping.any(0))[0]
    window = Window(rows[0], rows[-1] + 1, columns[0], columns[-1] + 1).grown(3, grid.shape)
    part = grid.window(window.row0, window.row1, window.column0, window.column1)
    method = xdem.coreg.NuthKaab(subsample=min(int(most_cells), int(sloping.sum())))
    method.fit(
        np.asarray(reference_m, np.float32)[window.slices],
        np.asarray(heights_m, np.float32)[window.slices],
        inlier_mask=sloping[window.slices],
        transform=Affine(part.step_x, 0, part.x0 - part.step_x / 2, 0, part.step_y, part.y0 - part.step_y / 2),
        crs=CRS.from_user_input(crs),
        random_state=rng,
    )
    found = method.meta["outputs"]["affine"]
    shift = np.array([found["shift_x"], found["shift_y"], found["shift_z"]], dtype=float)
    moved = displaced(heights_m, grid, [_whole(grid, shift)], [_everything(grid)], border_cells=1)
    before, after = nmad(difference[sloping]), nmad((reference_m - moved)[sloping])
    if not np.isfinite(shift).all() or not after <= before:
        _LOG.warning("shift %s left out: NMAD %.2f m with it, %.2f m without", shift.round(2), after, before)
        return vertical, "vertical"
    return shift, "nuth_kaab"


def match_tiles(
    heights_m: FloatArray,
    reference_m: FloatArray,
    stable: BoolArray,
    grid: PixelGrid,
    shift_m: FloatArray,
    *,
    tile_m: float,
    overlap_m: float,
    least_share: float,
    outlier_m: float,
    sigma_matrix: float,
    sigma_shift_m: float,
    cells_per_independent: float,
    most_cells: int,
    threads: int = 1,
) -> list[TileMatch]:
    """The affine transformation of every tile of a model onto a reference.

    Parameters
    ----------
    heights_m, reference_m, stable, grid
        As for `whole_shift`.
    shift_m : (3,) array
        From `whole_shift`: where each tile starts, and what it keeps when it cannot be matched.
    tile_m, overlap_m : float
        Side of a tile and what neighbours share; a smaller model is one tile.
    least_share : float
        Share of a tile's cells that must be stable and common, else it keeps the shift of the whole.
    outlier_m : float
        As for `whole_shift`; after the shift.
    sigma_matrix, sigma_shift_m, cells_per_independent, most_cells
        As for `match_surfaces`.
    threads : int

    References
    ----------
    [Ghuffar2022] section III-F.
    """
    with np.errstate(invalid="ignore"):
        common = stable & (np.abs(heights_m + shift_m[2] - reference_m) <= outlier_m)
    covered = np.isfinite(heights_m)

    def match(window: Window) -> TileMatch:
        part = grid.window(window.row0, window.row1, window.column0, window.column1)
        chosen, inside = common[window.slices], covered[window.slices]
        # Of the cells that have a height: half of most tiles lies beside the film.
        share = float(chosen.sum() / max(int(inside.sum()), 1))
        if share < least_share or chosen.sum() < 100:
            return TileMatch(window, "shift", share, _whole(part, shift_m), None)
        found = match_surfaces(
            heights_m[window.slices],
            reference_m[window.slices],
            chosen,
            part,
            start_m=shift_m,
            sigma_matrix=sigma_matrix,
            sigma_shift_m=sigma_shift_m,
            cells_per_independent=cells_per_independent,
            most_cells=most_cells,
        )
        return TileMatch(window, "affine", share, found.transformation, found)

    windows = [w for w in _even_tiles(grid, tile_m, overlap_m) if covered[w.slices].any()]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(match, windows))


def displaced(
    heights_m: FloatArray,
    grid: PixelGrid,
    transformations: Sequence[AffineShift],
    windows: Sequence[Window],
    *,
    border_cells: int,
) -> Float32Array:
    """A model moved by transformations that hold in windows, resampled once.

    Displacements, not heights, are blended where windows overlap, with cosine weights: no steps, no double edges.

    Parameters
    ----------
    heights_m : (R, C) array
    grid : PixelGrid
    transformations, windows : sequences of one length
    border_cells : int
        Width over which a window's say fades towards its edge.
    """
    heights_m = np.asarray(heights_m, np.float32)
    result = np.full(heights_m.shape, np.nan, np.float32)
    for row0 in range(0, grid.shape[0], _STRIP_ROWS):
        strip = Window(row0, min(row0 + _STRIP_ROWS, grid.shape[0]), 0, grid.shape[1])
        total = np.zeros(strip.shape)
        moved = np.zeros((*strip.shape, 3))
        for transformation, window in zip(transformations, windows, strict=True):
            low, high = max(window.row0, strip.row0), min(window.row1, strip.row1)
            if low >= high:
                continue
            rows, columns = slice(low - strip.row0, high - strip.row0), slice(window.column0, window.column1)
            weights = cosine_weights(window.shape, border_cells)[low - window.row0 : high - window.row0]
            xy = grid.window(low, high, window.column0, window.column1).centres()
            height = heights_m[low:high, columns]
            points = np.concatenate([xy, np.where(np.isnan(height), transformation.centre_m[2], height)[..., None]], -1)
            moved[rows, columns] += weights[..., None] * transformation.displacement(points)
            total[rows, columns] += weights
        with np.errstate(invalid="ignore"):
            moved /= total[..., None]
        # The height that comes to lie here stood at this place minus its displacement in plan.
        at_rows = np.arange(strip.row0, strip.row1)[:, None] - moved[..., 1] / grid.step_y
        at_columns = np.arange(grid.shape[1])[None, :] - moved[..., 0] / grid.step_x
        result[strip.slices] = _sample_heights(heights_m, at_rows, at_columns) + moved[..., 2]
    return result


def coregister(
    heights_m: FloatArray, tiles_found: Sequence[TileMatch], grid: PixelGrid, *, overlap_m: float
) -> Float32Array:
    """The model after all tiles' transformations, blended over their overlap."""
    return displaced(
        heights_m,
        grid,
        [t.transformation for t in tiles_found],
        [t.window for t in tiles_found],
        border_cells=max(1, round(overlap_m / abs(grid.step_x))),
    )


def describe(tile: TileMatch, grid: PixelGrid) -> dict[str, Any]:
    """What `coregistration.json` says of a tile."""
    part = grid.window(tile.window.row0, tile.window.row1, tile.window.column0, tile.window.column1)
    said: dict[str, Any] = {
        "bounds_m": part.bounds,
        "method": tile.method,
        "stable_share": tile.share,
        "centre_m": tile.transformation.centre_m,
        "shift_m": tile.transformation.shift_m,
        "matrix": tile.transformation.matrix,
    }
    if tile.match is not None:
        said |= {
            "count": tile.match.count,
            "sigma_shift_m": tile.match.sigma_shift_m,
            "nmad_before_m": tile.match.nmad_before_m,
            "nmad_after_m": tile.match.nmad_after_m,
        }
    return said


def _even_tiles(grid: PixelGrid, tile_m: float, overlap_m: float) -> list[Window]:
    """Tiles of nearly one size, none a mere sliver."""
    overlap = round(overlap_m / abs(grid.step_x))

    def pieces(length: int) -> list[tuple[int, int]]:
        step = max(1, round(tile_m / abs(grid.step_x)) - overlap)
        count = max(1, round((length - overlap) / step))
        edges = np.linspace(0, max(length - overlap, 1), count + 1).round().astype(int)
        return [(int(a), min(int(b) + overlap, length)) for a, b in zip(edges[:-1], edges[1:], strict=True)]

    return [Window(*rows, *columns) for rows in pieces(grid.shape[0]) for columns in pieces(grid.shape[1])]


def _sample_heights(heights_m: Float32Array, rows: FloatArray, columns: FloatArray) -> Float32Array:
    """Heights between cells, bilinear among those that exist; NaN where most of the weight is missing."""
    low = max(int(np.floor(np.nanmin(rows, initial=0))) - 1, 0) if np.isfinite(rows).any() else 0
    high = int(np.ceil(np.nanmax(rows, initial=0))) + 2 if np.isfinite(rows).any() else 1
    part = heights_m[low:high]
    valid = np.isfinite(part)
    at = np.stack([np.nan_to_num(rows - low, nan=-9), np.nan_to_num(columns, nan=-9)])
    base = np.float32(np.median(part[valid])) if valid.any() else np.float32(0)
    weight = map_coordinates(valid.astype(np.float32), at, order=1, cval=0.0)
    value = map_coordinates(np.where(valid, part - base, 0).astype(np.float32), at, order=1, cval=0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 0.5, base + value / weight, np.nan).astype(np.float32)


def _whole(grid: PixelGrid, shift_m: FloatArray) -> AffineShift:
    xmin, ymin, xmax, ymax = grid.bounds
    return AffineShift(np.array([(xmin + xmax) / 2, (ymin + ymax) / 2, 0.0]), np.asarray(shift_m), np.zeros((3, 3)))


def _everything(grid: PixelGrid) -> Window:
    return Window(0, grid.shape[0], 0, grid.shape[1])
