"""Match one strip of an epipolar pair densely: disparity, validity, confidence and similarity of its rows."""

import numpy as np

from cosp.dense.coarse_to_fine import STRIP_HALO_PX, match, strip_alignment_px
from cosp.dense.resampling import SmoothField, fill_holes
from cosp.imaging.windows import Window, strip_of
from cosp.io import rasters, records
from cosp.io.logs import log_to

SMOOTH_BAND = 2  # of y_parallax.tif
VALIDITY_BANDS = ("validity", "confidence", "similarity")


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
):
    disparity_range_px = records.read_json(rectification_path)["disparity_range_px"]
    header = rasters.info(fore_path)
    rows, columns = header.shape
    first, last = strip_of(rows, strip)
    wanted = Window(first, last, 0, columns)
    aligned = strip_alignment_px(disparity_range_px[1] - disparity_range_px[0])
    seen = Window(max(first - STRIP_HALO_PX, 0) // aligned * aligned, min(last + STRIP_HALO_PX, rows), 0, columns)
    aft_seen = Window(seen.row0, seen.row1, 0, rasters.info(aft_path).shape[1])

    found = match(
        rasters.read(fore_path, window=seen),
        rasters.read(aft_path, window=aft_seen),
        tuple(disparity_range_px),
        y_parallax=smooth_y_parallax(y_parallax_path, header.grid).moved(seen.row0, 0),
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

    # Not compressed, as the strips are joined soon and then removed.
    place = {"grid": header.grid.window(first, last, 0, columns), "crs": header.crs, "compressed": False}
    rasters.write(disparity_path, found.disparity, **place, descriptions=("disparity",))
    with rasters.create(
        validity_path, shape=wanted.shape, dtype=np.uint8, **place, count=3, descriptions=VALIDITY_BANDS
    ) as validity_file:
        for band, values in enumerate((found.validity, found.confidence, found.similarity), start=1):
            validity_file.write(None, values, band)


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
        )
