"""Settle where a frame lies, as it was found by itself or with the help of its neighbours, and put its film right."""

import logging
from dataclasses import replace
from datetime import date

import numpy as np

from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import PlacementError
from cosp.io import films, rasters, records, references
from cosp.io.logs import log_to
from cosp.matching.film_image import FilmImage
from cosp.matching.footprint import Attempt
from cosp.matching.ground import Terrain, grown, map_bounds, map_crs
from cosp.matching.neighbours import PlacedFrame, expected_frame
from cosp.matching.placement import SearchLimits, locate_film, shift_m
from cosp.sheets import parse_scene_id


def place_frame(
    placement_path,
    others_paths,
    straight_path,
    straight_summary_path,
    camera_path,
    reference_dem_path,
    reference_image_path,
    footprint_path,
    film_path,
    film_summary_path,
    **search,
):
    attempt = records.read(placement_path, Attempt)
    footprint = attempt.footprint or placed_by_neighbours(
        attempt, others_paths, straight_path, camera_path, reference_dem_path, reference_image_path, **search
    )
    films.put_right(straight_path, film_path, turned=footprint.turned, mirrored=footprint.mirrored)
    records.write(film_summary_path, film_summary(records.read_json(straight_summary_path), footprint))
    records.write(footprint_path, footprint)


def film_summary(straight, footprint):
    """What is said of the film: what its parts told, and how the ground saw it."""
    said = dict(straight)
    if footprint.turned or footprint.mirrored:
        said["found_on_the_ground"] = {"turned": footprint.turned, "mirrored": footprint.mirrored}
        said["turned"] = straight["turned"] != footprint.turned
        said["mirrored"] = [mirrored != footprint.mirrored for mirrored in straight["mirrored"]]
    return said


def placed_by_neighbours(
    attempt,
    others_paths,
    straight_path,
    camera_path,
    reference_dem_path,
    reference_image_path,
    *,
    day,
    reference_dem_heights,
    search_km,
    limits,
    seed,
    threads,
):
    """Footprint of a frame that was refused, found where its neighbours leave room for it, or from them alone."""
    log = logging.getLogger("place_frame")
    camera = records.read(camera_path, PanoramicCamera)
    expected = neighbours_say(camera, [records.read(path, Attempt) for path in others_paths])
    if expected is None:
        raise PlacementError(f"{attempt.refusal}; no other frame of its pass has been placed to say where it must lie")
    window_m = max(3.0 * expected.sigma_m, 10 * limits.coarse_posting_m)
    log.info("%s; %s place it to %.0f m", attempt.refusal, ", ".join(expected.neighbours), expected.sigma_m)
    crs = map_crs(expected.camera)
    heights_on = references.heights_on(reference_dem_path, crs, reference_dem_heights)
    located = locate_film(
        FilmImage(rasters.info(straight_path).grid, lambda window: rasters.read(straight_path, window=window)),
        expected.camera,
        reference_on=references.image_on(reference_image_path, crs) if reference_image_path else None,
        heights_on=heights_on,
        day=date.fromisoformat(day) if day else None,
        crs=crs,
        search_m=window_m,
        limits=limits.in_window(1000.0 * search_km, window_m),
        rng=np.random.default_rng(seed),
        threads=threads,
    )
    height_m = Terrain.on(heights_on, grown(map_bounds(expected.camera, crs), window_m), crs, 1000.0).mean_m
    if located.footprint is None:
        log.warning("%s", located.refusal)
        return expected.footprint(camera, height_m)
    east, north = shift_m(camera, located.footprint.camera, height_m)
    return replace(located.footprint, shift_east_m=east, shift_north_m=north, neighbours=expected.neighbours)


def neighbours_say(camera, attempts):
    """Where the placed frames of a camera's pass leave room for it."""
    own = parse_scene_id(camera.scene)
    placed = []
    for attempt in attempts:
        other = parse_scene_id(attempt.scene)
        if attempt.footprint is not None and (other.flight, other.descending) == (own.flight, own.descending):
            placed.append(PlacedFrame(int(other.frame), other.look, attempt.footprint))
    return expected_frame(camera, int(own.frame), own.look, placed)


if __name__ == "__main__":
    with log_to(snakemake.log[0]):
        place_frame(
            placement_path=snakemake.input.placement,
            others_paths=list(snakemake.input.others),
            straight_path=snakemake.input.film,
            straight_summary_path=snakemake.input.film_summary,
            camera_path=snakemake.input.camera,
            reference_dem_path=snakemake.input.reference_dem,
            reference_image_path=snakemake.input.get("reference_image"),
            footprint_path=snakemake.output.footprint,
            film_path=snakemake.output.film,
            film_summary_path=snakemake.output.film_summary,
            day=snakemake.params.day,
            reference_dem_heights=snakemake.params.reference_dem_heights,
            search_km=snakemake.params.search_km,
            limits=SearchLimits.of(snakemake.params),
            seed=snakemake.params.seed,
            threads=snakemake.threads,
        )
