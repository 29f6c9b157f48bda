"""Find the exposed area of a joined film and trace its stripes and its long edges."""

import logging

import numpy as np
import pandas as pd

from cosp.camera.missions import WIDTH_MM, mission_for
from cosp.film.exposure import find_exposure
from cosp.film.stripes import band_profiles, band_window, smooth_base, trace_edge, trace_ridge
from cosp.io import rasters, records, tables
from cosp.io.logs import log_to


def trace_stripes(
    stitched_path,
    exposure_path,
    stripes_path,
    *,
    camera,
    pixel_um,
    search_pixel_mm,
    length_tolerance,
    width_tolerance,
    step_mm,
    samples,
    stripe_reach_mm,
    edge_reach_mm,
    min_edge_share,
    slope,
    min_contrast,
    min_step,
    outlier_mm,
):
    log = logging.getLogger("trace_stripes")
    pixel_mm = pixel_um / 1000
    mission = mission_for(camera)
    factor = max(1, round(search_pixel_mm / pixel_mm))
    exposure = find_exposure(
        rasters.read_reduced(stitched_path, factor),
        pixel_mm=pixel_mm,
        factor=factor,
        length_mm=mission.scan_length_mm,
        width_mm=WIDTH_MM,
        length_tolerance=length_tolerance,
        width_tolerance=width_tolerance,
    )
    records.write(exposure_path, exposure)
    log.info("%s", exposure)

    shape = rasters.info(stitched_path).shape
    count = int(2 * exposure.half_length_mm / step_mm)
    x_mm = (np.arange(count) - (count - 1) / 2) * step_mm
    half_width_mm = exposure.half_width_mm

    def profiles(sign, reach_mm, base_mm):
        low, high = sorted(sign * reach for reach in reach_mm)
        y_mm = np.arange(high, low, -pixel_mm)
        window = band_window(exposure, (base_mm.min() + low, base_mm.max() + high), shape)
        image = rasters.read(stitched_path, window=window)
        band = band_profiles(image, window, exposure, x_mm=x_mm, y_mm=y_mm, base_mm=base_mm, samples=samples)
        return band, y_mm

    traced = []
    for side, sign in (("top", 1), ("bottom", -1)):
        base_mm = np.full(count, sign * half_width_mm)
        band, y_mm = profiles(sign, edge_reach_mm, base_mm)
        edge = trace_edge(band, y_mm, x_mm, side=side, min_step=min_step, outlier_mm=outlier_mm).raised(base_mm)
        lines = {"edge": edge}
        if mission.has_stripes:
            base_mm = smooth_base(edge, straight_mm=sign * half_width_mm, min_share=min_edge_share)
            band, y_mm = profiles(sign, stripe_reach_mm, base_mm)
            lines["stripe"] = trace_ridge(
                band,
                y_mm,
                x_mm,
                side=side,
                slope_mm=slope * step_mm,
                min_contrast=min_contrast,
                outlier_mm=outlier_mm,
            ).raised(base_mm)
        for line, trace in lines.items():
            log.info("%s %s seen over %.0f %%, noise %.4f mm", side, line, 100 * trace.share, trace.noise_mm)
            traced.append(
                pd.DataFrame({"line": line, "side": side, "x_mm": x_mm, "y_mm": trace.y_mm, "strength": trace.strength})
            )
    tables.write(stripes_path, pd.concat(traced))


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        trace_stripes(
            stitched_path=snakemake.input.stitched,
            exposure_path=snakemake.output.exposure,
            stripes_path=snakemake.output.stripes,
            camera=snakemake.params.camera,
            pixel_um=snakemake.params.pixel_um,
            search_pixel_mm=snakemake.params.search_pixel_mm,
            length_tolerance=snakemake.params.length_tolerance,
            width_tolerance=snakemake.params.width_tolerance,
            step_mm=snakemake.params.step_mm,
            samples=snakemake.params.samples,
            stripe_reach_mm=snakemake.params.stripe_reach_mm,
            edge_reach_mm=snakemake.params.edge_reach_mm,
            min_edge_share=snakemake.params.min_edge_share,
            slope=snakemake.params.slope,
            min_contrast=snakemake.params.min_contrast,
            min_step=snakemake.params.min_step,
            outlier_mm=snakemake.params.outlier_mm,
        )
