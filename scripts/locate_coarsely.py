"""Look for a film on the ground: predicted camera in, camera fitted to the reference out, or why there is none."""

from datetime import date

import numpy as np

from cosp.camera.panoramic import PanoramicCamera
from cosp.io import rasters, records, references
from cosp.io.logs import log_to
from cosp.matching.film_image import FilmImage
from cosp.matching.footprint import Attempt
from cosp.matching.ground import map_crs
from cosp.matching.placement import SearchLimits, locate_film
from cosp.report import figures
from cosp.report.placement import draw_placement


def locate_coarsely(
    film_path,
    camera_path,
    reference_dem_path,
    reference_image_path,
    placement_path,
    figure_path,
    *,
    day,
    reference_dem_heights,
    search_km,
    limits,
    seed,
    threads,
):
    camera = records.read(camera_path, PanoramicCamera)
    crs = map_crs(camera)
    film = FilmImage(rasters.info(film_path).grid, lambda window: rasters.read(film_path, window=window))
    located = locate_film(
        film,
        camera,
        reference_on=references.image_on(reference_image_path, crs) if reference_image_path else None,
        heights_on=references.heights_on(reference_dem_path, crs, reference_dem_heights),
        day=date.fromisoformat(day) if day else None,
        crs=crs,
        search_m=1000.0 * search_km,
        limits=limits,
        rng=np.random.default_rng(seed),
        threads=threads,
    )
    figures.save(draw_placement(camera.scene, located), figure_path, dpi=110)
    records.write(placement_path, Attempt(camera.scene, located.footprint, located.refusal))


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        locate_coarsely(
            film_path=snakemake.input.film,
            camera_path=snakemake.input.camera,
            reference_dem_path=snakemake.input.reference_dem,
            reference_image_path=snakemake.input.get("reference_image"),
            placement_path=snakemake.output.placement,
            figure_path=snakemake.output.figure,
            day=snakemake.params.day,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            search_km=snakemake.params.search_km,
            limits=SearchLimits.of(snakemake.params),
            seed=snakemake.params.seed,
            threads=snakemake.threads,
        )
