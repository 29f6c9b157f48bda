"""Say how good a pair's DEM is: models and reference in, differences, statistics and figures out."""

import logging
import math

import numpy as np

from cosp.camera.mapping import MapProjector
from cosp.camera.panoramic import PanoramicCamera
from cosp.dem.assessment import seen_by, statistics, textured
from cosp.dem.terrain import slope_deg, stable_terrain
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters, records, vectors
from cosp.io.heights import ellipsoidal_heights
from cosp.io.logs import log_to
from cosp.report import figures

STRIP_ROWS = 512
CELLS_OF_MAPS = 4_000_000  # more than figures show


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
    projectors = [
        (
            MapProjector(records.read(camera_path, PanoramicCamera), crs, grid.bounds),
            rasters.info(film_path).grid.bounds,
        )
        for film_path, camera_path in zip(film_paths, camera_paths, strict=True)
    ]
    references = {"reference": (reference_dem_path, reference_dem_heights)}
    if check_dem_path:
        references["check"] = (check_dem_path, check_dem_heights)
    halo = max(1, texture_cells)

    def examined(strip):
        """Both models and the difference in a strip, and what statistics need of the cells that are asked for."""
        grown = strip.grown(halo, grid.shape)
        part = grid.window(grown.row0, grown.row1, grown.column0, grown.column1)
        models = {
            name: rasters.read(path, window=grown)
            for name, path in (("before", dem_path), ("after", coregistered_path))
        }
        others = {name: ellipsoidal_heights(path, part, crs, heights) for name, (path, heights) in references.items()}
        slope = slope_deg(others["reference"], grid.step_x, grid.step_y)
        unstable = vectors.rasterise(unstable_path, part, crs) if unstable_path else None
        asked = stable_terrain(slope, unstable, slope_limit_deg=slope_limit_deg)
        if area_path:
            asked &= vectors.rasterise(area_path, part, crs)
        for projector, film_bounds_mm in projectors:
            asked &= seen_by(projector.film, others["reference"], part, film_bounds_mm)
        # Texture is that of the film at the DEM's posting; a finer orthophoto is averaged.
        grey = rasters.read_on_grid(ortho_path, part, crs, resampling="average")
        has_texture = textured(grey, least_grey=texture_grey, window_cells=texture_cells)
        inner = strip.inside(grown).slices
        chosen = asked[inner]
        cells = {"slope": slope[inner][chosen], "has_texture": has_texture[inner][chosen]}
        for other, heights_m in others.items():
            for name, model in models.items():
                cells[other, name] = (model - heights_m)[inner][chosen]
        return models["after"][inner], (models["after"] - others["reference"])[inner], cells

    factor = max(1, math.ceil(math.sqrt(math.prod(grid.shape) / CELLS_OF_MAPS)))
    height = factor * max(1, STRIP_ROWS // factor)  # whole steps of the maps
    gathered, after_thinned, difference_thinned = [], [], []
    with rasters.create(
        difference_path,
        shape=grid.shape,
        dtype="float32",
        grid=grid,
        crs=crs,
        descriptions=["height_difference_m"],
        tags={"content": "coregistered DEM minus reference DEM", "unit": "metre"},
        cog=True,
    ) as differences:
        for row in range(0, grid.shape[0], height):
            strip = Window(row, min(row + height, grid.shape[0]), 0, grid.shape[1])
            after_m, difference_m, cells = examined(strip)
            differences.write(strip, difference_m)
            gathered.append(cells)
            # Copies: a view would hold on to the whole strip.
            after_thinned.append(after_m[::factor, ::factor].copy())
            difference_thinned.append(difference_m[::factor, ::factor].copy())
    cells = {name: np.concatenate([strip.pop(name) for strip in gathered]) for name in list(gathered[0])}
    everything = np.ones(len(cells["slope"]), bool)

    def compare(other):
        said = {}
        for name in ("before", "after"):
            said[name] = statistics(
                cells[other, name],
                everything,
                cells["has_texture"],
                cells["slope"],
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
        **compare("reference"),
    }
    if check_dem_path:
        quality["check"] = compare("check")

    after_m, difference_m = np.concatenate(after_thinned), np.concatenate(difference_thinned)
    map_grid = PixelGrid(grid.x0, grid.y0, factor * grid.step_x, factor * grid.step_y, after_m.shape)
    figures.hillshade(hillshade_path, after_m, map_grid, title=f"{pair}: DEM after coregistration")
    figures.difference_map(difference_map_path, difference_m, map_grid, title=f"{pair}: DEM minus reference DEM")
    figures.histogram(
        histogram_path,
        {f"{name} coregistration": cells["reference", name] for name in ("before", "after")},
        stable=everything,
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
