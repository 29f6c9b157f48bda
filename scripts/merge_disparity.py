"""Join the strips of a pair's dense matching into one disparity and one validity raster, with a picture of both."""

from pathlib import Path

import cv2
import numpy as np

from cosp.dense.validity import summarise_disparity
from cosp.imaging.windows import Window, strip_of
from cosp.io import arrays, rasters, records
from cosp.io.logs import log_to
from cosp.report.disparity import draw_disparity
from cosp.report.figures import save

ROWS_AT_ONCE = 512
SAMPLED_EVERY = 8  # row and column, for the statistics of disparity and the picture; more for long films
LONGEST_PICTURE_PX = 4000
VALIDITY_BANDS = ("validity", "confidence", "similarity")


def merge_disparity(
    fore_path,
    disparity_strips,
    validity_strips,
    disparity_path,
    validity_path,
    summary_path,
    figure_path,
    *,
    title,
    threads=1,
):
    header = rasters.info(fore_path)
    rows, columns = header.shape
    sampled_every = max(SAMPLED_EVERY, -(-max(rows, columns) // LONGEST_PICTURE_PX))
    place = {"shape": header.shape, "grid": header.grid, "crs": header.crs, "threads": threads}

    validity_counts, samples = np.zeros(256, np.int64), []
    with (
        rasters.create(disparity_path, dtype=np.float32, descriptions=("disparity",), **place) as disparity_file,
        rasters.create(validity_path, dtype=np.uint8, count=3, descriptions=VALIDITY_BANDS, **place) as validity_file,
    ):
        strips = zip(disparity_strips, validity_strips, strict=True)
        for (first, last), disparity_strip, validity_strip in sorted(
            (strip_of(rows, Path(one).stem), one, other) for one, other in strips
        ):
            (disparity,), validity = arrays.view(disparity_strip), arrays.view(validity_strip)
            for start in range(first, last, ROWS_AT_ONCE):
                window = Window(start, min(start + ROWS_AT_ONCE, last), 0, columns)
                part = slice(window.row0 - first, window.row1 - first)
                bands = validity[:, part]
                disparity_file.write(window, disparity[part])
                for number, values in enumerate(bands, start=1):
                    validity_file.write(window, values, number)
                validity_counts += cv2.calcHist([bands[0]], [0], None, [256], [0, 256]).ravel().astype(np.int64)
                # Copies: a view would hold on to the rows it was taken from, and with them to the whole film.
                samples.append([one[::sampled_every, ::sampled_every].copy() for one in (disparity[part], *bands[1:])])

    disparity, confidence, similarity = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    save(draw_disparity(disparity, confidence, similarity, title=title), figure_path)
    summary = summarise_disparity(validity_counts, disparity)
    records.write(summary_path, {"kind": "disparity_summary", "version": 1, **summary})


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        merge_disparity(
            fore_path=snakemake.input.fore,
            disparity_strips=list(snakemake.input.disparity),
            validity_strips=list(snakemake.input.validity),
            disparity_path=snakemake.output.disparity,
            validity_path=snakemake.output.validity,
            summary_path=snakemake.output.summary,
            figure_path=snakemake.output.figure,
            title=snakemake.wildcards.pair,
            threads=snakemake.threads,
        )
