"""Resample the two films of a pair to their common epipolar grid."""

import logging
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from cosp.epipolar.rectification import Rectification
from cosp.epipolar.resampling import resample_window
from cosp.imaging.windows import tiles, worked_on
from cosp.io import rasters, records
from cosp.io.logs import log_to

TILE = 2048


def resample_epipolar(
    fore_film_path,
    aft_film_path,
    rectification_path,
    fore_path,
    aft_path,
    *,
    interpolation,
    threads,
):
    rectification = records.read(rectification_path, Rectification)
    fore_grid = rasters.info(fore_film_path).grid
    aft_grid = rasters.info(aft_film_path).grid
    resample(fore_film_path, fore_grid, rectification.fore, rectification.grid, fore_path, interpolation, threads)
    resample(aft_film_path, aft_grid, rectification.aft, rectification.grid, aft_path, interpolation, threads)


def resample(film_path, film_grid, epipolar_map, grid, path, interpolation, threads):
    """Write one rectified image, tile by tile."""
    log = logging.getLogger("resample_epipolar")
    windows = tiles(grid.shape, TILE)
    one = partial(
        resample_window,
        lambda window: rasters.read(film_path, window=window),
        film_grid,
        epipolar_map,
        interpolation=interpolation,
    )
    with (
        rasters.create(
            path,
            shape=grid.shape,
            dtype="uint8",
            grid=grid,
            crs=rasters.PIXEL_CRS,
            nodata=0,
            descriptions=("grey",),
            threads=threads,
        ) as writer,
        ThreadPoolExecutor(threads) as pool,
    ):
        for number, (window, grey) in enumerate(worked_on(pool, one, windows, ahead=4 * threads), 1):
            writer.write(window, grey)
            if number % 50 == 0 or number == len(windows):
                log.info("%s: %d/%d tiles", path, number, len(windows))


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        resample_epipolar(
            fore_film_path=snakemake.input.fore_film,
            aft_film_path=snakemake.input.aft_film,
            rectification_path=snakemake.input.rectification,
            fore_path=snakemake.output.fore,
            aft_path=snakemake.output.aft,
            interpolation=snakemake.params.interpolation,
            threads=snakemake.threads,
        )
