"""Match one strip of a placed film against the reference, tile by tile on the map."""

import pandas as pd

from cosp.imaging.windows import strip_of
from cosp.io import rasters, records, references, tables
from cosp.io.logs import log_to
from cosp.matching.film_image import FilmImage
from cosp.matching.footprint import Footprint
from cosp.matching.ground import PlacedFilm, control_tiles, map_crs, match_control
from cosp.matching.matchers import LEARNED, matcher_by_name
from cosp.matching.relief import relief_reference, relief_sigma_m
from cosp.matching.wide_tiles import match_wide_strip


def match_tiles(
    film_path,
    footprint_path,
    reference_dem_path,
    reference_image_path,
    matches_path,
    *,
    scatteritem,
    reference_dem_heights,
    matcher,
    template_px,
    search_px,
    min_score,
    max_ratio,
    max_return_px,
    relief_template_px,
    relief_min_score,
    relief_max_ratio,
    candidates,
    features,
    max_features,
    tile_width_px,
    tile_height_px,
    max_tiles,
    superglue_weights,
    threads,
):
    footprint = records.read(footprint_path, Footprint)
    camera = footprint.camera
    crs = map_crs(camera)
    heights_on = references.heights_on(reference_dem_path, crs, reference_dem_heights)
    if reference_image_path:
        reference_on = references.image_on(reference_image_path, crs)
        reference_posting_m = references.posting_m(reference_image_path)
    else:
        reference_on = relief_reference(heights_on, footprint.sun_azimuth_deg, footprint.sun_elevation_deg)
        reference_posting_m = references.posting_m(reference_dem_path)
    film = FilmImage(rasters.info(film_path).grid, lambda window: rasters.read(film_path, window=window))
    placed = PlacedFilm.of(
        film,
        camera,
        reference_on=reference_on,
        heights_on=heights_on,
        crs=crs,
        reference_posting_m=reference_posting_m,
    )
    if not reference_image_path:
        template_px = placed.template_within_px(relief_template_px)
        min_score, max_ratio = relief_min_score, relief_max_ratio
    chosen = matcher_by_name(
        matcher,
        template_px=template_px,
        search_px=search_px,
        min_score=min_score,
        max_ratio=max_ratio,
        max_return_px=max_return_px,
        features=features,
        max_features=max_features,
        superglue_weights=superglue_weights,
    )
    if matcher in LEARNED:
        tile_px = (tile_height_px, tile_width_px)
        matches = match_wide_strip(
            placed, scatteritem, matcher=chosen, tile_px=tile_px, max_tiles=max_tiles, threads=threads
        )
    else:
        tiles_mm = control_tiles(camera, candidates)
        first, last = strip_of(len(tiles_mm), scatteritem)
        matches = match_control(
            placed,
            tiles_mm[first:last],
            matcher=chosen,
            template_px=template_px,
            search_px=search_px,
            threads=threads,
        )
    sigma_m = matches.sigma_m if reference_image_path else relief_sigma_m(matches.sigma_m, placed.posting_m)
    lonlath = matches.lonlath(crs)
    table = {
        "x_mm": matches.film_mm[:, 0],
        "y_mm": matches.film_mm[:, 1],
        "longitude_deg": lonlath[:, 0],
        "latitude_deg": lonlath[:, 1],
        "score": matches.score,
        "sigma_px": sigma_m / placed.pixel_m,
        "posting_m": placed.posting_m,
        "template_px": template_px,
    }
    tables.write(matches_path, pd.DataFrame(table))


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        match_tiles(
            film_path=snakemake.input.film,
            footprint_path=snakemake.input.footprint,
            reference_dem_path=snakemake.input.reference_dem,
            reference_image_path=snakemake.input.get("reference_image"),
            matches_path=snakemake.output.matches,
            scatteritem=snakemake.wildcards.scatteritem,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            matcher=snakemake.params.matcher,
            template_px=snakemake.params.template_px,
            search_px=snakemake.params.search_px,
            min_score=snakemake.params.min_score,
            max_ratio=snakemake.params.max_ratio,
            max_return_px=snakemake.params.max_return_px,
            relief_template_px=snakemake.params.relief_template_px,
            relief_min_score=snakemake.params.relief_min_score,
            relief_max_ratio=snakemake.params.relief_max_ratio,
            candidates=snakemake.params.candidates,
            features=snakemake.params.features,
            max_features=snakemake.params.max_features,
            tile_width_px=snakemake.params.tile_width_px,
            tile_height_px=snakemake.params.tile_height_px,
            max_tiles=snakemake.params.max_tiles,
            superglue_weights=snakemake.params.superglue_weights,
            threads=snakemake.threads,
        )
