"""Resample the joined film so that it is straight, clipped and in the fore sense."""

import itertools
import logging
from concurrent.futures import ThreadPoolExecutor

from cosp.film.bending import choose_bending, film_grid, joined_window, straighten
from cosp.film.exposure import Exposure
from cosp.film.stripes import Trace
from cosp.imaging.windows import tiles
from cosp.io import rasters, records, tables
from cosp.io.logs import log_to


def correct_bending(
    stitched_path,
    seams_path,
    exposure_path,
    stripes_path,
    film_path,
    summary_path,
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
    traces = {"stripe": [], "edge": []}
    for (line, side), rows in tables.read(stripes_path).groupby(["line", "side"]):
        if line in traces:
            traces[line].append(
                Trace(side, rows["x_mm"].to_numpy(), rows["y_mm"].to_numpy(), rows["strength"].to_numpy())
            )
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
    turned = look == "aft"
    half_length_mm = exposure.half_length_mm - clip_mm
    grid = film_grid(exposure, half_length_mm=half_length_mm, half_width_mm=exposure.half_width_mm)
    joined_shape = rasters.info(stitched_path).shape
    windows = tiles(grid.shape, (grid.shape[0], 2048))

    def straight(source, image, window):
        return straighten(image, source, grid, window, exposure, bending, turned=turned)

    with (
        rasters.create(film_path, shape=grid.shape, dtype="uint8", grid=grid, crs=rasters.FILM_CRS, nodata=0) as film,
        ThreadPoolExecutor(threads) as pool,
    ):
        for start in range(0, len(windows), threads):
            batch = windows[start : start + threads]
            sources = [joined_window(grid, window, exposure, bending, joined_shape, turned=turned) for window in batch]
            images = [rasters.read(stitched_path, window=source) for source in sources]
            for window, values in zip(batch, pool.map(straight, sources, images, batch), strict=True):
                film.write(window, values)
            log.info("straightened %d/%d windows", min(start + threads, len(windows)), len(windows))

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
            "centre_sd_mm": exposure.centre_sd_mm,
            "lines": [
                {"line": line, "side": trace.side, "share": trace.share, "noise_mm": trace.noise_mm}
                for line, trace in itertools.chain.from_iterable(
                    [(line, trace) for trace in found] for line, found in traces.items()
                )
            ],
        },
    )


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        correct_bending(
            stitched_path=snakemake.input.stitched,
            seams_path=snakemake.input.seams,
            exposure_path=snakemake.input.exposure,
            stripes_path=snakemake.input.stripes,
            film_path=snakemake.output.film,
            summary_path=snakemake.output.summary,
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
