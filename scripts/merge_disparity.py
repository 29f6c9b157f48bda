"""Join the strips of a pair's dense matching into one disparity and one validity raster, with a picture of both."""

import cv2
import numpy as np

from cosp.dense.validity import summarise_disparity
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window
from cosp.io import rasters, records
from cosp.io.logs import log_to
from cosp.report.disparity import draw_disparity
from cosp.report.figures import save

ROWS_AT_ONCE = 512
SAMPLED_EVERY = 8  # row and column, for the statistics of disparity and the picture; more for long films
LONGEST_PICTURE_PX = 4000


def merge_disparity(
    disparity_strips, validity_strips, disparity_path, validity_path, summary_path, figure_path, *, title, threads=1
):
    # Rows of the strips step the same way, so the order along y is the order of rows.
    ordered = sorted(
        ((rasters.info(one), one, other) for one, other in zip(disparity_strips, validity_strips, strict=True)),
        key=lambda strip: strip[0].grid.y0 / strip[0].grid.step_y,
    )
    top = ordered[0][0]
    columns = top.shape[1]
    shape = (sum(header.shape[0] for header, _, _ in ordered), columns)
    sampled_every = max(SAMPLED_EVERY, -(-max(shape) // LONGEST_PICTURE_PX))
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
            threads=threads,
        ) as disparity_file,
        rasters.create(
            validity_path,
            shape=shape,
            dtype=np.uint8,
            grid=grid,
            crs=top.crs,
            count=3,
            descriptions=("validity", "confidence", "similarity"),
            threads=threads,
        ) as validity_file,
    ):
        row = 0
        for header, disparity_strip, validity_strip in ordered:
            for start in range(0, header.shape[0], ROWS_AT_ONCE):
                part = Window(start, min(start + ROWS_AT_ONCE, header.shape[0]), 0, columns)
                disparity = rasters.read(disparity_strip, window=part)
                bands = rasters.read(validity_strip, band=None, window=part)
                window = Window(row + part.row0, row + part.row1, 0, columns)
                disparity_file.write(window, disparity)
                for number, values in enumerate(bands, start=1):
                    validity_file.write(window, values, number)
                validity_counts += cv2.calcHist([bands[0]], [0], None, [256], [0, 256]).ravel().astype(np.int64)
                # Copies: a view would hold on to the rows it was taken from, and with them to the whole film.
                samples.append([one[::sampled_every, ::sampled_every].copy() for one in (disparity, *bands[1:])])
            row += header.shape[0]

    disparity, confidence, similarity = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    save(draw_disparity(disparity, confidence, similarity, title=title), figure_path)
    summary = summarise_disparity(validity_counts, disparity)
    records.write(summary_path, {"kind": "disparity_summary", "version": 1, **summary})


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        merge_disparity(
            disparity_strips=list(snakemake.input.disparity),
            validity_strips=list(snakemake.input.validity),
            disparity_path=snakemake.output.disparity,
            validity_path=snakemake.output.validity,
            summary_path=snakemake.output.summary,
            figure_path=snakemake.output.figure,
            title=snakemake.wildcards.pair,
            threads=snakemake.threads,
        )
