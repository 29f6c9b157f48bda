"""Tie points of a pair: the same ground found in the fore and in the aft film."""

import numpy as np
import pandas as pd

from cosp.io import rasters, records, references, tables
from cosp.io.logs import log_to
from cosp.matching.film_image import FilmImage
from cosp.matching.footprint import Footprint
from cosp.matching.ground import Terrain, map_bounds, map_crs
from cosp.matching.matchers import matcher_by_name
from cosp.matching.ties import match_films, summary


def match_pair(
    fore_film_path,
    aft_film_path,
    fore_footprint_path,
    aft_footprint_path,
    reference_dem_path,
    tie_points_path,
    summary_path,
    *,
    reference_dem_heights,
    matcher,
    template_px,
    search_px,
    min_score,
    max_ratio,
    max_return_px,
    candidates,
    gate_px,
    tile_mm,
    min_per_tile,
    trials,
    min_ties,
    seed,
    threads,
):
    fore_camera, aft_camera = (records.read(p, Footprint).camera for p in (fore_footprint_path, aft_footprint_path))
    crs = map_crs(fore_camera)
    heights_on = references.heights_on(reference_dem_path, crs, reference_dem_heights)
    fore, aft = (
        FilmImage(rasters.info(path).grid, lambda window, path=path: rasters.read(path, window=window))
        for path in (fore_film_path, aft_film_path)
    )
    ties = match_films(
        fore,
        aft,
        fore_camera,
        aft_camera,
        heights_on=heights_on,
        crs=crs,
        matcher=matcher_by_name(
            matcher,
            template_px=template_px,
            search_px=search_px,
            min_score=min_score,
            max_ratio=max_ratio,
            max_return_px=max_return_px,
        ),
        candidates=candidates,
        template_px=template_px,
        search_px=search_px,
        gate_px=gate_px,
        tile_mm=tile_mm,
        min_per_tile=min_per_tile,
        min_ties=min_ties,
        trials=trials,
        rng=np.random.default_rng(seed),
        threads=threads,
    )
    table = {
        "fore_x_mm": ties.fore_mm[:, 0],
        "fore_y_mm": ties.fore_mm[:, 1],
        "aft_x_mm": ties.aft_mm[:, 0],
        "aft_y_mm": ties.aft_mm[:, 1],
        "sigma_px": ties.sigma_px,
        "score": ties.score,
    }
    tables.write(tie_points_path, pd.DataFrame(table))
    head = {"kind": "tie_points", "version": 1, "fore": fore_camera.scene, "aft": aft_camera.scene}
    height_m = Terrain.on(heights_on, map_bounds(fore_camera, crs), crs, 1000.0).mean_m
    records.write(summary_path, {**head, **summary(ties, fore_camera, aft_camera, height_m=height_m)})


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        match_pair(
            fore_film_path=snakemake.input.fore_film,
            aft_film_path=snakemake.input.aft_film,
            fore_footprint_path=snakemake.input.fore_footprint,
            aft_footprint_path=snakemake.input.aft_footprint,
            reference_dem_path=snakemake.input.reference_dem,
            tie_points_path=snakemake.output.tie_points,
            summary_path=snakemake.output.summary,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            matcher=snakemake.params.matcher,
            template_px=snakemake.params.template_px,
            search_px=snakemake.params.search_px,
            min_score=snakemake.params.min_score,
            max_ratio=snakemake.params.max_ratio,
            max_return_px=snakemake.params.max_return_px,
            candidates=snakemake.params.candidates,
            gate_px=snakemake.params.gate_px,
            tile_mm=snakemake.params.tile_mm,
            min_per_tile=snakemake.params.min_per_tile,
            trials=snakemake.params.trials,
            min_ties=snakemake.params.min_ties,
            seed=snakemake.params.seed,
            threads=snakemake.threads,
        )
