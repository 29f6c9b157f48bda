"""Make ground control of a film's matches: filtered, with heights and covariances, half of it held back."""

import logging
from dataclasses import asdict
from functools import partial

import numpy as np
import pandas as pd

from cosp.errors import NotEnoughMatchesError
from cosp.io import gcps, rasters, records, references, tables, vectors
from cosp.io.logs import log_to
from cosp.matching.consistency import places_of, reference_shift
from cosp.matching.control import collect
from cosp.matching.film_image import FilmImage
from cosp.matching.footprint import Footprint
from cosp.matching.ground import map_crs

log = logging.getLogger("collect_gcps")

# Of a table without points.
COLUMNS = {
    **dict.fromkeys(("x_mm", "y_mm", "longitude_deg", "latitude_deg", "height_m"), float),
    **dict.fromkeys(("role", "source"), object),
    **dict.fromkeys(("score", "sigma_px", "sigma_ground_m", "sigma_height_m"), float),
    **dict.fromkeys(("sigma_x_px", "sigma_y_px", "correlation_xy", "residual_x_px", "residual_y_px"), float),
}


def collect_gcps(
    matches_paths,
    film_path,
    footprint_path,
    reference_dem_path,
    reference_image_path,
    unstable_terrain_path,
    own_gcps_path,
    gcps_path,
    summary_path,
    *,
    needed=True,
    reference_dem_heights,
    tile_mm,
    gate_px,
    min_per_tile,
    trials,
    relief_min_places,
    relief_min_share,
    cell_mm,
    per_cell,
    max_slope_deg,
    white,
    scratch_grey,
    reference_sigma_m,
    dem_sigma_m,
    shift_search_m,
    correct_reference_shift,
    check_columns,
    check_rows,
    min_gcps,
    relief_min_gcps,
    seed,
):
    camera = records.read(footprint_path, Footprint).camera
    crs = map_crs(camera)
    film = FilmImage(rasters.info(film_path).grid, lambda window: rasters.read(film_path, window=window))
    heights_on = references.heights_on(reference_dem_path, crs, reference_dem_heights)
    dem_posting_m = references.posting_m(reference_dem_path)
    shift_m, shift = (0.0, 0.0), None
    if reference_image_path and shift_search_m > 0:
        found = reference_shift(
            references.image_on(reference_image_path, crs),
            heights_on,
            places_of(camera, crs),
            posting_m=max(dem_posting_m, references.posting_m(reference_image_path)),
            search_m=shift_search_m,
            threads=1,
        )
        corrected = correct_reference_shift and found.significant
        shift = {**asdict(found), "corrected": corrected}
        if corrected:
            shift_m = (found.east_m, found.north_m)
        if found.significant:
            log.warning(
                "places in the reference image need %+.0f m east and %+.0f m north to fit the reference DEM%s",
                found.east_m,
                found.north_m,
                ", which they got" if corrected else "; correct_reference_shift would add that",
            )
    own = None
    if own_gcps_path:
        own = gcps.read(own_gcps_path)
        own = own[own["scene"] == camera.scene].drop(columns="scene").reset_index(drop=True)
        log.info("%d points of %s are on this film", len(own), own_gcps_path)
    try:
        table, summary = collect(
            pd.concat([tables.read(path) for path in matches_paths], ignore_index=True),
            film,
            camera,
            heights_on=heights_on,
            unstable_on=partial(vectors.rasterise, unstable_terrain_path, crs=crs) if unstable_terrain_path else None,
            crs=crs,
            dem_posting_m=dem_posting_m,
            reference_shift_m=shift_m,
            own=own,
            tile_mm=tile_mm,
            gate_px=gate_px,
            min_per_tile=min_per_tile,
            trials=trials,
            relief=not reference_image_path,
            relief_min_places=relief_min_places,
            relief_min_share=relief_min_share,
            cell_mm=cell_mm,
            per_cell=per_cell,
            max_slope_deg=max_slope_deg,
            white=white,
            scratch_grey=scratch_grey,
            reference_sigma_m=reference_sigma_m,
            dem_sigma_m=dem_sigma_m,
            check_columns=check_columns,
            check_rows=check_rows,
            min_gcps=min_gcps if reference_image_path else relief_min_gcps,
            rng=np.random.default_rng(seed),
        )
    except NotEnoughMatchesError as error:
        if needed:
            raise
        log.warning("%s; other frames of the block have to carry it", error)
        table, summary = (
            pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in COLUMNS.items()}),
            no_control(error),
        )
    tables.write(gcps_path, table)
    records.write(
        summary_path, {"kind": "gcps", "version": 1, "scene": camera.scene, **summary, "reference_shift": shift}
    )


def no_control(error):
    """What is said of a film without control, which other frames of its block have to carry."""
    return {"control": 0, "check": 0, "rejected": 0, "own": 0, "reason": str(error)}


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        collect_gcps(
            matches_paths=snakemake.input.matches,
            film_path=snakemake.input.film,
            footprint_path=snakemake.input.footprint,
            reference_dem_path=snakemake.input.reference_dem,
            reference_image_path=snakemake.input.get("reference_image"),
            unstable_terrain_path=snakemake.input.get("unstable_terrain"),
            own_gcps_path=snakemake.input.get("own_gcps"),
            gcps_path=snakemake.output.gcps,
            summary_path=snakemake.output.summary,
            needed=snakemake.params.needed,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            tile_mm=snakemake.params.tile_mm,
            gate_px=snakemake.params.gate_px,
            min_per_tile=snakemake.params.min_per_tile,
            trials=snakemake.params.trials,
            relief_min_places=snakemake.params.relief_min_places,
            relief_min_share=snakemake.params.relief_min_share,
            cell_mm=snakemake.params.cell_mm,
            per_cell=snakemake.params.per_cell,
            max_slope_deg=snakemake.params.max_slope_deg,
            white=snakemake.params.white,
            scratch_grey=snakemake.params.scratch_grey,
            reference_sigma_m=snakemake.params.reference_sigma_m,
            dem_sigma_m=snakemake.params.dem_sigma_m,
            shift_search_m=snakemake.params.shift_search_m,
            correct_reference_shift=snakemake.params.correct_reference_shift,
            check_columns=snakemake.params.check_columns,
            check_rows=snakemake.params.check_rows,
            min_gcps=snakemake.params.min_gcps,
            relief_min_gcps=snakemake.params.relief_min_gcps,
            seed=snakemake.params.seed,
        )
