"""How far the conjugate rays of a pair miss each other, and where its ground lies, from every so-manyth pixel.

`grid_dem` intersects all of them.
"""

import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from cosp.camera.panoramic import PanoramicCamera
from cosp.epipolar.rectification import Rectification
from cosp.errors import NoOverlapError
from cosp.geometry.statistics import summarise
from cosp.imaging.windows import Window, tiles
from cosp.io import rasters, records
from cosp.io.logs import log_to
from cosp.surface.intersection import PixelIntersection, height_per_pixel, miss_limit, pixel_on_ground

WINDOW = (512, 2048)
SMOOTH_BAND = 2  # of y_parallax.tif: the field that dense matching allowed for
SAMPLED_EVERY = 4  # pixels from one that is intersected to the next, along rows and columns
GAP_STEP = 16  # pixels from one that ray_gap.tif shows to the next: a multiple of the other, divides the windows' sides
MARGIN_PX = 16  # by which ground may lie outside the box of a window's sampled points


def triangulate(
    disparity_path,
    y_parallax_path,
    rectification_path,
    fore_camera_path,
    aft_camera_path,
    gap_path,
    summary_path,
    *,
    ray_spacing_mm,
    ray_error_px,
    gate_sigmas,
    gate_px,
    threads,
):
    log = logging.getLogger("triangulate")
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
    disparity_info = rasters.info(disparity_path)

    def intersect(window, more_px=0.0):
        disparity = rasters.read(disparity_path, window=window)[::SAMPLED_EVERY, ::SAMPLED_EVERY]
        return pixels.ground(window, disparity + np.float32(more_px), every=SAMPLED_EVERY)

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

    def described(window):
        """Gaps of a window as ray_gap.tif shows them, how many points there are, how many to keep, their box."""
        ground, miss_m = intersect(window)
        with np.errstate(invalid="ignore"):
            good = miss_m <= limit_m
        box = None
        if good.any():
            points = ground[good]
            margin_m = MARGIN_PX * ground_px_m
            box = {"window": window, "low_m": points.min(0) - margin_m, "high_m": points.max(0) + margin_m}
        shown = GAP_STEP // SAMPLED_EVERY
        return miss_m[::shown, ::shown], int(np.isfinite(miss_m).sum()), int(good.sum()), box

    blocks, kept, found, misses = [], 0, 0, []
    shape = tuple(-(-n // GAP_STEP) for n in disparity_info.shape)
    with (
        rasters.create(
            gap_path,
            shape=shape,
            dtype="float32",
            grid=disparity_info.grid.coarsened(GAP_STEP),
            crs=disparity_info.crs,
            descriptions=["miss_m"],
        ) as gaps,
        ThreadPoolExecutor(threads) as pool,
    ):
        for number, (window, (miss_m, some, good, box)) in enumerate(
            zip(windows, pool.map(described, windows), strict=True), 1
        ):
            row, column = window.row0 // GAP_STEP, window.column0 // GAP_STEP
            gaps.write(Window(row, row + miss_m.shape[0], column, column + miss_m.shape[1]), miss_m)
            misses.append(miss_m[miss_m <= limit_m])
            found += some
            kept += good
            if box:
                blocks.append(box)
            if number % 50 == 0 or number == len(windows):
                log.info("intersected %d/%d windows", number, len(windows))

    records.write(
        summary_path,
        {
            "kind": "points",
            "version": 3,
            "sampled_every_px": SAMPLED_EVERY,
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
    """Every other row and column of arrays, for statistics."""
    return [array[::2, ::2].copy() for array in arrays]


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        triangulate(
            disparity_path=snakemake.input.disparity,
            y_parallax_path=snakemake.input.y_parallax,
            rectification_path=snakemake.input.rectification,
            fore_camera_path=f"{snakemake.input.cameras}/{snakemake.params.fore}.json",
            aft_camera_path=f"{snakemake.input.cameras}/{snakemake.params.aft}.json",
            gap_path=snakemake.output.ray_gap,
            summary_path=snakemake.output.summary,
            ray_spacing_mm=snakemake.params.ray_spacing_mm,
            ray_error_px=snakemake.params.ray_error_px,
            gate_sigmas=snakemake.params.gate_sigmas,
            gate_px=snakemake.params.gate_px,
            threads=snakemake.threads,
        )
