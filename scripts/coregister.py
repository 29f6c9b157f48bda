"""Bring a pair's DEM onto the reference over stable terrain: one shift, then an affine transformation per tile."""

import logging
import math
from dataclasses import replace

import numpy as np

from cosp.dem.coregistration import coregister as coregister_model
from cosp.dem.coregistration import describe, match_tiles, whole_shift
from cosp.dem.terrain import slope_deg, stable_terrain
from cosp.errors import NoOverlapError
from cosp.geometry.grids import PixelGrid
from cosp.geometry.statistics import summarise
from cosp.imaging.windows import Window
from cosp.io import rasters, records, vectors
from cosp.io.heights import ellipsoidal_heights
from cosp.io.logs import log_to

CELLS_AT_ONCE = 30_000_000  # 72 bytes each are needed to match them


def coregister(
    dem_path,
    reference_dem_path,
    unstable_path,
    coregistered_path,
    summary_path,
    *,
    reference_dem_heights,
    slope_limit_deg,
    outlier_m,
    least_cells,
    most_cells,
    tile_km,
    overlap_km,
    least_share,
    sigma_matrix,
    sigma_shift_m,
    cells_per_independent,
    seed,
    threads,
    cells_at_once=CELLS_AT_ONCE,
):
    log = logging.getLogger("coregister")
    info = rasters.info(dem_path)
    crs = info.crs
    # A large model is matched by every so-manyth of its cells, and moved whole, strip by strip.
    factor = max(1, math.ceil(math.sqrt(math.prod(info.shape) / cells_at_once)))
    heights_m = thinned(dem_path, factor)
    grid = PixelGrid(info.grid.x0, info.grid.y0, factor * info.grid.step_x, factor * info.grid.step_y, heights_m.shape)
    reference_m = ellipsoidal_heights(reference_dem_path, grid, crs, reference_dem_heights)
    if not np.isfinite(heights_m - reference_m).any():
        raise NoOverlapError(f"{dem_path} and {reference_dem_path} have no ground in common")
    unstable = vectors.rasterise(unstable_path, grid, crs) if unstable_path else None
    slope = slope_deg(reference_m, grid.step_x, grid.step_y)
    stable = stable_terrain(slope, unstable, slope_limit_deg=slope_limit_deg)

    shift_m, method = whole_shift(
        heights_m,
        reference_m,
        stable,
        grid,
        crs,
        outlier_m=outlier_m,
        least_cells=least_cells,
        most_cells=most_cells,
        rng=np.random.default_rng(seed),
    )
    log.info("shift of the whole (%s): %.2f m east, %.2f m north, %.2f m up", method, *shift_m)
    found = match_tiles(
        heights_m,
        reference_m,
        stable,
        grid,
        shift_m,
        tile_m=tile_km * 1000,
        overlap_m=overlap_km * 1000,
        least_share=least_share,
        outlier_m=outlier_m,
        sigma_matrix=sigma_matrix,
        sigma_shift_m=sigma_shift_m,
        cells_per_independent=cells_per_independent,
        most_cells=most_cells,
        threads=threads,
    )
    log.info("%d tiles, %d of them by an affine transformation", len(found), sum(t.method == "affine" for t in found))
    before_m = summarise((heights_m - reference_m)[stable])
    stable_cells = int((stable & np.isfinite(heights_m)).sum()) * factor**2
    heights_m = None  # the whole one takes its place
    scaled = [replace(tile, window=scaled_window(tile.window, factor, info.shape)) for tile in found]
    moved_m = coregister_model(rasters.read(dem_path), scaled, info.grid, overlap_m=overlap_km * 1000)
    rasters.write(
        coregistered_path, moved_m, grid=info.grid, crs=crs, descriptions=["height_m"], tags=info.tags, cog=True
    )
    records.write(
        summary_path,
        {
            "kind": "coregistration",
            "version": 1,
            "shift_m": shift_m,
            "shift_method": method,
            "stable_cells": stable_cells,
            "before_m": before_m,
            "after_m": summarise((moved_m[::factor, ::factor] - reference_m)[stable]),
            "tiles": [describe(tile, grid) for tile in found],
        },
    )


def thinned(path, factor):
    """Every so-manyth row and column of a raster's first band, read by strips."""
    rows, columns = rasters.info(path).shape
    height = factor * 512
    strips = [Window(row, min(row + height, rows), 0, columns) for row in range(0, rows, height)]
    return np.concatenate([rasters.read(path, window=strip)[::factor, ::factor].copy() for strip in strips])


def scaled_window(window, factor, shape):
    """A window of thinned cells in the cells of the whole."""
    return Window(
        window.row0 * factor,
        min(window.row1 * factor, shape[0]),
        window.column0 * factor,
        min(window.column1 * factor, shape[1]),
    )


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        coregister(
            dem_path=snakemake.input.dem,
            reference_dem_path=snakemake.input.reference_dem,
            unstable_path=snakemake.input.unstable_terrain or None,
            coregistered_path=snakemake.output.dem,
            summary_path=snakemake.output.summary,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            slope_limit_deg=snakemake.params.slope_limit_deg,
            outlier_m=snakemake.params.outlier_m,
            least_cells=snakemake.params.least_cells,
            most_cells=snakemake.params.most_cells,
            tile_km=snakemake.params.tile_km,
            overlap_km=snakemake.params.overlap_km,
            least_share=snakemake.params.least_share,
            sigma_matrix=snakemake.params.sigma_matrix,
            sigma_shift_m=snakemake.params.sigma_shift_m,
            cells_per_independent=snakemake.params.cells_per_independent,
            seed=snakemake.params.seed,
            threads=snakemake.threads,
        )
