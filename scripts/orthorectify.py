"""Bring a film onto the map: film, camera and heights in, orthophoto out."""

import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from cosp.camera.mapping import MapProjector
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.grids import PixelGrid
from cosp.imaging.resampling import block_mean
from cosp.imaging.windows import tiles, worked_on
from cosp.io import rasters, records
from cosp.io.heights import ellipsoidal_heights
from cosp.io.logs import log_to
from cosp.surface.orthophoto import (
    cells_below,
    direction_to_lens,
    fill_heights,
    film_about,
    film_of_cells,
    film_window,
    heights_on,
    hidden_from_lens,
    median_shift,
    nearest_on,
    reach_of_occlusion,
    sample_film,
)

COARSE = 8  # cells over which heights are averaged to be compared with the reference DEM
ROWS_AT_ONCE = 512  # of the DEM: a multiple of the above
TILE = 1024  # cells a side: larger ones read less of film and heights twice, and take more memory


def orthorectify(
    film_path,
    camera_path,
    dem_path,
    reference_dem_path,
    ortho_path,
    *,
    reference_dem_heights,
    resolution_m,
    tolerance_m,
    threads,
):
    log = logging.getLogger("orthorectify")
    camera = records.read(camera_path, PanoramicCamera)
    film_grid = rasters.info(film_path).grid
    dem = rasters.info(dem_path)
    grid, crs = dem.grid, dem.crs
    coarse = ellipsoidal_heights(reference_dem_path, grid.coarsened(COARSE), crs, reference_dem_heights)
    with ThreadPoolExecutor(threads) as pool:
        reduced_m, lowest_m, highest_m = look_through(dem_path, grid.shape, pool, ahead=threads)
    shift_m = median_shift(reduced_m, coarse)
    lowest_m = min(lowest_m, float(np.nanmin(coarse, initial=np.inf)) + shift_m)
    highest_m = max(highest_m, float(np.nanmax(coarse, initial=-np.inf)) + shift_m)

    def filled(window):
        """Heights of a window of the DEM, holes filled from the reference DEM."""
        heights_m = rasters.read(dem_path, window=window)
        if np.isfinite(heights_m).all():
            return heights_m
        part = grid.window(window.row0, window.row1, window.column0, window.column1)
        return fill_heights(
            heights_m, ellipsoidal_heights(reference_dem_path, part, crs, reference_dem_heights), shift_m
        )

    projector = MapProjector(camera, crs, grid.bounds)

    def film_of(xy, height):
        return projector.film(xy[..., 0], xy[..., 1], height)

    def locate(film_mm, height):
        return projector.map_frame.map_from_local(camera.locate(film_mm, height))[..., :2]

    ortho_grid = grid if resolution_m is None else PixelGrid.covering(grid.bounds, resolution_m)

    def expose(tile):
        part = ortho_grid.window(tile.row0, tile.row1, tile.column0, tile.column1)
        if film_window(film_grid, film_about(film_of, part, lowest_m, highest_m)) is None:
            return np.zeros(tile.shape, np.uint8)
        below = cells_below(grid, part)
        ground = grid.window(below.row0, below.row1, below.column0, below.column1)
        directions = direction_to_lens(locate, ground, film_of)
        around = below.grown(reach_of_occlusion(lowest_m, highest_m, *directions, grid), grid.shape)
        heights_m = filled(around)
        inside = below.inside(around)
        film_mm = film_of_cells(film_of, part, heights_on(heights_m[inside.slices], ground, part))
        window = film_window(film_grid, film_mm)
        if window is None:
            return np.zeros(tile.shape, np.uint8)
        hidden = hidden_from_lens(heights_m, inside, grid, *directions, tolerance_m=tolerance_m)
        film = rasters.read(film_path, window=window)
        film_part = film_grid.window(window.row0, window.row1, window.column0, window.column1)
        return sample_film(film, film_part, film_mm, nearest_on(hidden, ground, part))

    every = tiles(ortho_grid.shape, TILE)
    with (
        rasters.create(
            ortho_path,
            shape=ortho_grid.shape,
            dtype="uint8",
            grid=ortho_grid,
            crs=crs,
            nodata=0,
            cog=True,
            threads=threads,
        ) as ortho,
        ThreadPoolExecutor(threads) as pool,
    ):
        for number, (tile, grey) in enumerate(worked_on(pool, expose, every, ahead=2 * threads), 1):
            ortho.write(tile, grey)
            if number % 50 == 0 or number == len(every):
                log.info("exposed %d/%d tiles", number, len(every))


def look_through(dem_path, shape, pool, *, ahead):
    """Heights of a DEM averaged over `COARSE` cells a side, the lowest and the highest of all, read by strips."""

    def look_at(window):
        heights_m = rasters.read(dem_path, window=window)
        ends = (f.reduce(heights_m, axis=None) for f in (np.fmin, np.fmax))
        return block_mean(heights_m, COARSE), *ends

    strips = tiles(shape, (ROWS_AT_ONCE, shape[1]))
    reduced_m, lows, highs = zip(*(seen for _, seen in worked_on(pool, look_at, strips, ahead=ahead)), strict=True)
    return (
        np.concatenate(reduced_m),
        float(np.nanmin(lows, initial=np.inf)),
        float(np.nanmax(highs, initial=-np.inf)),
    )


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        orthorectify(
            film_path=snakemake.input.film,
            camera_path=f"{snakemake.input.cameras}/{snakemake.params.scene}.json",
            dem_path=snakemake.input.dem,
            reference_dem_path=snakemake.input.reference_dem,
            ortho_path=snakemake.output.ortho,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            resolution_m=snakemake.params.resolution_m,
            tolerance_m=snakemake.params.tolerance_m,
            threads=snakemake.threads,
        )
