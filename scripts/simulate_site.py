"""Make the ground of a simulated site: terrain of both epochs, reference data, outlines, sheets and truth."""

import logging

import numpy as np

from cosp.io import heights, rasters, records, vectors
from cosp.io.logs import log_to
from cosp.simulation import description
from cosp.simulation.reference import make_reference_dem, make_reference_image, unstable_polygons
from cosp.simulation.site import SiteSettings, plan_site
from cosp.simulation.terrain import FILM_EPOCH, MODERN_EPOCH, light_terrain, make_terrain
from cosp.simulation.truth import site_truth

ELLIPSOIDAL = {"heights": "ellipsoidal (WGS 84), m"}


def simulate_site(
    settings,
    reference_dem_path,
    reference_image_path,
    unstable_path,
    terrain_path,
    terrain_modern_path,
    scenery_path,
    truth_path,
    scenes_path,
    pairs_path,
    config_path,
    threads,
):
    log = logging.getLogger("simulate_site")
    plan = plan_site(settings)
    grid = plan.terrain_grid
    dem = None
    photo = None
    if settings.dem is not None:
        dem = heights.ellipsoidal_heights(settings.dem, grid, plan.crs, settings.dem_heights)
    if settings.image is not None:
        photo = rasters.read_on_grid(settings.image, grid, plan.crs, resampling="average")
        low, high = np.nanpercentile(photo, [1.0, 99.0])
        photo = np.clip((photo - low) * (230.0 / max(high - low, 1e-6)) + 15.0, 0.0, 255.0)
    terrain = make_terrain(plan, dem, threads=threads)
    log.info("terrain made: %d x %d cells of %g m", *grid.shape, grid.step_x)
    rasters.write(terrain_path, terrain.film, grid=grid, crs=plan.crs, tags=ELLIPSOIDAL)
    rasters.write(terrain_modern_path, terrain.modern, grid=grid, crs=plan.crs, tags=ELLIPSOIDAL)

    scenery = light_terrain(plan, terrain, FILM_EPOCH, photo, threads=threads)
    with rasters.create(
        scenery_path, shape=grid.shape, dtype="uint8", grid=grid, crs=plan.crs, count=2,
        descriptions=("radiance", "texture"),
    ) as writer:  # fmt: skip
        writer.write(None, scenery.radiance, 1)
        writer.write(None, scenery.strength, 2)
    scenery = light_terrain(plan, terrain, MODERN_EPOCH, photo, threads=threads)
    log.info("light of both epochs done")

    rng = np.random.default_rng([settings.seed, 41])
    reference, reference_grid, reference_crs = make_reference_dem(plan, terrain, rng)
    rasters.write(reference_dem_path, reference, grid=reference_grid, crs=reference_crs, tags=ELLIPSOIDAL)
    image, image_grid = make_reference_image(plan, scenery, rng, threads=threads)
    rasters.write(reference_image_path, image, grid=image_grid, crs=plan.crs, nodata=0)
    log.info("reference DEM and image done")

    vectors.write(unstable_path, unstable_polygons(plan, terrain), "unstable_terrain")
    records.write(truth_path, site_truth(plan))
    config = description.site_config(plan, scenes=str(scenes_path), pairs=str(pairs_path))
    records.write_text(scenes_path, description.scene_sheet(plan))
    records.write_text(pairs_path, description.pair_sheet(plan))
    records.write_text(config_path, description.config_text(config))


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        simulate_site(
            settings=SiteSettings(name=snakemake.wildcards.site, **snakemake.params.options),
            reference_dem_path=snakemake.output.reference_dem,
            reference_image_path=snakemake.output.reference_image,
            unstable_path=snakemake.output.unstable_terrain,
            terrain_path=snakemake.output.terrain,
            terrain_modern_path=snakemake.output.terrain_modern,
            scenery_path=snakemake.output.scenery,
            truth_path=snakemake.output.truth,
            scenes_path=snakemake.output.scenes,
            pairs_path=snakemake.output.pairs,
            config_path=snakemake.output.config,
            threads=snakemake.threads,
        )
