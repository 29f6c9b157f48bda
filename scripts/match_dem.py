"""Lay a draft elevation model of a pair, made of reduced films, against the reference DEM: control for both films."""

import logging

import numpy as np
import pandas as pd

from cosp.camera.panoramic import PanoramicCamera
from cosp.dem.displacement import displacements, verdicts
from cosp.dense.coarse_to_fine import match
from cosp.dense.resampling import SmoothField, fill_holes
from cosp.epipolar.correspondences import FilmMapping, height_range, virtual_conjugates
from cosp.epipolar.parallax import measure_y_parallax, node_grid
from cosp.epipolar.patches import image_patches
from cosp.epipolar.polynomials import Basis
from cosp.epipolar.rectification import fit_rectification
from cosp.epipolar.resampling import resample_window
from cosp.errors import NoOverlapError, NotEnoughMatchesError
from cosp.geometry.grids import PixelGrid
from cosp.geometry.mapping import MapFrame
from cosp.geometry.statistics import summarise
from cosp.imaging.windows import Window, tiles
from cosp.io import rasters, records, references, tables, vectors
from cosp.io.logs import log_to
from cosp.matching.dem_control import control_of_displacements
from cosp.matching.film_image import FilmImage
from cosp.matching.ground import Terrain, grown, map_bounds, map_crs
from cosp.report.displacement import draw_displacements
from cosp.report.figures import save
from cosp.surface.gridding import CellPoints, confidence_weights, grid_cells
from cosp.surface.intersection import PixelIntersection, height_per_pixel, miss_limit, pixel_on_ground

log = logging.getLogger("match_dem")

TERRAIN_POSTING_M = 300.0  # fine enough for the range of heights
LEVELS = 4  # heights at which rays are cut
TILE = 1024  # of a rectified image
ROWS_AT_ONCE = 512  # of it, that are intersected
PIXELS_A_CELL = 2.0  # of the draft model: neighbouring pixels tell the same
MATCHING = (
    *("small_step", "large_step", "least_texture_sd", "saturated_from", "least_correlation", "least_uniqueness"),
    *("largest_speckle_px", "speckle_step_px"),
)  # choices of dense matching
SAMPLED_EVERY = 4  # rows and columns, for the statistics of the rays


def match_dem(
    film_paths,
    camera_paths,
    reference_dem_path,
    unstable_path,
    gcps_path,
    summary_path,
    figure_path,
    *,
    pair,
    reference_dem_heights,
    pixel_mm,
    tile_km,
    least_share,
    max_slope_deg,
    max_shift_m,
    reference_sigma_m,
    rectify,
    y_parallax,
    dense,
    triangulate,
    grid_dem,
    threads,
):
    cameras = [records.read(path, PanoramicCamera) for path in camera_paths]
    cameras[1] = cameras[1].moved_to(cameras[0].origin)
    infos = [rasters.info(path) for path in film_paths]
    films = [
        FilmImage(info.grid, lambda window, path=path: rasters.read(path, window=window)).reduced(
            max(1, round(pixel_mm / abs(info.grid.step_x)))
        )
        for info, path in zip(infos, film_paths, strict=True)
    ]
    crs = map_crs(cameras[0])
    heights_on = references.heights_on(reference_dem_path, crs, reference_dem_heights)
    dem_posting_m = references.posting_m(reference_dem_path)

    found, reason = [], None
    try:
        grid, draft_m = draft_model(
            films, cameras, heights_on, crs, dem_posting_m, rectify, y_parallax, dense, triangulate, grid_dem, threads
        )
    except (NoOverlapError, NotEnoughMatchesError) as error:
        reason = str(error)
        log.warning("%s: %s; no control from elevation models", pair, reason)
        grid = PixelGrid(0.0, 0.0, 1.0, -1.0, (1, 1))
        difference_m = np.full(grid.shape, np.nan, np.float32)
    else:
        reference_m = heights_on(grid)
        unstable = vectors.rasterise(unstable_path, grid, crs) if unstable_path else np.zeros(grid.shape, bool)
        difference_m = np.where(unstable, np.float32(np.nan), draft_m - reference_m)
        found = displacements(
            draft_m,
            reference_m,
            ~unstable,
            grid,
            tile_m=1000.0 * tile_km,
            least_share=least_share,
            max_slope_deg=max_slope_deg,
            largest_shift_m=max_shift_m,
            reference_sigma_m=reference_sigma_m,
            threads=threads,
        )
    kept = [one for one in found if one.verdict == "kept"]
    gcps = [
        control_of_displacements(
            camera,
            np.array([one.place_m for one in kept]),
            np.array([one.shift_m for one in kept]),
            np.array([one.covariance_m2 for one in kept]),
            crs=crs,
            pixel_mm=abs(info.grid.step_x),
        ).assign(scene=camera.scene)
        for camera, info in zip(cameras, infos, strict=True)
    ]
    tables.write(gcps_path, pd.concat(gcps, ignore_index=True))
    log.info("%s: %s of %d tiles", pair, verdicts(found), len(found))
    save(draw_displacements(difference_m, grid, found, title=f"{pair}: draft model less reference"), figure_path)
    records.write(
        summary_path,
        {
            "kind": "dem_control",
            "version": 1,
            "reason": reason,
            "crs": crs,
            "posting_m": abs(grid.step_x),
            "tiles": verdicts(found),
            "control": {camera.scene: len(table) for camera, table in zip(cameras, gcps, strict=True)},
            "difference_m": summarise(difference_m),
            "displacements": found,
        },
    )


