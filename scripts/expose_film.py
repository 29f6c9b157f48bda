"""Expose one film over a simulated site and digitise it: terrain in, four parts and the film's truth out."""

from contextlib import ExitStack

from cosp.geometry.grids import PixelGrid
from cosp.io import rasters, records
from cosp.io.logs import log_to
from cosp.simulation import exposure
from cosp.simulation.defects import make_film
from cosp.simulation.site import SiteSettings, plan_site
from cosp.simulation.terrain import Scenery
from cosp.simulation.truth import scene_truth


def expose_film(scene, site_truth_path, terrain_path, scenery_path, part_paths, truth_path, threads):
    plan = plan_site(SiteSettings(**records.read_json(site_truth_path)["settings"]))
    planned = plan.scene(scene)
    scenery = Scenery(rasters.read(scenery_path, 1), rasters.read(scenery_path, 2))
    ground = exposure.Ground.of(rasters.read(terrain_path), scenery, plan.terrain_grid, plan.crs)
    with ExitStack() as stack:
        # A digitised part arrives without georeference: its grid is that of its own pixels.
        writers = {
            part.letter: stack.enter_context(
                rasters.create(
                    path, shape=part.shape, dtype="uint8", grid=PixelGrid(0.5, 0.5, 1.0, 1.0, part.shape), crs=None
                )
            )
            for path, part in zip(part_paths, make_film(plan.settings, planned).parts, strict=True)
        }
        for part, window, grey in exposure.expose_film(plan, planned, ground, threads=threads):
            writers[part.letter].write(window, grey)
    records.write(truth_path, scene_truth(plan, planned))


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        expose_film(
            scene=snakemake.wildcards.scene,
            site_truth_path=snakemake.input.truth,
            terrain_path=snakemake.input.terrain,
            scenery_path=snakemake.input.scenery,
            part_paths=list(snakemake.output.parts),
            truth_path=snakemake.output.truth,
            threads=snakemake.threads,
        )
