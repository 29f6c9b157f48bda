"""Intersect the conjugate rays of a pair: disparity in, ground points out."""

import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from cosp.camera.panoramic import PanoramicCamera
from cosp.epipolar.rectification import Rectification
from cosp.errors import NoOverlapError
from cosp.geometry.statistics import summarise
from cosp.imaging.windows import tiles
from cosp.io import rasters, records
from cosp.io.logs import log_to
from cosp.surface.intersection import height_per_pixel, intersect_tabulated, miss_limit, pixel_on_ground, tabulate_rays
from cosp.surface.nodes import between_nodes

WINDOW = (512, 2048)
SMOOTH_BAND = 2  # of y_parallax.tif: the field that dense matching allowed for


def triangulate(
    disparity_path,
    y_parallax_path,
    rectification_path,
    fore_camera_path,
    aft_camera_path,
    points_path,
    summary_path,
    *,
    ray_places,
    gate_sigmas,
    gate_px,
    threads,
):
    log = logging.getLogger("triangulate")
    rectification = records.read(rectification_path, Rectification)
    fore = records.read(fore_camera_path, PanoramicCamera)
    aft = records.read(aft_camera_path, PanoramicCamera).moved_to(fore.origin)
    tables = [
        tabulate_rays(
            camera.rays,
            half_length_mm=camera.half_length_mm * 1.05,
            half_width_mm=camera.half_width_mm,
            places=ray_places,
        )
        for camera in (fore, aft)
    ]
    disparity_info = rasters.info(disparity_path)
    y_parallax = np.nan_to_num(rasters.read(y_parallax_path, band=SMOOTH_BAND))
    y_parallax_grid = rasters.info(y_parallax_path).grid

    def bounds(window):
        """Disparities of the lowest and the highest ground expected, from nodes between which they hardly curve."""
        nodes = [
            np.linspace(a, b - 1, n)
            for (a, b, n) in ((window.row0, window.row1, 9), (window.column0, window.column1, 17))
        ]
        at = [np.linspace(0, len(n) - 1, size) for n, size in zip(nodes, window.shape, strict=True)]
        ends = rectification.disparity_bounds(nodes[0][:, None], nodes[1][None, :])
        return [between_nodes(end, *at) for end in ends]

    def intersect(window, more_px=0.0):
        rows, columns = np.arange(window.row0, window.row1), np.arange(window.column0, window.column1)
        disparity = rasters.read(disparity_path, window=window)
        low, high = bounds(window)
        disparity[(disparity < low) | (disparity > high)] = np.nan
        disparity += more_px
        x, y = disparity_info.grid.points(0, columns)[:, 0], disparity_info.grid.points(rows, 0)[:, 1]
        smooth = between_nodes(
            y_parallax,
            (y - y_parallax_grid.y0) / y_parallax_grid.step_y,
            (x - y_parallax_grid.x0) / y_parallax_grid.step_x,
        )
        fore_mm, aft_mm = rectification.conjugate_points(rows[:, None], columns[None, :], disparity, smooth)
        return intersect_tabulated(*tables, fore_mm, aft_mm)

    windows = tiles(disparity_info.shape, WINDOW)
    sampled = windows[:: max(1, len(windows) // 24)]
    first = [thinned(intersect(window)) for window in sampled]
    range_m = np.concatenate([np.linalg.norm(ground - fore.position_m, axis=-1).ravel() for ground, _ in first])
    ground_px_m = pixel_on_ground(range_m, fore.focal_length_mm, rectification.pixel_mm)
    limit_m = miss_limit(
        np.concatenate([miss.ravel() for _, miss in first]), gate_sigmas=gate_sigmas, least_m=gate_px * ground_px_m
    )
    height_per_px_m = height_per_pixel(
        [ground for ground, _ in first], [thinned(intersect(window, more_px=1.0))[0] for window in sampled]
    )
    if not np.isfinite(height_per_px_m):
        raise NoOverlapError(f"{disparity_path}: no disparity leads to a ground point; match_dense found nothing")
    log.info("rays may miss by %.2f m; one pixel of parallax is worth %.2f m of height", limit_m, height_per_px_m)

    blocks, kept, found, misses = [], 0, 0, []
    with (
        rasters.create(
            points_path,
            shape=disparity_info.shape,
            dtype="float32",
            grid=disparity_info.grid,
            crs=disparity_info.crs,
            count=4,
            descriptions=("X_m", "Y_m", "Z_m", "miss_m"),
        ) as points,
        ThreadPoolExecutor(threads) as pool,
    ):
        for start in range(0, len(windows), threads):
            batch = windows[start : start + threads]
            for window, (ground, miss_m) in zip(batch, pool.map(intersect, batch), strict=True):
                with np.errstate(invalid="ignore"):
                    good = miss_m <= limit_m
                found += int(np.isfinite(miss_m).sum())
                kept += int(good.sum())
                ground[~good] = np.nan
                for band in range(3):
                    points.write(window, ground[..., band].astype(np.float32), band + 1)
                points.write(window, miss_m.astype(np.float32), 4)
                misses.append(miss_m[good][::64])
                if good.any():
                    low, high = ground[good].min(0), ground[good].max(0)
                    blocks.append({"window": window, "low_m": low, "high_m": high})
            log.info("intersected %d/%d windows", min(start + threads, len(windows)), len(windows))

    records.write(
        summary_path,
        {
            "kind": "points",
            "version": 1,
            "count": kept,
            "rejected": found - kept,
            "miss_m": summarise(np.concatenate(misses)),
            "miss_limit_m": limit_m,
            "ground_px_m": ground_px_m,
            "height_per_px_m": height_per_px_m,
            "origin": fore.origin,
            "blocks": blocks,
        },
    )


def thinned(arrays):
    """Every eighth row and column of arrays, for statistics."""
    return [array[::8, ::8].copy() for array in arrays]


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        triangulate(
            disparity_path=snakemake.input.disparity,
            y_parallax_path=snakemake.input.y_parallax,
            rectification_path=snakemake.input.rectification,
            fore_camera_path=f"{snakemake.input.cameras}/{snakemake.params.fore}.json",
            aft_camera_path=f"{snakemake.input.cameras}/{snakemake.params.aft}.json",
            points_path=snakemake.output.points,
            summary_path=snakemake.output.summary,
            ray_places=snakemake.params.ray_places,
            gate_sigmas=snakemake.params.gate_sigmas,
            gate_px=snakemake.params.gate_px,
            threads=snakemake.threads,
        )
