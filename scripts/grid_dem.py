"""Grid the ground points of a pair: points in, heights and their standard deviations out."""

import logging
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np

from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from cosp.geometry.mapping import utm_crs
from cosp.imaging.windows import Window, tiles
from cosp.io import rasters, records
from cosp.io.logs import log_to
from cosp.surface.gridding import HALO_CELLS, boxes_meeting, grid_points, map_boxes

TILE_M = 5000.0  # ground of one job of a thread: about five million points of a 7 um film


def grid_dem(
    points_path,
    summary_path,
    dem_path,
    sigma_path,
    *,
    crs,
    resolution_m,
    kernel_cells,
    gate_sigmas,
    point_sigma_px,
    points_per_independent,
    threads,
):
    log = logging.getLogger("grid_dem")
    summary = records.read_json(summary_path)
    frame = records.from_plain(summary["origin"], LocalFrame, f"{summary_path}: origin")
    if crs == "auto":
        crs = utm_crs(frame.longitude_deg, frame.latitude_deg)
    windows = [Window(**block["window"]) for block in summary["blocks"]]
    low, high = (np.array([block[name] for block in summary["blocks"]]) for name in ("low_m", "high_m"))
    map_frame, boxes = map_boxes(frame, crs, low, high)
    grid = PixelGrid.covering((*boxes[:, :2].min(0), *boxes[:, 2:].max(0)), resolution_m)

    @lru_cache(maxsize=16)
    def map_points(number):
        local = np.moveaxis(rasters.read(points_path, band=None, window=windows[number])[:3], 0, -1)
        return map_frame.map_from_local(local[np.isfinite(local).all(-1)])

    def heights(tile):
        grown = Window(
            tile.row0 - HALO_CELLS, tile.row1 + HALO_CELLS, tile.column0 - HALO_CELLS, tile.column1 + HALO_CELLS
        )
        part = grid.window(grown.row0, grown.row1, grown.column0, grown.column1)
        chosen = boxes_meeting(boxes, part.bounds)
        points = np.concatenate([np.empty((0, 3)), *(map_points(number) for number in chosen)])
        found = grid_points(
            points,
            part,
            kernel_cells=kernel_cells,
            gate_sigmas=gate_sigmas,
            point_sigma_m=point_sigma_px * summary["height_per_px_m"],
            points_per_independent=points_per_independent,
        )
        inner = tile.inside(grown).slices
        return found.height_m[inner], found.sigma_m[inner], found.count[inner]

    cells = int(np.clip(TILE_M / resolution_m, 64, 512))
    every = tiles(grid.shape, cells)
    # Along the shorter side first: neighbours in the order share windows of the points.
    if grid.shape[1] > grid.shape[0]:
        every.sort(key=lambda tile: (tile.column0, tile.row0))
    tags = {"heights": "ellipsoidal (WGS 84)", "unit": "metre"}
    options = {"shape": grid.shape, "dtype": "float32", "grid": grid, "crs": crs, "tags": tags, "cog": True}
    filled = 0
    with (
        rasters.create(dem_path, descriptions=["height_m"], **options) as dem,
        rasters.create(sigma_path, count=2, descriptions=["sigma_m", "points"], **options) as sigma,
        ThreadPoolExecutor(threads) as pool,
    ):
        for start in range(0, len(every), threads):
            batch = every[start : start + threads]
            for tile, (height_m, sigma_m, count) in zip(batch, pool.map(heights, batch), strict=True):
                dem.write(tile, height_m)
                sigma.write(tile, sigma_m, 1)
                sigma.write(tile, count.astype(np.float32), 2)
                filled += int(np.isfinite(height_m).sum())
            log.info("gridded %d/%d tiles, %d cells filled", min(start + threads, len(every)), len(every), filled)


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        grid_dem(
            points_path=snakemake.input.points,
            summary_path=snakemake.input.summary,
            dem_path=snakemake.output.dem,
            sigma_path=snakemake.output.sigma,
            crs=snakemake.params.crs,
            resolution_m=snakemake.params.resolution_m,
            kernel_cells=snakemake.params.kernel_cells,
            gate_sigmas=snakemake.params.gate_sigmas,
            point_sigma_px=snakemake.params.point_sigma_px,
            points_per_independent=snakemake.params.points_per_independent,
            threads=snakemake.threads,
        )
