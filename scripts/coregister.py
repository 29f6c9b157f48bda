"""Bring a pair's DEM onto the reference over stable terrain: one shift, then an affine transformation per tile."""

import logging

import numpy as np

from cosp.dem.coregistration import coregister as coregister_model
from cosp.dem.coregistration import describe, match_tiles, whole_shift
from cosp.dem.terrain import slope_deg, stable_terrain
from cosp.errors import NoOverlapError
from cosp.geometry.statistics import summarise
from cosp.io import rasters, records, vectors
from cosp.io.heights import ellipsoidal_heights
from cosp.io.logs import log_to


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
):
    log = logging.getLogger("coregister")
    info = rasters.info(dem_path)
    grid, crs = info.grid, info.crs
    heights_m = rasters.read(dem_path)
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
    moved_m = coregister_model(heights_m, found, grid, overlap_m=overlap_km * 1000)
    rasters.write(coregistered_path, moved_m, grid=grid, crs=crs, descriptions=["height_m"], tags=info.tags, cog=True)
    records.write(
        summary_path,
        {
            "kind": "coregistration",
            "version": 1,
            "shift_m": shift_m,
            "shift_method": method,
            "stable_cells": int((stable & np.isfinite(heights_m)).sum()),
            "before_m": summarise((heights_m - reference_m)[stable]),
            "after_m": summarise((moved_m - reference_m)[stable]),
            "tiles": [describe(tile, grid) for tile in found],
        },
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
