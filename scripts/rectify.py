"""Fit the epipolar geometry of a pair, for the whole overlap or an area of interest.

From the adjusted cameras first; then y-parallax that the films still show is measured and taken out of the aft rows.
"""

import logging

import numpy as np
from shapely import contains_xy, get_coordinates, segmentize

from cosp.camera.panoramic import PanoramicCamera
from cosp.epipolar.correspondences import FilmMapping, height_range, virtual_conjugates
from cosp.epipolar.parallax import fold_y_parallax, measure_y_parallax, node_grid
from cosp.epipolar.patches import film_patches
from cosp.epipolar.polynomials import Basis
from cosp.epipolar.rectification import fit_rectification
from cosp.geometry.grids import PixelGrid
from cosp.io import rasters, records, vectors
from cosp.io.heights import ellipsoidal_heights
from cosp.io.logs import log_to

GEODETIC = "EPSG:4326"
TERRAIN_STEP_DEG = 1 / 360  # ten seconds: fine enough for the range of heights
LEVELS = 4  # heights at which rays are cut
AREA_POINTS = 60  # a side


def rectify(
    fore_camera_path,
    aft_camera_path,
    fore_film_path,
    aft_film_path,
    reference_dem_path,
    area_of_interest_path,
    rectification_path,
    *,
    reference_dem_heights,
    degree_along,
    degree_across,
    total_degree,
    height_margin_m,
    disparity_margin_px,
    area_margin_px,
    correction_spacing_px,
    y_parallax,
    threads,
):
    log = logging.getLogger("rectify")
    fore = records.read(fore_camera_path, PanoramicCamera)
    aft = records.read(aft_camera_path, PanoramicCamera).moved_to(fore.origin)
    films = (FilmMapping.of(fore), FilmMapping.of(aft))
    film_paths = (fore_film_path, aft_film_path)
    film_grids = [rasters.info(path).grid for path in film_paths]
    pixel_mm = min(abs(grid.step_x) for grid in film_grids)

    if area_of_interest_path:
        lonlat = points_of_area(area_of_interest_path)
    else:
        lonlat = fore.locate_geodetic(films[0].lattice(61, 9), 0.0)[:, :2]
    terrain = terrain_over(lonlat, reference_dem_path, reference_dem_heights)
    low, high = height_range(*films, fore.origin.local_from_geodetic(terrain), terrain[:, 2], margin_m=height_margin_m)
    log.info("terrain and margin: %.0f to %.0f m above the ellipsoid", low, high)

    rectification = fit_rectification(
        virtual_conjugates(*films, np.linspace(low, high, LEVELS), even=bool(total_degree)),
        films,
        pixel_mm=pixel_mm,
        basis=Basis.of_film(across=degree_across, along=degree_along, total=total_degree),
        disparity_margin_px=disparity_margin_px,
    )
    log.info(
        "y-parallax left by the polynomials: %.4f px rms, %.4f px at most; inverse %.1e px",
        rectification.model_rms_px,
        rectification.model_largest_px,
        rectification.inverse_largest_px,
    )
    if area_of_interest_path:
        ground = np.concatenate([np.column_stack([lonlat, np.full(len(lonlat), h)]) for h in (low, high)])
        window = rectification.window_of(fore.project_geodetic(ground), halo_px=area_margin_px)
        rectification = rectification.cut(window, margin_px=disparity_margin_px)
    log.info("%d rows, %d columns; disparity %.0f to %.0f px", *rectification.shape, *rectification.disparity_range_px)

    if correction_spacing_px:
        found = measure_on_films(rectification, film_paths, film_grids, correction_spacing_px, y_parallax, threads)
        log.info("y-parallax taken out: %s", found.summary())
        rectification = fold_y_parallax(rectification, found, smoothing_nodes=y_parallax["smoothing_nodes"])
    records.write(rectification_path, rectification)


def measure_on_films(rectification, film_paths, film_grids, spacing_px, y_parallax, threads):
    """y-parallax at places of the pair, for which only the films' windows about them are resampled."""
    patches = [
        film_patches(lambda window, path=path: rasters.read(path, window=window), grid, epipolar_map)
        for path, grid, epipolar_map in zip(
            film_paths, film_grids, (rectification.fore, rectification.aft), strict=True
        )
    ]
    choices = {**y_parallax}
    choices.pop("spacing_px")
    nodes = node_grid(rectification.shape, spacing_px=spacing_px, fewest_nodes=choices.pop("fewest_nodes"))
    centres = nodes.centres()
    bounds = rectification.disparity_bounds(centres[..., 1], centres[..., 0])
    return measure_y_parallax(*patches, nodes, bounds, **choices, threads=threads)


def points_of_area(path):
    """Longitudes and latitudes inside and along the outline of the polygons of a file, (N, 2)."""
    area = vectors.read(path, GEODETIC).union_all()
    west, south, east, north = area.bounds
    lattice = np.stack(
        np.meshgrid(np.linspace(west, east, AREA_POINTS), np.linspace(south, north, AREA_POINTS)), axis=-1
    ).reshape(-1, 2)
    outline = get_coordinates(segmentize(area, max(east - west, north - south) / AREA_POINTS))
    return np.concatenate([lattice[contains_xy(area, lattice)], outline])


def terrain_over(lonlat, reference_dem_path, reference_dem_heights):
    """Longitude, latitude and ellipsoidal height (NaN where unknown) of the reference DEM about points, (N, 3)."""
    west, south = lonlat.min(axis=0) - 0.05
    east, north = lonlat.max(axis=0) + 0.05
    grid = PixelGrid.covering((west, south, east, north), TERRAIN_STEP_DEG)
    heights_m = ellipsoidal_heights(reference_dem_path, grid, GEODETIC, reference_dem_heights)
    return np.concatenate([grid.centres(), heights_m[..., None]], axis=-1).reshape(-1, 3).astype(float)


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        rectify(
            fore_camera_path=f"{snakemake.input.cameras}/{snakemake.params.fore}.json",
            aft_camera_path=f"{snakemake.input.cameras}/{snakemake.params.aft}.json",
            fore_film_path=snakemake.input.fore_film,
            aft_film_path=snakemake.input.aft_film,
            reference_dem_path=snakemake.input.reference_dem,
            area_of_interest_path=snakemake.input.area_of_interest,
            rectification_path=snakemake.output.rectification,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            degree_along=snakemake.params.degree_along,
            degree_across=snakemake.params.degree_across,
            total_degree=snakemake.params.total_degree,
            height_margin_m=snakemake.params.height_margin_m,
            disparity_margin_px=snakemake.params.disparity_margin_px,
            area_margin_px=snakemake.params.area_margin_px,
            correction_spacing_px=snakemake.params.correction_spacing_px,
            y_parallax=snakemake.params.y_parallax,
            threads=snakemake.threads,
        )
