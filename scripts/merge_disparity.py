"""Join the strips of a pair's dense matching into one disparity and one validity raster."""

import numpy as np

from cosp.dense.validity import summarise_disparity
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters, records
from cosp.io.logs import log_to

ROWS_AT_ONCE = 512
SAMPLED_EVERY = 8  # row and column, for the statistics of disparity


def merge_disparity(strip_paths, disparity_path, validity_path, summary_path):
    headers = {path: rasters.info(path) for path in strip_paths}
    # Rows of the strips step the same way, so the order along y is the order of rows.
    ordered = sorted(strip_paths, key=lambda path: headers[path].grid.y0 / headers[path].grid.step_y)
    top = headers[ordered[0]]
    columns = top.shape[1]
    shape = (sum(headers[path].shape[0] for path in ordered), columns)
    grid = PixelGrid(top.grid.x0, top.grid.y0, top.grid.step_x, top.grid.step_y, shape)

    validity_counts, samples = np.zeros(256, np.int64), []
    with (
        rasters.create(
            disparity_path,
            shape=shape,
            dtype=np.float32,
            grid=grid,
            crs=top.crs,
            descriptions=("disparity",),
        ) as disparity_file,
        rasters.create(
            validity_path,
            shape=shape,
            dtype=np.uint8,
            grid=grid,
            crs=top.crs,
            count=3,
            descriptions=("validity", "confidence", "similarity"),
        ) as validity_file,
    ):
        row = 0
        for path in ordered:
            rows = headers[path].shape[0]
            for start in range(0, rows, ROWS_AT_ONCE):
                stop = min(start + ROWS_AT_ONCE, rows)
                disparity, validity, confidence, similarity = rasters.read(
                    path, band=None, window=Window(start, stop, 0, columns)
                )
                window = Window(row + start, row + stop, 0, columns)
                disparity_file.write(window, disparity)
                validity = validity.astype(np.uint8)
                validity_file.write(window, validity, 1)
                validity_file.write(window, confidence.astype(np.uint8), 2)
                validity_file.write(window, similarity.astype(np.uint8), 3)
                validity_counts += np.bincount(validity.ravel(), minlength=256)
                samples.append(disparity[::SAMPLED_EVERY, ::SAMPLED_EVERY].ravel())
            row += rows

    summary = summarise_disparity(validity_counts, np.concatenate(samples))
    records.write(summary_path, {"kind": "disparity_summary", "version": 1, **summary})


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        merge_disparity(
            strip_paths=list(snakemake.input.strips),
            disparity_path=snakemake.output.disparity,
            validity_path=snakemake.output.validity,
            summary_path=snakemake.output.summary,
        )
