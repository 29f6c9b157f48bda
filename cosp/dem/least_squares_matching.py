"""Two surfaces brought together by a 3-D affine transformation, tile by tile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosp.arrays import BoolArray, FloatArray
from cosp.dem.terrain import gradient
from cosp.geometry.grids import PixelGrid
from cosp.geometry.robust import tukey_weights
from cosp.geometry.statistics import nmad
from cosp.imaging.resampling import sample

_ITERATIONS = 12
_SETTLED_M = 1e-3  # change of the shift between two steps at which the iteration ends


@dataclass(frozen=True)
class AffineShift:
    """Displacement of points of a model that brings them onto the reference.

    A point X = (easting, northing, height) goes to X + t + A (X - centre).

    Parameters
    ----------
    centre_m : (3,) array
    shift_m : (3,) array
        t: east, north, up.
    matrix : (3, 3) array
        A.
    """

    centre_m: FloatArray
    shift_m: FloatArray
    matrix: FloatArray

    def displacement(self, points_m: FloatArray) -> FloatArray:
        """Displacements (..., 3) of points (..., 3), metres."""
        return np.asarray(self.shift_m + (points_m - self.centre_m) @ self.matrix.T)


@dataclass(frozen=True)
class SurfaceMatch:
    """Result of `match_surfaces`.

    Parameters
    ----------
    transformation : AffineShift
    count : int
        Cells of weight above zero.
    sigma_shift_m : (3,) array
        Standard deviations of the shift, priors included.
    nmad_before_m, nmad_after_m : float
        Of the height differences at the cells used.
    """

    transformation: AffineShift
    count: int
    sigma_shift_m: FloatArray
    nmad_before_m: float
    nmad_after_m: float


def match_surfaces(
    heights_m: FloatArray,
    reference_m: FloatArray,
    chosen: BoolArray,
    grid: PixelGrid,
    *,
    start_m: FloatArray,
    sigma_matrix: float,
    sigma_shift_m: float,
    cells_per_independent: float,
    most_cells: int,
) -> SurfaceMatch:
    """The 3-D affine transformation that lays one surface onto another.

    Each chosen cell says that its displaced point lies on the reference along the reference's normal,
    ref - h = t_z + (A X)_z - s_x dX - s_y dY with the reference's slopes s. Where the ground is flat these equations
    say nothing about shifts in plan; priors then hold them at the start, and what remains is a plane.

    Parameters
    ----------
    heights_m, reference_m : (R, C) arrays
        On one grid.
    chosen : (R, C) boolean array
        Stable cells; those without a height in either model are left out.
    grid : PixelGrid
    start_m : (3,) array
        First shift, and the mean of its prior in plan.
    sigma_matrix : float
        Prior standard deviation of the terms of A about zero.
    sigma_shift_m : float
        Prior standard deviation of the shift in plan. Heights are free.
    cells_per_independent : float
        Number of cells that count as one observation, since neighbouring cells err together.
    most_cells : int
        A larger number of cells is thinned evenly.

    Raises
    ------
    ValueError
        No cell has both heights.

    References
    ----------
    [Ressl2011]; [Ghuffar2022] section III-F.
    """
    rows, columns = np.nonzero(chosen & np.isfinite(heights_m) & np.isfinite(reference_m))
    if not rows.size:
        raise ValueError("no chosen cell has heights in both models")
    every = max(1, -(-rows.size // most_cells))
    rows, columns = rows[::every], columns[::every]
    points = np.concatenate([grid.points(rows, columns), heights_m[rows, columns][:, None]], axis=1).astype(float)
    centre = points.mean(axis=0)
    reach = np.maximum(np.abs(points - centre).max(axis=0), 1.0)
    local = (points - centre) / reach
    reference_m = np.asarray(reference_m, np.float32)
    slope_x, slope_y = gradient(reference_m, grid.step_x, grid.step_y)

    # Unknowns: t (3), then A row by row with columns scaled by the reach of the tile.
    prior_sigma = np.concatenate([[sigma_shift_m] * 2, [np.inf], np.tile(sigma_matrix * reach, 3)])
    mean = np.concatenate([start_m[:2], np.zeros(10)])
    unknowns = np.concatenate([start_m, np.zeros(9)]).astype(float)
    first = _mismatch(unknowns, points, local, reference_m, grid)[0]
    misfit, normal_matrix, weights = first, np.eye(12), np.ones(len(first))
    for _ in range(_ITERATIONS):
        misfit, at_rows, at_columns = _mismatch(unknowns, points, local, reference_m, grid)
        s_x = sample(slope_x, at_rows, at_columns, interpolation="linear", border=np.nan)
        s_y = sample(slope_y, at_rows, at_columns, interpolation="linear", border=np.nan)
        usable = np.isfinite(misfit) & np.isfinite(s_x) & np.isfinite(s_y)
        if not usable.any():
            raise ValueError("no chosen cell has heights in both models")
        scale = max(nmad(misfit[usable]), 1e-3)
        centred = misfit - np.median(misfit[usable])
        weights = np.where(usable, tukey_weights(np.where(usable, centred, 0) / scale), 0)
        towards = np.stack([np.where(usable, -s_x, 0), np.where(usable, -s_y, 0), np.ones(len(misfit))], axis=-1)
        design = np.concatenate([towards, (towards[:, :, None] * local[:, None, :]).reshape(-1, 9)], axis=1)
        weight = weights[:, None] / (scale**2 * cells_per_independent)
        normal_matrix = design.T @ (weight * design) + np.diag(1 / prior_sigma**2)
        right = design.T @ (weight[:, 0] * np.where(usable, misfit, 0)) + (mean - unknowns) / prior_sigma**2
        step = _solve(normal_matrix, right)
        unknowns = unknowns + step
        if np.abs(step).max() < _SETTLED_M:
            break
    used = weights > 0
    misfit = _mismatch(unknowns, points, local, reference_m, grid)[0]
    scale_12 = np.sqrt(np.diag(normal_matrix))
    covariance = np.linalg.pinv(normal_matrix / np.outer(scale_12, scale_12)) / np.outer(scale_12, scale_12)
    return SurfaceMatch(
        AffineShift(centre, unknowns[:3], unknowns[3:].reshape(3, 3) / reach),
        int(used.sum()),
        np.sqrt(np.diag(covariance)[:3]),
        nmad(first[used]),
        nmad(misfit[used]),
    )


def _mismatch(
    unknowns: FloatArray, points: FloatArray, local: FloatArray, reference_m: FloatArray, grid: PixelGrid
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Reference minus displaced point, and where on the reference that was read."""
    moved = points + unknowns[:3] + local @ unknowns[3:].reshape(3, 3).T
    rows, columns = grid.pixels(moved[:, :2])
    at = sample(reference_m, rows, columns, interpolation="linear", border=np.nan)
    return at - moved[:, 2], rows, columns


def _solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of normal equations whose unknowns are of unlike size."""
    scale = 1 / np.sqrt(np.diag(matrix))
    return np.asarray(scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * right))
