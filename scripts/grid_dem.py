"""Grid the ground points of a pair: points in, heights and their standard deviations out."""

import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from cosp.adjustment.posterior import HeightSigma
from cosp.camera.mapping import MapProjector
from cosp.camera.panoramic import PanoramicCamera
from cosp.epipolar.rectification import Rectification
from cosp.geometry.frames import LocalFrame
from cosp.geometry.grids import PixelGrid
from cosp.geometry.mapping import utm_crs
from cosp.imaging.windows import Window, tiles, worked_on
from cosp.io import rasters, records
from cosp.io.logs import log_to
from cosp.surface.gridding import HALO_CELLS, CellPoints, boxes_meeting, confidence_weights, grid_cells, map_boxes
from cosp.surface.intersection import PixelIntersection
from cosp.surface.orthophoto import on_surface

CONFIDENCE_BAND = 2  # of validity.tif
SMOOTH_BAND = 2  # of y_parallax.tif: the field that dense matching allowed for
TILE_M = 5120.0  # ground of one job of a thread: about five million points of a 7 um film
WINDOWS_AT_HAND = 40  # whose points are kept for the tiles to come: up to 17 MB each


def grid_dem(
    disparity_path,
    validity_path,
    y_parallax_path,
    rectification_path,
    fore_camera_path,
    aft_camera_path,
    summary_path,
    dem_path,
    sigma_path,
    *,
    crs,
    resolution_m,
    ray_spacing_mm,
    ray_error_px,
    kernel_cells,
    gate_sigmas,
    least_confidence,
    point_sigma_px,
    points_per_independent,
    threads,
    height_sigma_path=None,
):
    log = logging.getLogger("grid_dem")
    rectification = records.read(rectification_path, Rectification)
    fore = records.read(fore_camera_path, PanoramicCamera)
    pixels = PixelIntersection.of_films(
        rectification,
        fore,
        records.read(aft_camera_path, PanoramicCamera),
        rasters.read(y_parallax_path, band=SMOOTH_BAND),
        rasters.info(y_parallax_path).grid,
        ray_spacing_mm=ray_spacing_mm,
        ray_error_px=ray_error_px,
    )
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
        projector = MapProjector(fore, crs, grid.bounds)
        of_cameras = records.read(height_sigma_path, HeightSigma)

    def sigma_of_cameras(xy, height_m):
        return of_cameras.at(projector.film(xy[..., 0], xy[..., 1], height_m))[..., None]

    weights = confidence_weights(least_confidence)

    def map_points(number):
        """Points of a window in cells of the grid."""
        window = windows[number]
        row, column = (int(place) for place in grid.pixels((boxes[number, 0], boxes[number, 3])))
        values = pixels.cell_points(
            window,
            rasters.read(disparity_path, window=window),
            rasters.read(validity_path, band=CONFIDENCE_BAND, window=window),
            weights=weights,
            largest_miss_m=summary["miss_limit_m"],
            map_frame=map_frame,
            grid=grid,
            first_cell=(row, column),
        )
        return CellPoints(values, row, column)

    def with_halo(tile):
        """A tile with what gridding needs around it, and its grid."""
        grown = Window(
            tile.row0 - HALO_CELLS, tile.row1 + HALO_CELLS, tile.column0 - HALO_CELLS, tile.column1 + HALO_CELLS
        )
        return grown, grid.window(grown.row0, grown.row1, grown.column0, grown.column1)

    def heights(work):
        tile, grown, pieces = work
        found = grid_cells(
            [piece.result() for piece in pieces],
            grown,
            kernel_cells=kernel_cells,
            gate_sigmas=gate_sigmas,
            point_sigma_m=point_sigma_px * summary["height_per_px_m"],
            points_per_independent=points_per_independent,
        )
        inner = tile.inside(grown).slices
        height_m, sigma_m, count = found.height_m[inner], found.sigma_m[inner], found.count[inner]
        camera_sigma_m = np.where(np.isfinite(height_m), np.float32(0), np.float32(np.nan))
        if of_cameras is not None and np.isfinite(height_m).any():
            cells = grid.window(tile.row0, tile.row1, tile.column0, tile.column1)
            camera_sigma_m = on_surface(sigma_of_cameras, cells, height_m)[0]
        return height_m, np.hypot(sigma_m, camera_sigma_m), count, camera_sigma_m

    every = tiles(grid.shape, int(np.clip(TILE_M / resolution_m, 64, 512)))
    # Along the shorter side first: neighbours in the order share windows of the points.
    if grid.shape[1] > grid.shape[0]:
        every.sort(key=lambda tile: (tile.column0, tile.row0))
    tags = {"heights": "ellipsoidal (WGS 84)", "unit": "metre"}
    options = {"shape": grid.shape, "dtype": "float32", "grid": grid, "crs": crs, "tags": tags, "cog": True}
    options["threads"] = threads
    at_hand = {}  # points of windows, there or to come, that tiles in work need and the next ones may
    filled = 0
    with (
        rasters.create(dem_path, descriptions=["height_m"], **options) as dem,
        rasters.create(sigma_path, count=3, descriptions=["sigma_m", "points", "camera_sigma_m"], **options) as sigma,
        ThreadPoolExecutor(threads) as pool,
    ):

        def prepared():
            """Tiles one by one, each with its halo and the points it is made of, which are on their way."""
            for tile in every:
                grown, part = with_halo(tile)
                meeting = boxes_meeting(boxes, part.bounds)
                idle = [number for number in at_hand if number not in meeting]
                for number in idle[: max(len(idle) + len(meeting) - WINDOWS_AT_HAND, 0)]:
                    del at_hand[number]
                for number in meeting:
                    if number not in at_hand:
                        at_hand[number] = pool.submit(map_points, number)
                yield tile, grown, [at_hand[number] for number in meeting]

        # Work begins in the order in which it was given, so tiles never wait for points that wait for a thread.
        for number, ((tile, _, _), (height_m, sigma_m, count, camera_sigma_m)) in enumerate(
            worked_on(pool, heights, prepared(), ahead=2 * threads), 1
        ):
            dem.write(tile, height_m)
            sigma.write(tile, sigma_m, 1)
            sigma.write(tile, count.astype(np.float32), 2)
            sigma.write(tile, camera_sigma_m, 3)
            filled += int(np.isfinite(height_m).sum())
            if number % 50 == 0 or number == len(every):
                log.info("gridded %d/%d tiles, %d cells filled", number, len(every), filled)


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        grid_dem(
            disparity_path=snakemake.input.disparity,
            validity_path=snakemake.input.validity,
            y_parallax_path=snakemake.input.y_parallax,
            rectification_path=snakemake.input.rectification,
            fore_camera_path=f"{snakemake.input.cameras}/{snakemake.params.fore}.json",
            aft_camera_path=f"{snakemake.input.cameras}/{snakemake.params.aft}.json",
            summary_path=snakemake.input.summary,
            dem_path=snakemake.output.dem,
            sigma_path=snakemake.output.sigma,
            crs=snakemake.params.crs,
            resolution_m=snakemake.params.resolution_m,
            ray_spacing_mm=snakemake.params.ray_spacing_mm,
            ray_error_px=snakemake.params.ray_error_px,
            kernel_cells=snakemake.params.kernel_cells,
            gate_sigmas=snakemake.params.gate_sigmas,
            least_confidence=snakemake.params.least_confidence,
            point_sigma_px=snakemake.params.point_sigma_px,
            points_per_independent=snakemake.params.points_per_independent,
            threads=snakemake.threads,
            height_sigma_path=f"{snakemake.input.height_sigma}/{snakemake.params.pair}.json",
        )
