"""Resample the parts once into the film: joined, straight, clipped and in the fore sense."""

import itertools
import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from cosp.film.arrangement import laid
from cosp.film.bending import choose_bending, film_grid, straighten
from cosp.film.exposure import Exposure
from cosp.film.joining import Layout
from cosp.film.stripes import Trace
from cosp.geometry.statistics import nmad
from cosp.imaging.windows import tiles, worked_on
from cosp.io import rasters, records, tables
from cosp.io.logs import log_to
from cosp.report import figures
from cosp.report.film import draw_straightness


def correct_bending(
    part_paths,
    seams_path,
    exposure_path,
    stripes_path,
    film_path,
    summary_path,
    figure_path,
    *,
    scene,
    camera,
    look,
    clip_mm,
    min_share,
    max_noise_mm,
    step_mm,
    smoothing_mm,
    edge_smoothing_mm,
    single_sd_mm,
    none_sd_mm,
    threads,
):
    log = logging.getLogger("correct_bending")
    exposure = records.read(exposure_path, Exposure)
    seams = records.read_json(seams_path)
    traces, holes = {"stripe": [], "edge": []}, {}
    for (line, side), rows in tables.read(stripes_path).groupby(["line", "side"]):
        if line in traces:
            traces[line].append(
                Trace(side, rows["x_mm"].to_numpy(), rows["y_mm"].to_numpy(), rows["strength"].to_numpy())
            )
        if line == "hole" and len(rows):
            holes[side] = rows[["x_mm", "y_mm"]].to_numpy()
    bending = choose_bending(
        exposure,
        stripes=traces["stripe"],
        edges=traces["edge"],
        min_share=min_share,
        max_noise_mm=max_noise_mm,
        step_mm=step_mm,
        smoothing_mm=smoothing_mm,
        edge_smoothing_mm=edge_smoothing_mm,
        single_sd_mm=single_sd_mm,
        none_sd_mm=none_sd_mm,
    )
    used = {"stripes": traces["stripe"], "edges": traces["edge"], "none": []}[bending.source]
    left = {trace.side: straightened(bending, trace.x_mm, trace.y_mm) for trace in used}
    holes = {side: straightened(bending, *xy.T) for side, xy in holes.items()}
    figures.save(
        draw_straightness(left, holes, title=f"{scene}: straightened by {bending.source}"), figure_path, dpi=100
    )
    turned = look == "aft"
    half_length_mm = exposure.half_length_mm - clip_mm
    grid = film_grid(exposure, half_length_mm=half_length_mm, half_width_mm=exposure.half_width_mm)
    windows = tiles(grid.shape, (grid.shape[0], 2048))
    layout = records.from_plain(seams["layout"], Layout, f"{seams_path}: layout")
    parts = laid(
        {Path(path).stem: rasters.read(path) for path in part_paths},
        order=seams["part_order"],
        turned=seams["turned"],
        mirrored=seams["mirrored"],
    )

    def straight(window):
        return straighten(parts, layout, grid, window, exposure, bending, turned=turned)

    with (
        rasters.create(film_path, shape=grid.shape, dtype="uint8", grid=grid, crs=rasters.FILM_CRS, nodata=0) as film,
        ThreadPoolExecutor(threads) as pool,
    ):
        for number, (window, values) in enumerate(worked_on(pool, straight, windows, ahead=threads), 1):
            film.write(window, values)
            log.info("straightened %d/%d windows", number, len(windows))

    records.write(
        summary_path,
        {
            "kind": "film",
            "version": 1,
            "scene": scene,
            "camera": camera,
            "look": look,
            "pixel_mm": exposure.pixel_mm,
            "half_length_mm": grid.shape[1] / 2 * exposure.pixel_mm,
            "half_width_mm": grid.shape[0] / 2 * exposure.pixel_mm,
            "clip_mm": clip_mm,
            "turned": turned,
            "part_order": seams["part_order"],
            "parts_turned": seams["turned"],
            "mirrored": seams["mirrored"],
            "bending": bending,
            "exposure": exposure,
            "centre_sd_mm": (exposure.centre_sd_mm[0], float(np.hypot(exposure.centre_sd_mm[1], bending.sd_mm))),
            "rail_holes": [
                {"side": side, "count": len(xy), "deviation_nmad_mm": nmad(xy[:, 1])} for side, xy in holes.items()
            ],
            "lines": [
                {"line": line, "side": trace.side, "share": trace.share, "noise_mm": trace.noise_mm}
                for line, trace in itertools.chain.from_iterable(
                    [(line, trace) for trace in found] for line, found in traces.items()
                )
            ],
        },
    )


def straightened(bending, x_mm, y_mm):
    """Places (N, 2) on the straight film, their heights from their own median."""
    places = bending.straight(np.column_stack([x_mm, y_mm]))
    return places - [0.0, np.nanmedian(places[:, 1]) if np.isfinite(places[:, 1]).any() else 0.0]


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        correct_bending(
            part_paths=list(snakemake.input.parts),
            seams_path=snakemake.input.seams,
            exposure_path=snakemake.input.exposure,
            stripes_path=snakemake.input.stripes,
            film_path=snakemake.output.film,
            summary_path=snakemake.output.summary,
            figure_path=snakemake.output.figure,
            scene=snakemake.wildcards.scene,
            camera=snakemake.params.camera,
            look=snakemake.params.look,
            clip_mm=snakemake.params.clip_mm,
            min_share=snakemake.params.min_share,
            max_noise_mm=snakemake.params.max_noise_mm,
            step_mm=snakemake.params.step_mm,
            smoothing_mm=snakemake.params.smoothing_mm,
            edge_smoothing_mm=snakemake.params.edge_smoothing_mm,
            single_sd_mm=snakemake.params.single_sd_mm,
            none_sd_mm=snakemake.params.none_sd_mm,
            threads=snakemake.threads,
        )
