"""A strip of a film matched by few large map tiles, for matchers that look for features of their own."""

from __future__ import annotations

from cosp.arrays import FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.imaging.windows import strip_of
from cosp.matching.ground import GroundMatches, PlacedFilm, film_lattice
from cosp.matching.matchers import Matcher

# Neighbouring tiles overlap by a fifth: north-up squares on a strip that lies aslant.
_STEP_SHARE = 0.8


def wide_tiles(camera: PanoramicCamera, tile_mm: float) -> FloatArray:
    """Film points (N, 2), in order along the film, about which square tiles of a side cover it."""
    step = _STEP_SHARE * tile_mm
    columns, rows = (max(1, round(2 * half / step)) for half in (camera.half_length_mm, camera.half_width_mm))
    return film_lattice(camera.half_length_mm, camera.half_width_mm, columns, rows)


def match_wide_strip(
    placed: PlacedFilm, scatteritem: str, *, matcher: Matcher, tile_px: int, threads: int
) -> GroundMatches:
    """Matches of a strip of a placed film.

    Parameters
    ----------
    placed : PlacedFilm
    scatteritem : str
        Which strip of how many, such as "3-of-16"; there may be fewer tiles than strips.
    matcher : Matcher
    tile_px : int
        Side of a tile.
    threads : int
    """
    tiles_mm = wide_tiles(placed.camera, placed.on_film_mm(tile_px))
    first, last = strip_of(len(tiles_mm), scatteritem)
    return placed.match(
        tiles_mm[first:last],
        matcher=matcher,
        tile_px=tile_px,
        step_px=tile_px,
        margin_px=tile_px // 2,
        threads=threads,
    )
