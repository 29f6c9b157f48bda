"""Tie points: the same ground in a fore and an aft film, matched on the map and brought back to both films."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosp.arrays import BoolArray, FloatArray
from cosp.camera.mapping import MapProjector
from cosp.camera.panoramic import PanoramicCamera
from cosp.errors import NoOverlapError
from cosp.matching.control import require
from cosp.matching.film_image import FilmImage
from cosp.matching.filtering import consistent_by_tile
from cosp.matching.ground import (
    OnGrid,
    Terrain,
    film_coordinates,
    film_lattice,
    film_points_at,
    ground_pixel_m,
    grown,
    in_threads,
    lattice_rc,
    map_bounds,
    reduction_for,
    tile_about,
)
from cosp.matching.matchers import Matcher

log = logging.getLogger(__name__)

# The first pass is so many times coarser than the films; it finds what placement and film leave between them.
_COARSE = 4
_TERRAIN_POSTING_M = 200.0
# Terms of the smooth offset between the films: x^i y^j up to these degrees.
_DEGREE_X, _DEGREE_Y = 4, 1
_MIN_FOR_OFFSET = 40
# Candidates along either side of a map tile.
_TILE_SIDE = 4
# Cells of the film, along and across, by which coverage is told.
_CELLS = (30, 4)
# However high the score: terrain that the DEM does not hold shows differently in two films taken 30 degrees apart.
_LEAST_SIGMA_PX = 0.3


@dataclass(frozen=True)
class FilmMatches:
    """The same ground points in two films.

    Parameters
    ----------
    fore_mm, aft_mm, predicted_aft_mm : (N, 2) arrays
        Film points, and where the aft film would show the fore point by both cameras.
    score, sigma_px : (N,) arrays
        Standard deviation per coordinate in pixels of the matched images.
    """

    fore_mm: FloatArray
    aft_mm: FloatArray
    predicted_aft_mm: FloatArray
    score: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        return len(self.score)

    def subset(self, keep: BoolArray) -> FilmMatches:
        """Those matches that are chosen by a mask."""
        return FilmMatches(
            self.fore_mm[keep], self.aft_mm[keep], self.predicted_aft_mm[keep], self.score[keep], self.sigma_px[keep]
        )


def match_films(
    fore: FilmImage,
    aft: FilmImage,
    fore_camera: PanoramicCamera,
    aft_camera: PanoramicCamera,
    *,
    heights_on: OnGrid,
    crs: str,
    matcher: Matcher,
    candidates: int,
    template_px: int,
    search_px: int,
    gate_px: float,
    tile_mm: float,
    min_per_tile: int,
    min_ties: int,
    trials: int,
    rng: np.random.Generator,
    threads: int,
) -> FilmMatches:
    """Tie points of a pair, spread over the overlap, gross errors removed tile by tile.

    Parameters
    ----------
    fore, aft : FilmImage
        At full resolution; only the tiles that are matched are read.
    heights_on : function of a PixelGrid
        Ellipsoidal heights, NaN outside.
    candidates : int
        Points that are tried.
    gate_px, tile_mm, min_per_tile, trials
        See `consistent_by_tile`; the gate in film pixels.

    Raises
    ------
    NoOverlapError
        If the films show no common ground.
    NotEnoughMatchesError
        If fewer than `min_ties` remain.
    """
    shared = _shared_bounds(map_bounds(fore_camera, crs), map_bounds(aft_camera, crs))
    if shared is None:
        raise NoOverlapError(f"{fore_camera.scene} and {aft_camera.scene} show no common ground")
    pixel_m = max(ground_pixel_m(c, f.pixel_mm, 0.0) for c, f in ((fore_camera, fore), (aft_camera, aft)))
    terrain = Terrain.on(heights_on, grown(shared, 5000.0), crs, _TERRAIN_POSTING_M)
    step_px = max(template_px // 2, 12)
    margin_px = template_px // 2 + search_px
    tile_px = template_px + 2 * search_px + (_TILE_SIDE - 1) * step_px + 4

    area = grown(terrain.grid.bounds, 0.6 * tile_px * _COARSE * pixel_m)
    projectors = [MapProjector(camera, crs, area) for camera in (fore_camera, aft_camera)]

    share = float(_seen_by(aft_camera, fore_camera, _tile_points(fore_camera, 1000), terrain.mean_m).mean())

    def pass_at(posting_m: float, offset: Callable[[FloatArray], FloatArray], count: int) -> FilmMatches:
        # Templates that overlap by more than half say little more.
        most = share * _area_mm2(fore_camera) / (step_px * posting_m / pixel_m * fore.pixel_mm) ** 2
        tiles = max(1, int(min(count, most)) // _TILE_SIDE**2)
        points_mm = _tile_points(fore_camera, max(1, round(tiles / max(share, 1e-3))))
        points_mm = points_mm[_seen_by(aft_camera, fore_camera, points_mm, terrain.mean_m)]
        factors = [reduction_for(posting_m, ground_pixel_m(c, f.pixel_mm, terrain.mean_m)) for c, f in
                   ((fore_camera, fore), (aft_camera, aft))]  # fmt: skip
        films = [film.reduced(n) if n > 1 else film.buffered() for film, n in zip((fore, aft), factors, strict=True)]
        places = terrain.map_points(fore_camera, points_mm)
        places = places[np.isfinite(places).all(axis=1)]
        inside = (places[:, 0] > shared[0]) & (places[:, 0] < shared[2]) & (places[:, 1] > shared[1])
        places = places[inside & (places[:, 1] < shared[3])]

        def work(place: FloatArray) -> list[FloatArray]:
            grid = tile_about(place[0], place[1], posting_m, tile_px)
            heights = heights_on(grid)
            fore_mm, aft_mm = (film_coordinates(projector, grid, heights) for projector in projectors)
            # The offset changes so slowly that one value does for a tile.
            middle = projectors[1].film(place[None, 0], place[None, 1], place[None, 2])
            moved = offset(middle)
            seen = films[0].sample(fore_mm), films[1].sample(aft_mm + moved)
            if not (np.isfinite(seen[0]).any() and np.isfinite(seen[1]).any()):
                return []
            found = matcher.match(*seen, lattice_rc(grid.shape, step_px, margin_px), threads=1)
            if not len(found):
                return []
            fore_points = film_points_at(projectors[0], grid, heights, found.moving_rc)
            aft_points = film_points_at(projectors[1], grid, heights, found.fixed_rc)
            predicted = film_points_at(projectors[1], grid, heights, found.moving_rc)
            sigma_px = np.maximum(found.sigma_px, _LEAST_SIGMA_PX)
            rows = np.column_stack([fore_points, aft_points + moved, predicted, found.score, sigma_px])
            return [rows[np.isfinite(rows).all(axis=1)]]

        table = np.concatenate([np.empty((0, 8)), *sum(in_threads(work, list(places), threads), [])])
        matches = FilmMatches(table[:, 0:2], table[:, 2:4], table[:, 4:6], table[:, 6], table[:, 7])
        gate_mm = gate_px * posting_m / pixel_m * max(fore.pixel_mm, aft.pixel_mm)
        keep = consistent_by_tile(
            matches.predicted_aft_mm, matches.aft_mm,
            tile_mm=tile_mm, gate_mm=gate_mm, minimum=min_per_tile, trials=trials, rng=rng,
        )  # fmt: skip
        log.info("%d of %d matches agree with their neighbours at %.1f m", keep.sum(), len(matches), posting_m)
        return matches.subset(keep)

    coarse = pass_at(_COARSE * pixel_m, lambda film_mm: np.zeros_like(film_mm), candidates // _COARSE)
    ties = pass_at(pixel_m, _smooth_offset(coarse, aft_camera), candidates)
    require(len(ties), min_ties, f"{fore_camera.scene} and {aft_camera.scene}", "tie points")
    return ties


def _area_mm2(camera: PanoramicCamera) -> float:
    return 4 * camera.half_length_mm * camera.half_width_mm


def _seen_by(other: PanoramicCamera, camera: PanoramicCamera, film_mm: FloatArray, height_m: float) -> BoolArray:
    """Which film points show ground that another film shows too."""
    seen = np.abs(other.project_geodetic(camera.locate_geodetic(film_mm, height_m)))
    with np.errstate(invalid="ignore"):
        return np.asarray((seen <= [other.half_length_mm, other.half_width_mm]).all(axis=-1))


def summary(
    ties: FilmMatches, fore_camera: PanoramicCamera, aft_camera: PanoramicCamera, *, height_m: float
) -> dict[str, Any]:
    """Count, precision and spread of tie points.

    Coverage is the share of equal cells of the fore film that hold a tie point, of those whose middle both films show
    on ground of about the height given.
    """
    columns, rows = _CELLS
    half = np.array([fore_camera.half_length_mm, fore_camera.half_width_mm])
    middles = film_lattice(half[0], half[1], columns, rows)
    shared = _seen_by(aft_camera, fore_camera, middles, height_m).reshape(columns, rows)
    index = np.clip(((ties.fore_mm / half + 1) / 2 * _CELLS).astype(int), 0, np.array(_CELLS) - 1)
    counts = np.zeros(_CELLS, int)
    np.add.at(counts, (index[:, 0], index[:, 1]), 1)
    filled = (counts > 0) & shared
    return {
        "count": len(ties),
        "sigma_px": float(np.median(ties.sigma_px)) if len(ties) else None,
        "score": float(np.median(ties.score)) if len(ties) else None,
        "cells_shared": int(shared.sum()),
        "coverage": float(filled.sum() / max(shared.sum(), 1)),
        "coverage_along": float(filled.any(axis=1).sum() / max(shared.any(axis=1).sum(), 1)),
        "coverage_across": float(filled.any(axis=0).sum() / max(shared.any(axis=0).sum(), 1)),
        "counts_along": counts.sum(axis=1).tolist(),
    }


def _tile_points(camera: PanoramicCamera, count: int) -> FloatArray:
    """About `count` film points, evenly spread."""
    rows = max(1, round((count * camera.half_width_mm / camera.half_length_mm) ** 0.5))
    return film_lattice(camera.half_length_mm, camera.half_width_mm, max(1, round(count / rows)), rows)


def _smooth_offset(matches: FilmMatches, camera: PanoramicCamera) -> Callable[[FloatArray], FloatArray]:
    """Aft film point minus its prediction, as a smooth function of the aft film point."""
    scale = np.array([camera.half_length_mm, camera.half_width_mm])

    def terms(film_mm: FloatArray) -> FloatArray:
        x, y = np.moveaxis(np.asarray(film_mm, float) / scale, -1, 0)
        return np.stack([x**i * y**j for i in range(_DEGREE_X + 1) for j in range(_DEGREE_Y + 1)], axis=-1)

    if len(matches) < _MIN_FOR_OFFSET:
        return lambda film_mm: np.zeros_like(film_mm)
    change = matches.aft_mm - matches.predicted_aft_mm
    solution = np.linalg.lstsq(terms(matches.predicted_aft_mm), change, rcond=None)[0]
    return lambda film_mm: np.asarray(terms(film_mm) @ solution)


def _shared_bounds(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float]
) -> tuple[float, float, float, float] | None:
    west, south, east, north = max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])
    return (west, south, east, north) if west < east and south < north else None
