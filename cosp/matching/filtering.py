"""Which matches to keep: those that agree with their neighbours, spread evenly over the film."""

from __future__ import annotations

import numpy as np

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
