"""Whether the reference image lies where the reference DEM says: the one against the shaded relief of the other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pyproj import Transformer

from cosp.arrays import FloatArray, IntArray
from cosp.camera.panoramic import PanoramicCamera
from cosp.geometry.grids import PixelGrid
from cosp.geometry.robust import geman_mcclure_weights
from cosp.matching.ground import OnGrid, film_lattice, in_threads, lattice_rc, tile_about
from cosp.matching.matchers import structural
from cosp.matching.relief import hillshade

# Suns that the image may have been taken under; the opposite ones show the same structure.
_AZIMUTHS_DEG = (0.0, 45.0, 90.0, 135.0)
_POINTS_A_SIDE = 3
# Tiles along and across the film.
_TILES = (24, 2)
# Relief explains only part of an image: scores are low, and it is the agreement of many that counts.
_TEMPLATE_PX, _MIN_SCORE, _MAX_RATIO, _MAX_RETURN_PX = 65, 0.2, 0.95, 1.5
# Places tried with every sun, before the rest is matched with the one that fits.
_TRIAL_PLACES = 12
_LEAST_TILES = 8
# Of all matches, within three postings of the shift: chance puts fewer there.
_LEAST_SHARE = 0.4
# Shading is not relief: below this part of the posting a shift says nothing.
_FLOOR_PX = 0.25
_SIGNIFICANCE = 4.0
# Light is not quite relief, and cover goes with aspect: of what disturbs a single match, this part is common to all.
_COMMON = 0.25


@dataclass(frozen=True)
class ReferenceShift:
    """How far a reference image lies off the reference DEM.

    Parameters
    ----------
    east_m, north_m : float
        What must be added to a place in the image to reach the same place in the DEM; NaN where it is not known.
    sigma_m : float
        Standard deviation of either, from the spread between tiles and what all of them may have in common.
    spread_m : float
        Of single matches about the shift, per coordinate.
    matches, tiles : int
        That agree.
    posting_m : float
        That was matched at.
    significant : bool
        Whether it is more than chance, and more than shading explains.
    """

    east_m: float
    north_m: float
    sigma_m: float
    spread_m: float
    matches: int
    tiles: int
    posting_m: float
    significant: bool


def reference_shift(
    image_on: OnGrid,
    heights_on: OnGrid,
    places_m: FloatArray,
    *,
    posting_m: float,
    search_m: float,
    threads: int,
) -> ReferenceShift:
    """Shift of a reference image against the DEM: the mode of matches of tiles, and whether it is significant.

    Parameters
    ----------
    image_on, heights_on : functions of a PixelGrid
    places_m : (N, 2) array
        Easting and northing of the tiles.
    posting_m : float
        The coarser of image and DEM.
    search_m : float
        Largest shift looked for, in each direction.
    threads : int
    """
    search_px = max(2, math.ceil(search_m / posting_m))
    matcher = structural(_TEMPLATE_PX, search_px, _MIN_SCORE, _MAX_RATIO, _MAX_RETURN_PX)
    half = matcher.template_px // 2
    margin = half + matcher.search_px
    side = 2 * margin + (_POINTS_A_SIDE - 1) * half + 2
    points = lattice_rc((side, side), half, margin)

    def matched(place: FloatArray, azimuth_deg: float) -> FloatArray:
        grid: PixelGrid = tile_about(place[0], place[1], posting_m, side)
        image = image_on(grid)
        heights = heights_on(grid.window(-1, side + 1, -1, side + 1))
        relief = hillshade(heights, posting_m, azimuth_deg)[1:-1, 1:-1]
        found = matcher.match(image, relief, points, threads=1)
        off = found.fixed_rc - found.moving_rc
        return np.column_stack([off[:, 1] * posting_m, -off[:, 0] * posting_m])

    def total(azimuth_deg: float) -> int:
        step = max(1, len(places_m) // _TRIAL_PLACES)
        return sum(map(len, in_threads(lambda place: matched(place, azimuth_deg), list(places_m[::step]), threads)))

    azimuth = max(_AZIMUTHS_DEG, key=total)
    found = in_threads(lambda place: matched(place, azimuth), list(places_m), threads)
    shifts = np.concatenate([np.empty((0, 2)), *found])
    tile = np.repeat(np.arange(len(found)), [len(part) for part in found])
    return robust_shift(shifts, tile, posting_m)


def places_of(camera: PanoramicCamera, crs: str) -> FloatArray:
    """Easting and northing (N, 2) of places spread over what a film shows."""
    to_map = Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    # On the ellipsoid: a tile is many times larger than what the height displaces it by.
    lonlat = camera.locate_geodetic(film_lattice(camera.half_length_mm, camera.half_width_mm, *_TILES), 0.0)
    return np.stack(to_map.transform(lonlat[:, 0], lonlat[:, 1]), axis=-1)


def robust_shift(shifts_m: FloatArray, tile: IntArray, posting_m: float) -> ReferenceShift:
    """The shift that most matches agree on, with its standard deviation from the spread between tiles.

    Parameters
    ----------
    shifts_m : (N, 2) array
        East and north of each match.
    tile : (N,) array
        Which tile it is of: matches of one tile share what disturbs them.
    posting_m : float
    """
    count = len(np.unique(tile))
    nan = math.nan
    unknown = ReferenceShift(nan, nan, nan, nan, len(shifts_m), count, posting_m, False)
    if count < _LEAST_TILES:
        return unknown
    distance = np.linalg.norm(shifts_m[:, None] - shifts_m[None], axis=2)
    centre = shifts_m[np.argmax((distance < posting_m).sum(axis=1))]
    for _ in range(20):
        residual = np.linalg.norm(shifts_m - centre, axis=1)
        weights = geman_mcclure_weights(residual / posting_m, 4.0)
        centre = weights @ shifts_m / weights.sum()
    near = np.linalg.norm(shifts_m - centre, axis=1) < 3 * posting_m
    tiles = np.unique(tile[near])
    if len(tiles) < _LEAST_TILES or near.mean() < _LEAST_SHARE:
        return unknown
    of_tiles = np.array([np.median(shifts_m[near & (tile == t)], axis=0) for t in tiles])
    spread = 1.4826 * float(np.median(np.abs(shifts_m[near] - centre)))
    between = 1.4826 * float(np.median(np.abs(of_tiles - np.median(of_tiles, axis=0))))
    sigma = math.hypot(1.25 * between / math.sqrt(len(tiles)), _COMMON * spread)  # 1.25: of a median
    length = float(np.hypot(*centre))
    significant = length > max(_SIGNIFICANCE * sigma, _FLOOR_PX * posting_m)
    return ReferenceShift(
        float(centre[0]), float(centre[1]), sigma, spread, int(near.sum()), len(tiles), posting_m, bool(significant)
    )
