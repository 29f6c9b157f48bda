"""Which matches to keep: those that agree with their neighbours, spread evenly over the film."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cosp.arrays import BoolArray, FloatArray, IntArray
from cosp.geometry.transforms import estimate_affine, ransac


def consistent_by_tile(
    predicted_mm: FloatArray,
    measured_mm: FloatArray,
    *,
    tile_mm: float,
    gate_mm: float,
    minimum: int,
    trials: int,
    rng: np.random.Generator,
) -> BoolArray:
    """Matches that agree with one affine transformation in their piece of the film.

    Over a tile of about 15 km what the camera and the film leave unexplained is an affine to a fraction of a pixel, so
    that clustered wrong matches show, which a model of the whole film would let pass.

    Parameters
    ----------
    predicted_mm, measured_mm : (N, 2) arrays
        Film points of the ground by the camera, and where they were matched. NaN never agrees.
    tile_mm : float
        About the length of a tile along and across the film.
    gate_mm : float
        Largest distance of a match that agrees.
    minimum : int
        Fewer agreeing matches in a tile are none.
    trials : int
        Of the random search in each tile.
    rng : numpy Generator

    Returns
    -------
    (N,) bool array
    """
    keep = np.zeros(len(measured_mm), bool)
    seen = np.isfinite(np.concatenate([predicted_mm, measured_mm], axis=1)).all(axis=1)
    if not seen.any():
        return keep
    low, high = measured_mm[seen].min(axis=0), measured_mm[seen].max(axis=0)
    columns, rows = (max(1, round(float(length) / tile_mm)) for length in high - low)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-9)
    tile = block_of(np.where(seen[:, None], measured_mm - middle, 0.0), half[0], half[1], columns, rows)
    for value in np.unique(tile[seen], axis=0):
        chosen = np.flatnonzero(seen & np.all(tile == value, axis=1))
        if len(chosen) < minimum:
            continue
        # Residuals against the prediction are small numbers: the gate is not lost in the size of the coordinates.
        _, agreeing = ransac(
            estimate_affine, predicted_mm[chosen], measured_mm[chosen], minimum=3, gate=gate_mm, trials=trials, rng=rng
        )
        if agreeing.sum() >= minimum:
            keep[chosen[agreeing]] = True
    return keep


def agreeing_with_neighbours(
    predicted_mm: FloatArray,
    measured_mm: FloatArray,
    *,
    template_mm: float,
    reach_mm: float,
    gate_mm: float,
    min_places: int,
    min_share: float,
) -> BoolArray:
    """Matches whose shift against the prediction is that of most matches about them.

    For matches so weak that many are wrong, and that come of templates which share most of their pixels: what a
    template got wrong its nearest neighbours got wrong alike, so that these are not asked. A shift has no freedom to
    fit chance, as an affine of a few templates has; between neighbours the error of a placed camera changes by less
    than the gate.

    Parameters
    ----------
    predicted_mm, measured_mm : (N, 2) arrays
        Film points of the ground by the camera, and where they were matched. NaN never agrees.
    template_mm : float
        Side of a template: matches nearer to one another, along and across, are one piece of evidence.
    reach_mm : float
        How far neighbours lie.
    gate_mm : float
        Largest difference of two shifts that agree.
    min_places : int
        Pieces of evidence besides its own that must agree with a match.
    min_share : float
        Least share of the neighbours that must agree.

    Returns
    -------
    (N,) bool array
    """
    keep = np.zeros(len(measured_mm), bool)
    seen = np.flatnonzero(np.isfinite(np.concatenate([predicted_mm, measured_mm], axis=1)).all(axis=1))
    if not len(seen):
        return keep
    place, shift = measured_mm[seen], measured_mm[seen] - predicted_mm[seen]
    for index, near in enumerate(cKDTree(place).query_ball_point(place, reach_mm, return_sorted=True)):
        others = np.array(near)[np.abs(place[near] - place[index]).max(axis=1) >= template_mm]
        agreeing = others[np.linalg.norm(shift[others] - shift[index], axis=1) <= gate_mm]
        if len(agreeing) and len(agreeing) >= min_share * len(others):
            keep[seen[index]] = _has_apart(place[agreeing], template_mm, min_places)
    return keep


def _has_apart(points: FloatArray, apart: float, count: int) -> bool:
    """Whether so many points can be taken in turn no two of which are nearer to each other along and across."""
    for _ in range(count):
        if not len(points):
            return False
        points = points[np.abs(points - points[0]).max(axis=1) >= apart]
    return True


def thinned(film_mm: FloatArray, score: FloatArray, *, cell_mm: float, per_cell: int) -> BoolArray:
    """The best few points of each square cell of the film, (N,) bool."""
    keep = np.zeros(len(film_mm), bool)
    cell = cells(film_mm, cell_mm)
    order = np.lexsort((np.arange(len(score)), -score, cell[:, 1], cell[:, 0]))
    _, first = np.unique(cell[order], axis=0, return_index=True)
    start = np.zeros(len(order), np.intp)
    start[first] = first
    rank = np.arange(len(order)) - np.maximum.accumulate(start)
    keep[order[rank < per_cell]] = True
    return keep


def in_check_blocks(
    film_mm: FloatArray, half_length_mm: float, half_width_mm: float, *, columns: int, rows: int
) -> BoolArray:
    """Points in every other block of a chequerboard over the film, (N,) bool: blocks held back for checking."""
    block = block_of(film_mm, half_length_mm, half_width_mm, columns, rows)
    return np.asarray(block.sum(axis=1) % 2 == 1)


def block_of(film_mm: FloatArray, half_length_mm: float, half_width_mm: float, columns: int, rows: int) -> IntArray:
    """Column and row (N, 2) of the equal blocks of the picture that points lie in; outer points in the outer blocks."""
    share = film_mm / (2 * np.array([half_length_mm, half_width_mm])) + 0.5
    count = np.array([columns, rows])
    return np.asarray(np.clip(np.floor(share * count), 0, count - 1).astype(np.intp))


def cells(film_mm: FloatArray, cell_mm: float) -> IntArray:
    """Numbers (N, 2) of square cells, one of them centred on the film."""
    return np.asarray(np.floor(film_mm / cell_mm + 0.5).astype(np.intp))
