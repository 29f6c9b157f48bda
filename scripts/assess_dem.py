"""Say how good a pair's DEM is: models and reference in, differences, statistics and figures out."""

import logging

import numpy as np

from cosp.camera.mapping import MapProjector
from cosp.camera.panoramic import PanoramicCamera
from cosp.dem.assessment import seen_by, statistics, textured
from cosp.dem.terrain import slope_deg, stable_terrain
from cosp.io import rasters, records, vectors
from cosp.io.heights import ellipsoidal_heights
from cosp.io.logs import log_to
from cosp.report import figures


def assess_dem(
    dem_path,
    coregistered_path,
    reference_dem_path,
    ortho_path,
    film_paths,
    camera_paths,
    y_parallax_path,
    adjustment_path,
    points_summary_path,
    unstable_path,
    area_path,
    check_dem_path,
    difference_path,
    quality_path,
    hillshade_path,
    difference_map_path,
    histogram_path,
    *,
    pair,
    reference_dem_heights,
    check_dem_heights,
    slope_limit_deg,
    slope_edges_deg,
    texture_grey,
    texture_cells,
):
    log = logging.getLogger("assess_dem")
    info = rasters.info(dem_path)
    grid, crs = info.grid, info.crs
    models = {"before": rasters.read(dem_path), "after": rasters.read(coregistered_path)}
    reference_m = ellipsoidal_heights(reference_dem_path, grid, crs, reference_dem_heights)
    unstable = vectors.rasterise(unstable_path, grid, crs) if unstable_path else None
    slope = slope_deg(reference_m, grid.step_x, grid.step_y)
    stable = stable_terrain(slope, unstable, slope_limit_deg=slope_limit_deg)

    footprint = vectors.rasterise(area_path, grid, crs) if area_path else np.ones(grid.shape, bool)
    for film_path, camera_path in zip(film_paths, camera_paths, strict=True):
        projector = MapProjector(records.read(camera_path, PanoramicCamera), crs, grid.bounds)
        footprint &= seen_by(projector.film, reference_m, grid, rasters.info(film_path).grid.bounds)
    asked = stable & footprint
    # Texture is that of the film at the DEM's posting; a finer orthophoto is averaged.
    grey = rasters.read_on_grid(ortho_path, grid, crs, resampling="average")
    has_texture = textured(grey, least_grey=texture_grey, window_cells=texture_cells)

    def compare(other_m):
        said = {}
        for name, model in models.items():
            said[name] = statistics(
                model - other_m,
                asked,
                has_texture,
                slope,
                edges_deg=slope_edges_deg,
                cell_area_m2=abs(grid.step_x * grid.step_y),
            )
            log.info(
                "%s: median %.2f m, NMAD %.2f m, completeness %.3f",
                name,
                said[name]["median"],
                said[name]["nmad"],
                said[name]["completeness"],
            )
        return said

    y_parallax = records.read_json(y_parallax_path)
    adjustment = records.read_json(adjustment_path)
    points = records.read_json(points_summary_path)
    quality = {
        "kind": "quality",
        "version": 1,
        "pair": pair,
        "crs": crs,
        "posting_m": abs(grid.step_x),
        "height_per_px_m": points["height_per_px_m"],
        "sigma_naught_px": adjustment["sigma_naught_px"],
        "y_parallax": {"median_px": y_parallax["median_px"], "sd_px": y_parallax["sd_px"]},
        **compare(reference_m),
    }
    if check_dem_path:
        check_m = ellipsoidal_heights(check_dem_path, grid, crs, check_dem_heights)
        quality["check"] = compare(check_m)

    difference_m = models["after"] - reference_m
    rasters.write(
        difference_path,
        difference_m,
        grid=grid,
        crs=crs,
        descriptions=["height_difference_m"],
        tags={"content": "coregistered DEM minus reference DEM", "unit": "metre"},
        cog=True,
    )
    figures.hillshade(hillshade_path, models["after"], grid, title=f"{pair}: DEM after coregistration")
    figures.difference_map(difference_map_path, difference_m, grid, title=f"{pair}: DEM minus reference DEM")
    figures.histogram(
        histogram_path,
        {f"{name} coregistration": model - reference_m for name, model in models.items()},
        stable=asked,
        title=f"{pair}: differences on stable terrain",
    )
    records.write(quality_path, quality)


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        assess_dem(
            dem_path=snakemake.input.dem,
            coregistered_path=snakemake.input.dem_coregistered,
            reference_dem_path=snakemake.input.reference_dem,
            ortho_path=snakemake.input.ortho,
            film_paths=[snakemake.input.fore_film, snakemake.input.aft_film],
            camera_paths=[
                f"{snakemake.input.cameras}/{scene}.json" for scene in (snakemake.params.fore, snakemake.params.aft)
            ],
            y_parallax_path=snakemake.input.y_parallax,
            adjustment_path=snakemake.input.adjustment,
            points_summary_path=snakemake.input.points,
            unstable_path=snakemake.input.unstable_terrain or None,
            area_path=snakemake.input.area_of_interest or None,
            check_dem_path=snakemake.input.check_dem or None,
            difference_path=snakemake.output.difference,
            quality_path=snakemake.output.quality,
            hillshade_path=snakemake.output.hillshade,
            difference_map_path=snakemake.output.figure,
            histogram_path=snakemake.output.histogram,
            pair=snakemake.wildcards.pair,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            check_dem_heights=snakemake.params.check_dem_heights,
            slope_limit_deg=snakemake.params.slope_limit_deg,
            slope_edges_deg=snakemake.params.slope_edges_deg,
            texture_grey=snakemake.params.texture_grey,
            texture_cells=snakemake.params.texture_cells,
        )
