"""Find the exposed area of a joined film and trace its stripes and its long edges."""

import logging
from pathlib import Path

import numpy as np
import pandas as pd

from cosp.camera.missions import WIDTH_MM, mission_for
from cosp.errors import InputError
from cosp.film.arrangement import laid
from cosp.film.exposure import find_exposure, inverted
from cosp.film.joining import Layout, compose_reduced
from cosp.film.rail_holes import find_rail_holes
from cosp.film.stripes import band_profiles, smooth_base, trace_edge, trace_ridge
from cosp.io import rasters, records, tables
from cosp.io.logs import log_to

# Rail holes are half a millimetre wide: their centres need no finer pixels.
_HOLE_PIXEL_MM = 0.028


def trace_stripes(
    part_paths,
    seams_path,
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
    hole_diameter_mm,
    hole_spacing_mm,
    hole_contrast,
):
    log = logging.getLogger("trace_stripes")
    pixel_mm = pixel_um / 1000
    mission = mission_for(camera)
    seams = records.read_json(seams_path)
    layout = records.from_plain(seams["layout"], Layout, f"{seams_path}: layout")
    parts = laid(
        {Path(path).stem: rasters.read(path) for path in part_paths},
        order=seams["part_order"],
        turned=seams["turned"],
        mirrored=seams["mirrored"],
    )
    factor = max(1, round(search_pixel_mm / pixel_mm))
    try:
        exposure = find_exposure(
            compose_reduced(parts, layout, factor),
            pixel_mm=pixel_mm,
            factor=factor,
            length_mm=mission.scan_length_mm,
            width_mm=WIDTH_MM,
            length_tolerance=length_tolerance,
            width_tolerance=width_tolerance,
        )
    except InputError as problem:
        raise InputError(f"{', '.join(map(str, part_paths))}: {problem}") from problem
    if exposure.negative:
        log.warning("the picture is darker than the film beside it: a negative")
        parts = [inverted(part) for part in parts]
    if max(exposure.edges_found) == 0:
        log.warning("no film is seen beside the picture: its centre is taken to be that of the scan")
    records.write(exposure_path, exposure)
    log.info("%s", exposure)

    count = int(2 * exposure.half_length_mm / step_mm)
    x_mm = (np.arange(count) - (count - 1) / 2) * step_mm
    half_width_mm = exposure.half_width_mm

    def profiles(sign, reach_mm, base_mm):
        low, high = sorted(sign * reach for reach in reach_mm)
        y_mm = np.arange(high, low, -pixel_mm)
        return band_profiles(parts, layout, exposure, x_mm=x_mm, y_mm=y_mm, base_mm=base_mm, samples=samples), y_mm

    def holes_table(side, x_mm, base_mm, reach_mm):
        """Centres of the rail holes beside one edge of the picture; they are reported, and bend nothing."""
        step_mm = max(pixel_mm, _HOLE_PIXEL_MM)
        x = np.arange(x_mm[0], x_mm[-1], step_mm)
        y = np.arange(reach_mm[1], reach_mm[0], -step_mm)
        base = np.interp(x, x_mm, base_mm)
        band = band_profiles(parts, layout, exposure, x_mm=x, y_mm=y, base_mm=base, samples=1)
        holes = find_rail_holes(
            band, x, y, diameter_mm=hole_diameter_mm, spacing_mm=hole_spacing_mm, min_contrast=hole_contrast
        )
        log.info("%s: %d rail holes", side, len(holes))
        heights = holes[:, 1] + np.interp(holes[:, 0], x_mm, base_mm)
        return pd.DataFrame({"line": "hole", "side": side, "x_mm": holes[:, 0], "y_mm": heights, "strength": 0.0})

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
            traced.append(holes_table(side, x_mm, base_mm, sorted(sign * reach for reach in stripe_reach_mm)))
        for line, trace in lines.items():
            log.info("%s %s seen over %.0f %%, noise %.4f mm", side, line, 100 * trace.share, trace.noise_mm)
            traced.append(
                pd.DataFrame({"line": line, "side": side, "x_mm": x_mm, "y_mm": trace.y_mm, "strength": trace.strength})
            )
    tables.write(stripes_path, pd.concat(traced))


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        trace_stripes(
            part_paths=list(snakemake.input.parts),
            seams_path=snakemake.input.seams,
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
            hole_diameter_mm=snakemake.params.hole_diameter_mm,
            hole_spacing_mm=snakemake.params.hole_spacing_mm,
            hole_contrast=snakemake.params.hole_contrast,
        )
