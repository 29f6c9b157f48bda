"""Measure the y-parallax that is left in an epipolar pair, and draw a smooth field through it."""

import logging

import numpy as np

from cosp.epipolar.parallax import measure_y_parallax as measure
from cosp.epipolar.parallax import node_grid
from cosp.epipolar.patches import image_patches
from cosp.epipolar.rectification import Rectification
from cosp.io import rasters, records
from cosp.io.logs import log_to


def measure_y_parallax(
    fore_path,
    aft_path,
    rectification_path,
    y_parallax_path,
    summary_path,
    *,
    spacing_px,
    fewest_nodes,
    template_px,
    least_score,
    largest_ratio,
    smoothing_nodes,
    fewest_matches,
    threads,
):
    rectification = records.read(rectification_path, Rectification)
    nodes = node_grid(rectification.shape, spacing_px=spacing_px, fewest_nodes=fewest_nodes)
    centres = nodes.centres()
    found = measure(
        image_patches(lambda window: rasters.read(fore_path, window=window), rectification.shape),
        image_patches(lambda window: rasters.read(aft_path, window=window), rectification.shape),
        nodes,
        rectification.disparity_bounds(centres[..., 1], centres[..., 0]),
        template_px=template_px,
        least_score=least_score,
        largest_ratio=largest_ratio,
        smoothing_nodes=smoothing_nodes,
        fewest_matches=fewest_matches,
        threads=threads,
    )
    rasters.write(
        y_parallax_path,
        np.stack([found.raw_px, found.smooth_px, found.score, found.disparity_px]).astype(np.float32),
        grid=nodes,
        crs=rasters.PIXEL_CRS,
        descriptions=("y_parallax_px", "smooth_y_parallax_px", "score", "disparity_px"),
    )
    summary = found.summary()
    logging.getLogger("measure_y_parallax").info("%s", summary)
    records.write(summary_path, {"kind": "y_parallax", "version": 1, **summary})


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        measure_y_parallax(
            fore_path=snakemake.input.fore,
            aft_path=snakemake.input.aft,
            rectification_path=snakemake.input.rectification,
            y_parallax_path=snakemake.output.y_parallax,
            summary_path=snakemake.output.summary,
            spacing_px=snakemake.params.spacing_px,
            fewest_nodes=snakemake.params.fewest_nodes,
            template_px=snakemake.params.template_px,
            least_score=snakemake.params.least_score,
            largest_ratio=snakemake.params.largest_ratio,
            smoothing_nodes=snakemake.params.smoothing_nodes,
            fewest_matches=snakemake.params.fewest_matches,
            threads=snakemake.threads,
        )
