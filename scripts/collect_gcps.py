"""Make ground control of a film's matches: filtered, with heights and covariances, half of it held back."""

from functools import partial

import numpy as np
import pandas as pd

from cosp.io import rasters, records, references, tables, vectors
from cosp.io.logs import log_to
from cosp.matching.control import collect
from cosp.matching.film_image import FilmImage
from cosp.matching.footprint import Footprint
from cosp.matching.ground import map_crs


def collect_gcps(
    matches_paths,
    film_path,
    footprint_path,
    reference_dem_path,
    unstable_terrain_path,
    gcps_path,
    summary_path,
    *,
    reference_dem_heights,
    tile_mm,
    gate_px,
    min_per_tile,
    trials,
    cell_mm,
    per_cell,
    max_slope_deg,
    white,
    reference_sigma_m,
    dem_sigma_m,
    check_columns,
    check_rows,
    min_gcps,
    seed,
):
    camera = records.read(footprint_path, Footprint).camera
    crs = map_crs(camera)
    film = FilmImage(rasters.info(film_path).grid, lambda window: rasters.read(film_path, window=window))
    gcps, summary = collect(
        pd.concat([tables.read(path) for path in matches_paths], ignore_index=True),
        film,
        camera,
        heights_on=references.heights_on(reference_dem_path, crs, reference_dem_heights),
        unstable_on=partial(vectors.rasterise, unstable_terrain_path, crs=crs) if unstable_terrain_path else None,
        crs=crs,
        dem_posting_m=references.posting_m(reference_dem_path),
        tile_mm=tile_mm,
        gate_px=gate_px,
        min_per_tile=min_per_tile,
        trials=trials,
        cell_mm=cell_mm,
        per_cell=per_cell,
        max_slope_deg=max_slope_deg,
        white=white,
        reference_sigma_m=reference_sigma_m,
        dem_sigma_m=dem_sigma_m,
        check_columns=check_columns,
        check_rows=check_rows,
        min_gcps=min_gcps,
        rng=np.random.default_rng(seed),
    )
    tables.write(gcps_path, gcps)
    records.write(summary_path, {"kind": "gcps", "version": 1, "scene": camera.scene, **summary})


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        collect_gcps(
            matches_paths=snakemake.input.matches,
            film_path=snakemake.input.film,
            footprint_path=snakemake.input.footprint,
            reference_dem_path=snakemake.input.reference_dem,
            unstable_terrain_path=snakemake.input.get("unstable_terrain"),
            gcps_path=snakemake.output.gcps,
            summary_path=snakemake.output.summary,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            tile_mm=snakemake.params.tile_mm,
            gate_px=snakemake.params.gate_px,
            min_per_tile=snakemake.params.min_per_tile,
            trials=snakemake.params.trials,
            cell_mm=snakemake.params.cell_mm,
            per_cell=snakemake.params.per_cell,
            max_slope_deg=snakemake.params.max_slope_deg,
            white=snakemake.params.white,
            reference_sigma_m=snakemake.params.reference_sigma_m,
            dem_sigma_m=snakemake.params.dem_sigma_m,
            check_columns=snakemake.params.check_columns,
            check_rows=snakemake.params.check_rows,
            min_gcps=snakemake.params.min_gcps,
            seed=snakemake.params.seed,
        )
