"""Tie points of two films: the same ground found in fore and aft, or in neighbouring frames of one camera."""

import logging

import numpy as np
import pandas as pd

from cosp.errors import NoOverlapError, NotEnoughMatchesError
from cosp.io import rasters, records, references, tables
from cosp.io.logs import log_to
from cosp.matching.film_image import FilmImage
from cosp.matching.footprint import Footprint
from cosp.matching.ground import Terrain, map_bounds, map_crs
from cosp.matching.matchers import matcher_by_name
from cosp.matching.ties import FilmMatches, match_films, summary

log = logging.getLogger("match_pair")

SIGMAS = 3.0  # of the place that neighbours give a frame; so far off it is looked for


def match_pair(
    first_film_path,
    second_film_path,
    first_footprint_path,
    second_footprint_path,
    reference_dem_path,
    tie_points_path,
    summary_path,
    *,
    names,
    needed,
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
    footprints = [records.read(path, Footprint) for path in (first_footprint_path, second_footprint_path)]
    cameras = [footprint.camera for footprint in footprints]
    crs = map_crs(cameras[0])
    heights_on = references.heights_on(reference_dem_path, crs, reference_dem_heights)
    films = [
        FilmImage(rasters.info(path).grid, lambda window, path=path: rasters.read(path, window=window, threads=threads))
        for path in (first_film_path, second_film_path)
    ]
    reason = None
    try:
        ties = match_films(
            *films,
            *cameras,
            heights_on=heights_on,
            crs=crs,
            matcher_of=lambda size, reach: matcher_by_name(
                matcher,
                template_px=size,
                search_px=reach,
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
            offset_m=SIGMAS * float(np.linalg.norm([f.sigma_m for f in footprints if f.reference == "neighbours"])),
        )
    except (NoOverlapError, NotEnoughMatchesError) as error:
        if needed:
            raise
        reason = str(error)
        log.warning("%s; the block has to do without", reason)
        ties = FilmMatches.none()
    table = {
        f"{names[0]}_x_mm": ties.first_mm[:, 0],
        f"{names[0]}_y_mm": ties.first_mm[:, 1],
        f"{names[1]}_x_mm": ties.second_mm[:, 0],
        f"{names[1]}_y_mm": ties.second_mm[:, 1],
        "sigma_px": ties.sigma_px,
        "score": ties.score,
    }
    tables.write(tie_points_path, pd.DataFrame(table))
    head = {"kind": "tie_points", "version": 1, **dict(zip(names, (c.scene for c in cameras), strict=True))}
    height_m = Terrain.on(heights_on, map_bounds(cameras[0], crs), crs, 1000.0).mean_m
    records.write(summary_path, {**head, **summary(ties, *cameras, height_m=height_m), "reason": reason})


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        match_pair(
            first_film_path=snakemake.input.first_film,
            second_film_path=snakemake.input.second_film,
            first_footprint_path=snakemake.input.first_footprint,
            second_footprint_path=snakemake.input.second_footprint,
            reference_dem_path=snakemake.input.reference_dem,
            tie_points_path=snakemake.output.tie_points,
            summary_path=snakemake.output.summary,
            names=snakemake.params.names,
            needed=snakemake.params.needed,
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
