"""A strip of a film matched by few large map tiles, for matchers that look for features of their own."""

from __future__ import annotations

import logging

from cosp.arrays import FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.imaging.windows import strip_of
from cosp.matching.film_image import FilmImage
from cosp.matching.ground import (
    GroundMatches,
    OnGrid,
    Terrain,
    film_lattice,
    ground_pixel_m,
    grown,
    map_bounds,
    match_film_to_ground,
    reduction_for,
)
from cosp.matching.matchers import Matcher

log = logging.getLogger(__name__)

_TERRAIN_POSTING_M = 200.0
# Neighbouring tiles overlap by a fifth: north-up squares on a strip that lies aslant.
_STEP_SHARE = 0.8


def wide_tiles(camera: PanoramicCamera, tile_mm: float) -> FloatArray:
    """Film points (N, 2), in order along the film, about which square tiles of a side cover it."""
    step = _STEP_SHARE * tile_mm
    columns, rows = (max(1, round(2 * half / step)) for half in (camera.half_length_mm, camera.half_width_mm))
    return film_lattice(camera.half_length_mm, camera.half_width_mm, columns, rows)


def match_wide_strip(
    film: FilmImage,
    camera: PanoramicCamera,
    scatteritem: str,
    *,
    reference_on: OnGrid,
    heights_on: OnGrid,
    crs: str,
    matcher: Matcher,
    reference_posting_m: float,
    tile_px: int,
    threads: int,
) -> tuple[GroundMatches, float, float]:
    """Matches of a strip of a placed film, at the coarser of film and reference, as `match_strip` gives them.

    Parameters
    ----------
    film : FilmImage
        At full resolution; only the strip is read.
    camera : PanoramicCamera
        Good to a few pixels.
    scatteritem : str
        Which strip of how many, such as "3-of-16".
    tile_px : int
        Side of a tile.

    Returns
    -------
    matches : GroundMatches
    posting_m, pixel_m : float
        What was matched at, and the side of a film pixel on the ground.
    """
    terrain = Terrain.on(heights_on, grown(map_bounds(camera, crs), 2000.0), crs, _TERRAIN_POSTING_M)
    pixel_m = ground_pixel_m(camera, film.pixel_mm, terrain.mean_m)
    posting_m = max(reference_posting_m, pixel_m)
    tile_mm = tile_px * posting_m / pixel_m * film.pixel_mm
    tiles_mm = wide_tiles(camera, tile_mm)
    first, last = strip_of(len(tiles_mm), scatteritem)
    if first == last:  # fewer tiles than strips
        return GroundMatches.joined([]), posting_m, pixel_m
    tiles_mm = tiles_mm[first:last]
    # Half a tile and the slant of a map square on the film.
    part = film.part(float(tiles_mm[:, 0].min()) - tile_mm, float(tiles_mm[:, 0].max()) + tile_mm)
    matches = match_film_to_ground(
        part.reduced(reduction_for(posting_m, pixel_m)),
        camera,
        tiles_mm,
        reference_on=reference_on,
        heights_on=heights_on,
        terrain=terrain,
        matcher=matcher,
        posting_m=posting_m,
        tile_px=tile_px,
        step_px=tile_px,
        margin_px=tile_px // 2,
        threads=threads,
    )
    log.info("%d matches in %d tiles of %d px at %.1f m", len(matches), len(tiles_mm), tile_px, posting_m)
    return matches, posting_m, pixel_m