def draft_model(
    films, cameras, heights_on, crs, dem_posting_m, rectify, y_parallax, dense, triangulate, grid_dem, threads
):
    """Grid and heights of an elevation model of two films: all the steps of the workflow in small."""
    fore, aft = cameras
    mappings = tuple(FilmMapping.of(camera) for camera in cameras)
    bounds = map_bounds(fore, crs)
    terrain = Terrain.on(heights_on, grown(bounds, 2000.0), crs, TERRAIN_POSTING_M)
    map_frame = MapFrame(fore.origin, crs, terrain.grid.bounds)
    points = (
        np.concatenate([terrain.grid.centres(), terrain.heights_m[..., None]], axis=-1).reshape(-1, 3).astype(float)
    )
    low, high = height_range(
        *mappings, map_frame.local_from_map(points), points[:, 2], margin_m=rectify["height_margin_m"]
    )
    total = rectify["total_degree"]
    rectification = fit_rectification(
        virtual_conjugates(*mappings, np.linspace(low, high, LEVELS), even=bool(total)),
        mappings,
        pixel_mm=min(film.pixel_mm for film in films),
        basis=Basis.of_film(across=rectify["degree_across"], along=rectify["degree_along"], total=total),
        disparity_margin_px=rectify["disparity_margin_px"],
    )
    pictures = []
    for film, epipolar_map in zip(films, (rectification.fore, rectification.aft), strict=True):
        picture = np.zeros(rectification.shape, np.uint8)
        for window in tiles(rectification.shape, TILE):
            picture[window.slices] = resample_window(film.read, film.grid, epipolar_map, window, interpolation="cubic")
        pictures.append(picture)
    nodes = node_grid(rectification.shape, spacing_px=y_parallax["spacing_px"], fewest_nodes=y_parallax["fewest_nodes"])
    centres = nodes.centres()
    parallax = measure_y_parallax(
        *(image_patches(lambda window, picture=picture: picture[window.slices], picture.shape) for picture in pictures),
        nodes,
        rectification.disparity_bounds(centres[..., 1], centres[..., 0]),
        **{name: value for name, value in y_parallax.items() if name not in ("spacing_px", "fewest_nodes")},
        threads=threads,
    )
    matched = match(
        *pictures,
        rectification.disparity_range_px,
        y_parallax=SmoothField(
            fill_holes(parallax.smooth_px.astype(np.float32)), nodes.y0, nodes.x0, nodes.step_y, nodes.step_x
        ),
        **{name: dense[name] for name in MATCHING},
        threads=threads,
    )
    del pictures
    pixels = PixelIntersection.of_films(
        rectification,
        fore,
        aft,
        parallax.smooth_px,
        nodes,
        ray_spacing_mm=triangulate["ray_spacing_mm"],
        ray_error_px=triangulate["ray_error_px"],
    )
    whole = Window(0, matched.disparity.shape[0], 0, matched.disparity.shape[1])
    thin = matched.disparity[::SAMPLED_EVERY, ::SAMPLED_EVERY]
    sampled, misses = pixels.ground(whole, thin, every=SAMPLED_EVERY)
    more, _ = pixels.ground(whole, thin + np.float32(1.0), every=SAMPLED_EVERY)
    ground_px_m = pixel_on_ground(
        np.linalg.norm(sampled - fore.position_m, axis=-1), fore.focal_length_mm, rectification.pixel_mm
    )
    limit_m = miss_limit(misses, gate_sigmas=triangulate["gate_sigmas"], least_m=triangulate["gate_px"] * ground_px_m)
    if not np.isfinite(sampled).any():
        raise NotEnoughMatchesError("dense matching of the reduced films found nothing")

    weights = confidence_weights(grid_dem["least_confidence"])
    posting_m = max(dem_posting_m, PIXELS_A_CELL * ground_px_m)
    spread = map_frame.map_from_local(sampled[np.isfinite(sampled).all(axis=-1)])
    grid = PixelGrid.covering((*spread[:, :2].min(axis=0), *spread[:, :2].max(axis=0)), posting_m)
    pieces = []
    for row in range(0, whole.row1, ROWS_AT_ONCE):
        window = Window(row, min(row + ROWS_AT_ONCE, whole.row1), 0, whole.column1)
        values = pixels.cell_points(
            window,
            matched.disparity[window.slices],
            matched.confidence[window.slices],
            weights=weights,
            largest_miss_m=limit_m,
            map_frame=map_frame,
            grid=grid,
            first_cell=(0, 0),
        )
        pieces.append(CellPoints(values, 0, 0))
    heights = grid_cells(
        pieces,
        Window(0, grid.shape[0], 0, grid.shape[1]),
        kernel_cells=grid_dem["kernel_cells"],
        gate_sigmas=grid_dem["gate_sigmas"],
        point_sigma_m=grid_dem["point_sigma_px"] * height_per_pixel([sampled], [more]),
        points_per_independent=grid_dem["points_per_independent"],
    )
    return grid, heights.height_m


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        match_dem(
            film_paths=[snakemake.input.fore_film, snakemake.input.aft_film],
            camera_paths=[
                f"{snakemake.input.cameras}/{scene}.json" for scene in (snakemake.params.fore, snakemake.params.aft)
            ],
            reference_dem_path=snakemake.input.reference_dem,
            unstable_path=snakemake.input.get("unstable_terrain"),
            gcps_path=snakemake.output.gcps,
            summary_path=snakemake.output.summary,
            figure_path=snakemake.output.figure,
            pair=snakemake.wildcards.pair,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            pixel_mm=snakemake.params.pixel_mm,
            tile_km=snakemake.params.tile_km,
            least_share=snakemake.params.least_share,
            max_slope_deg=snakemake.params.max_slope_deg,
            max_shift_m=snakemake.params.max_shift_m,
            reference_sigma_m=snakemake.params.reference_sigma_m,
            rectify=snakemake.params.rectify,
            y_parallax=snakemake.params.y_parallax,
            dense=snakemake.params.dense,
            triangulate=snakemake.params.triangulate,
            grid_dem=snakemake.params.grid_dem,
            threads=snakemake.threads,
        )
