"""Match one strip of an epipolar pair densely: disparity, validity, confidence and similarity of its rows."""

import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from cosp.dense.coarse_to_fine import STRIP_HALO_PX, match, strip_alignment_px
from cosp.dense.resampling import SmoothField, StartInterval, fill_holes
from cosp.imaging.windows import Window, strip_of
from cosp.io import arrays, rasters, records
from cosp.io.logs import log_to

SMOOTH_BAND = 2  # of y_parallax.tif
NODE_SPACING_PX = 64  # of the start interval
FOOTPRINT_POINTS = 25  # a side
BLOCKS_AT_ONCE = 64  # rows of blocks of the reference DEM


def match_dense(
    fore_path,
    aft_path,
    y_parallax_path,
    rectification_path,
    disparity_path,
    validity_path,
    *,
    strip,
    small_step,
    large_step,
    least_texture_sd,
    saturated_from,
    least_correlation,
    least_uniqueness,
    largest_speckle_px,
    speckle_step_px,
    threads,
    start_interval_m=0,
    fore_camera_path=None,
    aft_camera_path=None,
    reference_dem_path=None,
    reference_dem_heights=None,
    unstable_path=None,
):
    disparity_range_px = records.read_json(rectification_path)["disparity_range_px"]
    header = rasters.info(fore_path)
    rows, columns = header.shape
    first, last = strip_of(rows, strip)
    aligned = strip_alignment_px(disparity_range_px[1] - disparity_range_px[0])
    seen = Window(max(first - STRIP_HALO_PX, 0) // aligned * aligned, min(last + STRIP_HALO_PX, rows), 0, columns)
    aft_seen = Window(seen.row0, seen.row1, 0, rasters.info(aft_path).shape[1])

    start = None
    if start_interval_m:
        start = start_interval(
            rectification_path,
            fore_camera_path,
            aft_camera_path,
            reference_dem_path,
            reference_dem_heights,
            unstable_path,
            seen,
            start_interval_m,
        )

    with ThreadPoolExecutor(threads) as pool:
        fore, aft = pool.map(
            lambda path, window: rasters.read(path, window=window), (fore_path, aft_path), (seen, aft_seen)
        )
    found = match(
        fore,
        aft,
        tuple(disparity_range_px),
        y_parallax=smooth_y_parallax(y_parallax_path, header.grid).moved(seen.row0, 0),
        start=start,
        small_step=small_step,
        large_step=large_step,
        least_texture_sd=least_texture_sd,
        saturated_from=saturated_from,
        least_correlation=least_correlation,
        least_uniqueness=least_uniqueness,
        largest_speckle_px=largest_speckle_px,
        speckle_step_px=speckle_step_px,
        rows=(first - seen.row0, last - seen.row0),
        threads=threads,
    )

    # Plain arrays, as the strips are joined soon and then removed.
    arrays.write(disparity_path, [found.disparity])
    arrays.write(validity_path, [found.validity, found.confidence, found.similarity])


def smooth_y_parallax(y_parallax_path, fore_grid):
    """The y-parallax as a field over the pixels of the fore epipolar image."""
    grid = rasters.info(y_parallax_path).grid
    first_row, first_column = fore_grid.pixels((grid.x0, grid.y0))
    return SmoothField(
        fill_holes(rasters.read(y_parallax_path, band=SMOOTH_BAND)),
        first_row=float(first_row),
        first_column=float(first_column),
        row_step=grid.step_y / fore_grid.step_y,
        column_step=grid.step_x / fore_grid.step_x,
    )


def start_interval(rectification_path, fore_path, aft_path, dem_path, dem_heights, unstable_path, window, margin_m):
    """Disparities of ground near the reference DEM over a window of the fore image; None where there is no DEM."""
    # Not asked for as a rule, and every strip would wait for these longer than for all else that it imports.
    from pyproj import Transformer

    from cosp.camera.panoramic import PanoramicCamera
    from cosp.epipolar.rectification import Rectification
    from cosp.epipolar.start_interval import POSTINGS, disparities_about
    from cosp.imaging.resampling import block_extremes
    from cosp.io import heights, vectors

    rectification = records.read(rectification_path, Rectification)
    fore, aft = (records.read(path, PanoramicCamera) for path in (fore_path, aft_path))
    rows, columns = (
        np.linspace(first, last - 1, FOOTPRINT_POINTS)
        for first, last in ((window.row0, window.row1), (window.column0, window.column1))
    )
    film_mm = rectification.fore_film(rows[:, None], columns[None, :])
    lonlat = np.concatenate([fore.locate_geodetic(film_mm, h)[..., :2].reshape(-1, 2) for h in rectification.heights_m])
    lonlat = lonlat[np.isfinite(lonlat).all(axis=-1)]
    info = rasters.info(dem_path)
    to_map = Transformer.from_crs("EPSG:4326", info.crs, always_xy=True)
    places = info.grid.pixels(np.stack(to_map.transform(*lonlat.T), axis=-1))
    ends = []
    for place, size in zip(places, info.shape, strict=True):
        margin = 0.05 * np.ptp(place) + 4.0
        ends += [max(0, int(place.min() - margin)), min(size, int(place.max() + margin))]
    if ends[0] >= ends[1] or ends[2] >= ends[3]:
        return None
    # Cells that are smaller than nodes can tell apart are looked at in blocks.
    cells_a_px = np.sqrt(np.prod([np.ptp(place) for place in places]) / np.prod(window.shape))
    block = max(1, int(NODE_SPACING_PX / POSTINGS * cells_a_px))
    grid = info.grid.window(*ends)
    blocks = []
    for row in range(0, grid.shape[0], block * BLOCKS_AT_ONCE):
        part = grid.window(row, min(row + block * BLOCKS_AT_ONCE, grid.shape[0]), 0, grid.shape[1])
        height_m = heights.ellipsoidal_heights(dem_path, part, info.crs, dem_heights)
        unsure = vectors.rasterise(unstable_path, part, info.crs) if unstable_path else np.zeros(part.shape, bool)
        blocks.append((*block_extremes(height_m, block), block_extremes(unsure, block)[1]))
    lowest_m, highest_m, unsure = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    centres = grid.coarsened(block).centres()
    lowest, highest, spacing_px = disparities_about(
        rectification,
        fore.project_geodetic,
        aft.project_geodetic,
        np.stack(to_map.transform(centres[..., 0], centres[..., 1], direction="INVERSE"), axis=-1),
        lowest_m,
        highest_m,
        unsure,
        window,
        margin_m=margin_m,
        least_spacing_px=NODE_SPACING_PX,
    )
    low, high = rectification.disparity_range_px
    bound = (lowest > low) | (highest < high)
    logging.getLogger("match_dense").info(
        "start interval from blocks of %d cells of the reference DEM over %.0f %% of the strip, %.0f px in the middle",
        block,
        100 * bound.mean(),
        np.median((highest - lowest)[bound]) if bound.any() else high - low,
    )
    return StartInterval(
        *(SmoothField(nodes.astype(np.float32), 0.0, 0.0, spacing_px, spacing_px) for nodes in (lowest, highest))
    )


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        match_dense(
            fore_path=snakemake.input.fore,
            aft_path=snakemake.input.aft,
            y_parallax_path=snakemake.input.y_parallax,
            rectification_path=snakemake.input.rectification,
            disparity_path=snakemake.output.disparity,
            validity_path=snakemake.output.validity,
            strip=snakemake.params.scatteritem,
            small_step=snakemake.params.small_step,
            large_step=snakemake.params.large_step,
            least_texture_sd=snakemake.params.least_texture_sd,
            saturated_from=snakemake.params.saturated_from,
            least_correlation=snakemake.params.least_correlation,
            least_uniqueness=snakemake.params.least_uniqueness,
            largest_speckle_px=snakemake.params.largest_speckle_px,
            speckle_step_px=snakemake.params.speckle_step_px,
            threads=snakemake.threads,
            start_interval_m=snakemake.params.start_interval_m,
            fore_camera_path=f"{snakemake.input.get('cameras')}/{snakemake.params.fore}.json",
            aft_camera_path=f"{snakemake.input.get('cameras')}/{snakemake.params.aft}.json",
            reference_dem_path=snakemake.input.get("reference_dem"),
            reference_dem_heights=snakemake.params.reference_dem_heights,
            unstable_path=snakemake.input.get("unstable_terrain"),
        )
