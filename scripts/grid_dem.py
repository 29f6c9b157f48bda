"""Grid the ground points of a pair: points in, heights and their standard deviations out."""

import logging
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np

from cosp.adjustment.posterior import HeightSigma
from cosp.camera.mapping import MapProjector
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from cosp.geometry.mapping import utm_crs
from cosp.imaging.windows import Window, tiles
from cosp.io import rasters, records
from cosp.io.logs import log_to
from cosp.surface.gridding import HALO_CELLS, boxes_meeting, grid_points, map_boxes

CONFIDENCE_BAND = 2  # of validity.tif
MOST_CONFIDENCE = 255
TILE_M = 5000.0  # ground of one job of a thread: about five million points of a 7 um film


def grid_dem(
    points_path,
    validity_path,
    summary_path,
    dem_path,
    sigma_path,
    *,
    crs,
    resolution_m,
    kernel_cells,
    gate_sigmas,
    least_confidence,
    point_sigma_px,
    points_per_independent,
    threads,
    camera_path=None,
    height_sigma_path=None,
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
    of_cameras = None
    if height_sigma_path is not None:
        projector = MapProjector(records.read(camera_path, PanoramicCamera), crs, grid.bounds)
        of_cameras = records.read(height_sigma_path, HeightSigma)

    @lru_cache(maxsize=16)
    def map_points(number):
        """Points of a window on the map, and their weights: the noise of matching falls as confidence rises."""
        window = windows[number]
        bands = rasters.read(points_path, band=None, window=window)
        confidence = rasters.read(validity_path, band=CONFIDENCE_BAND, window=window)
        good = np.isfinite(bands[2]) & (confidence >= least_confidence)
        local = np.stack([band[good] for band in bands[:3]], axis=-1)
        return map_frame.map_from_local(local), (confidence[good] / np.float32(MOST_CONFIDENCE)) ** 2

    def heights(tile):
        grown = Window(
            tile.row0 - HALO_CELLS, tile.row1 + HALO_CELLS, tile.column0 - HALO_CELLS, tile.column1 + HALO_CELLS
        )
        part = grid.window(grown.row0, grown.row1, grown.column0, grown.column1)
        chosen = boxes_meeting(boxes, part.bounds)
        parts = [(np.empty((0, 3)), np.empty(0, np.float32)), *(map_points(number) for number in chosen)]
        points, weights = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        found = grid_points(
            points,
            part,
            weights=weights,
            kernel_cells=kernel_cells,
            gate_sigmas=gate_sigmas,
            point_sigma_m=point_sigma_px * summary["height_per_px_m"],
            points_per_independent=points_per_independent,
        )
        inner = tile.inside(grown).slices
        height_m, sigma_m, count = found.height_m[inner], found.sigma_m[inner], found.count[inner]
        camera_sigma_m = np.where(np.isfinite(height_m), np.float32(0), np.float32(np.nan))
        if of_cameras is not None:
            centres = grid.window(tile.row0, tile.row1, tile.column0, tile.column1).centres()
            camera_sigma_m = of_cameras.at(projector.film(centres[..., 0], centres[..., 1], height_m)).astype(
                np.float32
            )
        return height_m, np.hypot(sigma_m, camera_sigma_m), count, camera_sigma_m

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
        rasters.create(sigma_path, count=3, descriptions=["sigma_m", "points", "camera_sigma_m"], **options) as sigma,
        ThreadPoolExecutor(threads) as pool,
    ):
        for start in range(0, len(every), threads):
            batch = every[start : start + threads]
            for tile, (height_m, sigma_m, count, camera_sigma_m) in zip(batch, pool.map(heights, batch), strict=True):
                dem.write(tile, height_m)
                sigma.write(tile, sigma_m, 1)
                sigma.write(tile, count.astype(np.float32), 2)
                sigma.write(tile, camera_sigma_m, 3)
                filled += int(np.isfinite(height_m).sum())
            log.info("gridded %d/%d tiles, %d cells filled", min(start + threads, len(every)), len(every), filled)


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        grid_dem(
            points_path=snakemake.input.points,
            validity_path=snakemake.input.validity,
            summary_path=snakemake.input.summary,
            dem_path=snakemake.output.dem,
            sigma_path=snakemake.output.sigma,
            crs=snakemake.params.crs,
            resolution_m=snakemake.params.resolution_m,
            kernel_cells=snakemake.params.kernel_cells,
            gate_sigmas=snakemake.params.gate_sigmas,
            least_confidence=snakemake.params.least_confidence,
            point_sigma_px=snakemake.params.point_sigma_px,
            points_per_independent=snakemake.params.points_per_independent,
            threads=snakemake.threads,
            camera_path=f"{snakemake.input.cameras}/{snakemake.params.fore}.json",
            height_sigma_path=f"{snakemake.input.height_sigma}/{snakemake.params.pair}.json",
        )
