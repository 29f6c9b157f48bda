"""Tie points: the same ground in two films, fore and aft or neighbours, matched on the map and brought back to both."""

from __future__ import annotations

import logging
import math
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
# Templates take up to this share of the breadth of what both films show; smaller ones than this are not unique.
_TEMPLATE_SHARE = 0.6
_LEAST_TEMPLATE_PX = 15
# A level may search so many times farther than usual before a coarser one is worth its while.
_WIDE_SEARCH = 3
_WIDEST_SEARCH_PX = 100
# Cells in which the shared piece of two films is found.
_FINE_CELLS = (150, 60)
# Candidates along either side of a map tile.
_TILE_SIDE = 4
# Cells of the film, along and across, by which coverage is told.
_CELLS = (30, 4)
_PER_CELL, _SHARE_OF_CELL = 5, 0.2
# However high the score: terrain that the DEM does not hold shows differently in two films taken 30 degrees apart.
_LEAST_SIGMA_PX = 0.3


@dataclass(frozen=True)
class FilmMatches:
    """The same ground points in two films.

    Parameters
    ----------
    first_mm, second_mm, predicted_mm : (N, 2) arrays
        Film points, and where the second film would show the first point by both cameras.
    score, sigma_px : (N,) arrays
        Standard deviation per coordinate in pixels of the matched images.
    """

    first_mm: FloatArray
    second_mm: FloatArray
    predicted_mm: FloatArray
    score: FloatArray
    sigma_px: FloatArray

    @classmethod
    def none(cls) -> FilmMatches:
        """Without any match."""
        return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty(0))

    def __len__(self) -> int:
        return len(self.score)

    def subset(self, keep: BoolArray) -> FilmMatches:
        """Those matches that are chosen by a mask."""
        return FilmMatches(
            self.first_mm[keep], self.second_mm[keep], self.predicted_mm[keep], self.score[keep], self.sigma_px[keep]
        )


