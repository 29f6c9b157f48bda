"""A strip of a film matched by few large map tiles, for matchers that look for features of their own."""

from __future__ import annotations

import math

from cosp.arrays import FloatArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.imaging.windows import strip_of
from cosp.matching.ground import GroundMatches, PlacedFilm, film_lattice
from cosp.matching.matchers import Matcher

# Neighbouring tiles overlap by a fifth: north-up rectangles on a strip that lies aslant.
_STEP_SHARE = 0.8


def wide_tiles(camera: PanoramicCamera, length_mm: float, width_mm: float, *, most: int) -> FloatArray:
    """Film points (N, 2), in order along the film, about which tiles of a length and a width cover it.

    Where that would take more than `most`, so many are spread evenly over it: control has to be everywhere, not dense.
    """
    halves, sides = (camera.half_length_mm, camera.half_width_mm), (length_mm, width_mm)
    columns, rows = (max(1, round(2 * h / (_STEP_SHARE * side))) for h, side in zip(halves, sides, strict=True))
    if columns * rows > most:
        rows = min(max(1, round(rows * math.sqrt(most / (columns * rows)))), most)
        columns = most // rows
    return film_lattice(camera.half_length_mm, camera.half_width_mm, columns, rows)


def match_wide_strip(
    placed: PlacedFilm, scatteritem: str, *, matcher: Matcher, tile_px: tuple[int, int], max_tiles: int, threads: int
) -> GroundMatches:
    """Matches of a strip of a placed film.

    Parameters
    ----------
    placed : PlacedFilm
    scatteritem : str
        Which strip of how many, such as "3-of-16"; there may be fewer tiles than strips.
    matcher : Matcher
    tile_px : (rows, columns)
        Of a tile on the map, whose columns run about along the film.
    max_tiles : int
        Of the whole film.
    threads : int
    """
    rows, columns = tile_px
    tiles_mm = wide_tiles(placed.camera, placed.on_film_mm(columns), placed.on_film_mm(rows), most=max_tiles)
    first, last = strip_of(len(tiles_mm), scatteritem)
    # Such a matcher looks for points of its own: the one that is asked for is the middle.
    return placed.match(
        tiles_mm[first:last],
        matcher=matcher,
        tile_px=tile_px,
        step_px=max(tile_px),
        margin_px=min(tile_px) // 2 - 1,
        threads=threads,
    )