def match_films(
    first: FilmImage,
    second: FilmImage,
    first_camera: PanoramicCamera,
    second_camera: PanoramicCamera,
    *,
    heights_on: OnGrid,
    crs: str,
    matcher_of: Callable[[int, int], Matcher],
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
    offset_m: float = 0.0,
) -> FilmMatches:
    """Tie points of two films, spread over what both show, gross errors removed tile by tile.

    Parameters
    ----------
    first, second : FilmImage
        At full resolution; only the tiles that are matched are read.
    heights_on : function of a PixelGrid
        Ellipsoidal heights, NaN outside.
    matcher_of : function
        Matcher with a template and a search range in pixels.
    candidates : int
        Points that are tried.
    template_px, search_px : int
        Templates are smaller where both films show a narrow strip only.
    gate_px, tile_mm, min_per_tile, trials
        See `consistent_by_tile`; the gate in film pixels.
    offset_m : float
        How far the frames may be misplaced against each other; the search begins wide enough for that.

    Raises
    ------
    NoOverlapError
        If the films show no common ground.
    NotEnoughMatchesError
        If fewer than `min_ties` remain.
    """
    scenes = f"{first_camera.scene} and {second_camera.scene}"
    bounds = _shared_bounds(map_bounds(first_camera, crs), map_bounds(second_camera, crs))
    if bounds is None:
        raise NoOverlapError(f"{scenes} show no common ground")
    pixel_m = max(ground_pixel_m(c, f.pixel_mm, 0.0) for c, f in ((first_camera, first), (second_camera, second)))
    terrain = Terrain.on(heights_on, grown(bounds, 5000.0 + offset_m), crs, _TERRAIN_POSTING_M)
    shared = _Shared.of(first_camera, second_camera, terrain.mean_m)
    if shared is None:
        raise NoOverlapError(f"{scenes} show no common ground")
    passes = _passes(shared.breadth_mm / first.pixel_mm, offset_m / pixel_m, template_px, search_px)
    reach_px = max(_tile_px(size, search) * factor for factor, size, search in passes)
    projectors = [
        MapProjector(camera, crs, grown(terrain.grid.bounds, 0.6 * reach_px * pixel_m))
        for camera in (first_camera, second_camera)
    ]

    def pass_at(
        factor: int, size_px: int, range_px: int, offset: Callable[[FloatArray], FloatArray], count: int
    ) -> FilmMatches:
        posting_m = factor * pixel_m
        matcher = matcher_of(size_px, range_px)
        step_px = _step_px(size_px)
        # Templates that overlap by more than half say little more.
        most = shared.area_mm2 / (step_px * factor * first.pixel_mm) ** 2
        points_mm = shared.points(first_camera, second_camera, max(1, int(min(count, most)) // _TILE_SIDE**2))
        factors = [reduction_for(posting_m, ground_pixel_m(c, f.pixel_mm, terrain.mean_m)) for c, f in
                   ((first_camera, first), (second_camera, second))]  # fmt: skip
        films = [
            film.reduced(n) if n > 1 else film.buffered() for film, n in zip((first, second), factors, strict=True)
        ]
        places = terrain.map_points(first_camera, points_mm)
        places = places[np.isfinite(places).all(axis=1)]
        inside = (places[:, 0] > bounds[0]) & (places[:, 0] < bounds[2]) & (places[:, 1] > bounds[1])
        places = places[inside & (places[:, 1] < bounds[3])]

        def work(place: FloatArray) -> list[FloatArray]:
            grid = tile_about(place[0], place[1], posting_m, _tile_px(size_px, range_px))
            heights = heights_on(grid)
            first_mm, second_mm = (film_coordinates(projector, grid, heights) for projector in projectors)
            # The offset changes so slowly that one value does for a tile.
            middle = projectors[1].film(place[None, 0], place[None, 1], place[None, 2])
            moved = offset(middle)
            seen = films[0].sample(first_mm), films[1].sample(second_mm + moved)
            if not (np.isfinite(seen[0]).any() and np.isfinite(seen[1]).any()):
                return []
            found = matcher.match(*seen, lattice_rc(grid.shape, step_px, size_px // 2 + range_px), threads=1)
            if not len(found):
                return []
            first_points = film_points_at(projectors[0], grid, heights, found.moving_rc)
            second_points = film_points_at(projectors[1], grid, heights, found.fixed_rc)
            predicted = film_points_at(projectors[1], grid, heights, found.moving_rc)
            sigma_px = np.maximum(found.sigma_px, _LEAST_SIGMA_PX)
            rows = np.column_stack([first_points, second_points + moved, predicted, found.score, sigma_px])
            return [rows[np.isfinite(rows).all(axis=1)]]

        table = np.concatenate([np.empty((0, 8)), *sum(in_threads(work, list(places), threads), [])])
        matches = FilmMatches(table[:, 0:2], table[:, 2:4], table[:, 4:6], table[:, 6], table[:, 7])
        gate_mm = gate_px * factor * max(first.pixel_mm, second.pixel_mm)
        keep = consistent_by_tile(
            matches.predicted_mm, matches.second_mm,
            tile_mm=tile_mm, gate_mm=gate_mm, minimum=min_per_tile, trials=trials, rng=rng,
        )  # fmt: skip
        log.info("%d of %d matches agree with their neighbours at %.1f m", keep.sum(), len(matches), posting_m)
        return matches.subset(keep)

    ties = FilmMatches.none()
    for factor, size_px, range_px in passes:
        ties = pass_at(factor, size_px, range_px, _smooth_offset(ties, second_camera), candidates // factor)
    require(len(ties), min_ties, scenes, "tie points")
    return ties


def _passes(breadth_px: float, offset_px: float, template_px: int, search_px: int) -> list[tuple[int, int, int]]:
    """From coarse to fine: reduction, template and search range in reduced pixels.

    Where the films share a narrow strip, templates shrink, down to `_LEAST_TEMPLATE_PX`, and a level whose templates
    would not fit is left out. The coarsest level searches as far as the frames may be misplaced.
    """

    def fitting(factor: int) -> int:
        return int(min(template_px, _TEMPLATE_SHARE * breadth_px / factor))

    factors = [1]
    while fitting(_COARSE * factors[0]) >= _LEAST_TEMPLATE_PX and (
        factors[0] == 1 or offset_px > _WIDE_SEARCH * search_px * factors[0]
    ):
        factors.insert(0, _COARSE * factors[0])
    first_range = min(max(search_px, math.ceil(offset_px / factors[0])), _WIDEST_SEARCH_PX)
    return [
        (factor, max(fitting(factor), _LEAST_TEMPLATE_PX), first_range if n == 0 else search_px)
        for n, factor in enumerate(factors)
    ]


def _step_px(template_px: int) -> int:
    """Distance of candidates."""
    return max(template_px // 2, 12)


def _tile_px(template_px: int, search_px: int) -> int:
    """Side of a map tile that holds its candidates and all they may look at."""
    return template_px + 2 * search_px + (_TILE_SIDE - 1) * _step_px(template_px) + 4


@dataclass(frozen=True)
class _Shared:
    """The piece of the first film that shows ground which the second shows too.

    Parameters
    ----------
    middle_mm, half_mm : two floats
        The rectangle about it.
    share : float
        Of the rectangle.
    breadth_mm : float
        Median extent across the film.
    height_m : float
        Of the ground.
    """

    middle_mm: tuple[float, float]
    half_mm: tuple[float, float]
    share: float
    breadth_mm: float
    height_m: float

    @classmethod
    def of(cls, camera: PanoramicCamera, other: PanoramicCamera, height_m: float) -> _Shared | None:
        """None where nothing is shared."""
        columns, rows = _FINE_CELLS
        lattice = film_lattice(camera.half_length_mm, camera.half_width_mm, columns, rows)
        seen = _seen_by(other, camera, lattice, height_m)
        if not seen.any():
            return None
        cell = np.array([2 * camera.half_length_mm / columns, 2 * camera.half_width_mm / rows])
        low, high = lattice[seen].min(axis=0) - cell / 2, lattice[seen].max(axis=0) + cell / 2
        inside = ((lattice > low) & (lattice < high)).all(axis=1)
        across = seen.reshape(columns, rows).sum(axis=1) * cell[1]
        (x, y), (half_x, half_y) = (low + high) / 2, (high - low) / 2
        return cls(
            (float(x), float(y)),
            (float(half_x), float(half_y)),
            float(seen.sum() / inside.sum()),
            float(np.median(across[across > 0])),
            height_m,
        )

    @property
    def area_mm2(self) -> float:
        """Of the piece itself."""
        return 4 * self.half_mm[0] * self.half_mm[1] * self.share

    def points(self, camera: PanoramicCamera, other: PanoramicCamera, count: int) -> FloatArray:
        """About `count` film points of the piece, evenly spread."""
        whole = count / self.share
        rows = max(1, round((whole * self.half_mm[1] / self.half_mm[0]) ** 0.5))
        points = film_lattice(*self.half_mm, max(1, round(whole / rows)), rows) + np.array(self.middle_mm)
        return np.asarray(points[_seen_by(other, camera, points, self.height_m)])


def _seen_by(other: PanoramicCamera, camera: PanoramicCamera, film_mm: FloatArray, height_m: float) -> BoolArray:
    """Which film points show ground that another film shows too."""
    seen = np.abs(other.project_geodetic(camera.locate_geodetic(film_mm, height_m)))
    with np.errstate(invalid="ignore"):
        return np.asarray((seen <= [other.half_length_mm, other.half_width_mm]).all(axis=-1))


def summary(
    ties: FilmMatches, first_camera: PanoramicCamera, second_camera: PanoramicCamera, *, height_m: float
) -> dict[str, Any]:
    """Count, precision and spread of tie points.

    Coverage is the share of equal cells of the first film that hold a tie point, of those of which both films show a
    fifth or more on ground of about the height given.
    """
    columns, rows = _CELLS
    half = np.array([first_camera.half_length_mm, first_camera.half_width_mm])
    fine = film_lattice(half[0], half[1], columns * _PER_CELL, rows * _PER_CELL)
    seen = _seen_by(second_camera, first_camera, fine, height_m).reshape(columns, _PER_CELL, rows, _PER_CELL)
    shared = seen.mean(axis=(1, 3)) >= _SHARE_OF_CELL
    index = np.clip(((ties.first_mm / half + 1) / 2 * _CELLS).astype(int), 0, np.array(_CELLS) - 1)
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


def _smooth_offset(matches: FilmMatches, camera: PanoramicCamera) -> Callable[[FloatArray], FloatArray]:
    """Second film point minus its prediction, as a smooth function of the second film point."""
    scale = np.array([camera.half_length_mm, camera.half_width_mm])

    def terms(film_mm: FloatArray) -> FloatArray:
        x, y = np.moveaxis(np.asarray(film_mm, float) / scale, -1, 0)
        return np.stack([x**i * y**j for i in range(_DEGREE_X + 1) for j in range(_DEGREE_Y + 1)], axis=-1)

    if len(matches) < _MIN_FOR_OFFSET:
        return lambda film_mm: np.zeros_like(film_mm)
    change = matches.second_mm - matches.predicted_mm
    solution = np.linalg.lstsq(terms(matches.predicted_mm), change, rcond=None)[0]
    return lambda film_mm: np.asarray(terms(film_mm) @ solution)


def _shared_bounds(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float]
) -> tuple[float, float, float, float] | None:
    west, south, east, north = max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])
    return (west, south, east, north) if west < east and south < north else None
