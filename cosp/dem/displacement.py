"""By how much a model is displaced against a reference, tile by tile, and how well the relief of each tile tells."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from cosp.arrays import BoolArray, FloatArray
from cosp.dem.terrain import gradient
from cosp.geometry.grids import PixelGrid
from cosp.geometry.robust import tukey_weights
from cosp.geometry.statistics import nmad
from cosp.imaging.resampling import sample
from cosp.imaging.windows import Window, tiles

_LOG = logging.getLogger(__name__)

Verdict = Literal["kept", "open", "far", "worse"]

# Of a shift that the relief leaves open: far more than any displacement.
_OPEN_SIGMA_M = 1000.0
# Ground whose slopes agree less between model and reference is plain: what is left of them are errors of both.
_LEAST_AGREEMENT = 0.5
# Of the largest shift that is plausible: a standard deviation beyond it tells nothing.
_TOLD = 1 / 3
# Of the cells of a tile that must lie on ground that tells something.
_LEAST_USED = 0.2
# A tile is cut into so many squares a side, which err independently of each other; fewer than this tell nothing.
_SQUARES = 8
_LEAST_SQUARES = 12
_ITERATIONS = 15
_SETTLED_M = 0.01
# Standard deviations are scaled by what neighbouring tiles differ by; so many differences are needed for that, and this
# is taken for the scale where there are fewer.
_LEAST_DIFFERENCES = 20
_USUAL_FACTOR = 2.5
# Unknowns besides the shift in plan: height, and a tilt of the tile along either axis.
_UPWARD = 3


@dataclass(frozen=True)
class Displacement:
    """What must be added to a piece of a model to bring it onto the reference.

    Parameters
    ----------
    place_m : (3,) array
        Easting, northing, height of the middle of the cells that were compared.
    shift_m : (3,) array
        East, north, up; 0 along what the relief leaves open.
    covariance_m2 : (3, 3) array
        Of the shift: a kilometre along what the relief leaves open, such as all of plan in a plain.
    cells : int
        That were compared.
    nmad_before_m, nmad_after_m : float
        Of the differences of height.
    verdict : "kept", "open", "far" or "worse"
        Whether it tells where the model lies; else the relief leaves a direction of plan open, the shift is larger than
        allowed, or does not help.
    """

    place_m: FloatArray
    shift_m: FloatArray
    covariance_m2: FloatArray
    cells: int
    nmad_before_m: float
    nmad_after_m: float
    verdict: Verdict


def displacements(
    heights_m: FloatArray,
    reference_m: FloatArray,
    stable: BoolArray,
    grid: PixelGrid,
    *,
    tile_m: float,
    least_share: float,
    max_slope_deg: float,
    largest_shift_m: float,
    reference_sigma_m: float,
    threads: int,
) -> list[Displacement]:
    """Displacements of the tiles of a model that hold enough stable ground, row by row.

    Parameters
    ----------
    heights_m, reference_m : (R, C) arrays
        On one grid, about equally smooth.
    stable : (R, C) boolean array
        Cells that may be compared.
    grid : PixelGrid
    tile_m : float
        Side of a tile.
    least_share : float
        Of a tile's cells that must be stable and in both models.
    max_slope_deg : float
        Where the reference is steeper, it tells nothing.
    largest_shift_m : float
        Larger shifts are implausible.
    reference_sigma_m : float
        Standard deviation, per axis, of what a whole tile of the reference is wrong by; added to the covariances.
    threads : int
    """
    reference_m = np.asarray(reference_m, np.float32)
    chosen = stable & np.isfinite(heights_m) & np.isfinite(reference_m)
    side = max(_SQUARES, round(tile_m / abs(grid.step_x)))

    def one(window: Window) -> Displacement | None:
        if chosen[window.slices].sum() < least_share * side**2:
            return None
        # The reference about the tile, so that a shifted tile still lies on it.
        seen = window.grown(round(largest_shift_m / abs(grid.step_x)) + 2, grid.shape)
        part = grid.window(seen.row0, seen.row1, seen.column0, seen.column1)
        wanted = np.zeros(seen.shape, bool)
        wanted[window.inside(seen).slices] = chosen[window.slices]
        return displacement(
            np.asarray(heights_m[seen.slices], float),
            reference_m[seen.slices],
            wanted,
            part,
            square_m=tile_m / _SQUARES,
            max_slope_deg=max_slope_deg,
            largest_shift_m=largest_shift_m,
        )

    with ThreadPoolExecutor(threads) as pool:
        found = [of_tile for of_tile in pool.map(one, tiles(grid.shape, side)) if of_tile is not None]
    factor = spread_factor(found, tile_m)
    _LOG.info("neighbouring tiles differ by %.1f times what their squares say", factor)
    whole = reference_sigma_m**2 * np.eye(3)
    return [
        _if_told(replace(of_tile, covariance_m2=factor**2 * of_tile.covariance_m2 + whole), largest_shift_m)
        for of_tile in found
    ]


def _if_told(found: Displacement, largest_shift_m: float) -> Displacement:
    """The displacement, or open where a direction of plan is hardly better known than what is implausible."""
    sigma_m = np.sqrt(np.linalg.eigvalsh(found.covariance_m2[:2, :2])[1])
    told = found.verdict == "far" or sigma_m < _TOLD * largest_shift_m
    return found if told else replace(found, verdict="open")


def spread_factor(found: Sequence[Displacement], tile_m: float) -> float:
    """How many times larger than stated the spread of displacements between neighbouring tiles is; at least one.

    Errors that a whole tile has in common, such as those of dense matching over a few kilometres, do not show in what
    its squares say.

    Parameters
    ----------
    found : sequence of Displacement
    tile_m : float
        Side of the tiles.
    """
    kept = [of_tile for of_tile in found if of_tile.verdict == "kept"]
    if len(kept) < 2:
        return _USUAL_FACTOR
    places = np.array([of_tile.place_m[:2] for of_tile in kept])
    shifts = np.array([of_tile.shift_m for of_tile in kept])
    variances = np.array([np.diag(of_tile.covariance_m2) for of_tile in kept])
    first, second = cKDTree(places).query_pairs(1.25 * tile_m, output_type="ndarray").T
    told = np.maximum(variances[first], variances[second]) < (_OPEN_SIGMA_M / 10) ** 2
    ratio = (shifts[first] - shifts[second]) / np.sqrt(variances[first] + variances[second])
    if told[:, :2].sum() < _LEAST_DIFFERENCES:
        return _USUAL_FACTOR
    return max(1.0, 1.4826 * float(np.median(np.abs(ratio[told]))))


def displacement(
    heights_m: FloatArray,
    reference_m: FloatArray,
    chosen: BoolArray,
    grid: PixelGrid,
    *,
    square_m: float,
    max_slope_deg: float,
    largest_shift_m: float,
) -> Displacement | None:
    """Displacement of the chosen cells of a model; None where they lie in too few squares, or leave the reference.

    Each cell says that its displaced point lies on the reference, ref - h = t_up + tilt - s · t_plan with the slopes s
    of the reference. Those are wrong by the noise of the reference, which in a plain is most of them: least squares
    would find no shift there, and be sure of it. So the equations are weighed with the slopes of the model instead,
    whose noise is another (instrumental variables), and along what the two do not agree on nothing is found. What
    squares of the tile say, each by itself, tells the covariance: cells of one square may err together.

    Parameters
    ----------
    heights_m, reference_m, chosen : (R, C) arrays
    grid : PixelGrid
    square_m : float
        Side of squares that err independently.
    max_slope_deg, largest_shift_m : float
        See `displacements`. The slope is that of the reference where a cell comes to lie: cells chosen by what lies
        under them before would lie on one side of crests and valleys, and draw the shift with them.

    References
    ----------
    [White1982]
    """
    rows, columns = np.nonzero(chosen)
    xy, height = grid.points(rows, columns), heights_m[rows, columns]
    middle = xy.mean(axis=0)
    upward = np.column_stack([np.ones(len(xy)), (xy - middle) / max(float(np.abs(xy - middle).max()), 1.0)])
    square = np.unique(np.floor(xy / square_m), axis=0, return_inverse=True)[1].ravel()
    of_model = np.stack([of[rows, columns] for of in gradient(heights_m, grid.step_x, grid.step_y)], axis=-1)
    of_reference = gradient(reference_m, grid.step_x, grid.step_y)

    steepest = np.tan(np.radians(max_slope_deg))
    shift, before_m = np.zeros(2 + _UPWARD), np.nan
    for step in range(_ITERATIONS):
        places = grid.pixels(xy + shift[:2])
        lifted, *slopes = (
            sample(of, *places, interpolation="linear", border=np.nan) for of in (reference_m, *of_reference)
        )
        there = np.stack(slopes, axis=-1)
        known = np.isfinite(lifted) & (np.hypot(*there.T) <= steepest) & np.isfinite(of_model).all(axis=1)
        if known.sum() < _LEAST_USED * len(known) or len(np.unique(square[known])) < _LEAST_SQUARES:
            return None
        difference, squares, up = (lifted - height)[known], square[known], upward[known]
        if step == 0:
            before_m = nmad(difference)
            shift[2] = np.median(difference)
        misfit = difference - up @ shift[2:]
        weight = tukey_weights(misfit / max(nmad(misfit), 1e-3))
        axes, told = _relief(of_model[known], there[known], weight)
        design, instruments = (np.column_stack([-of[known] @ axes[:, told], up]) for of in (there, of_model))
        normal = instruments.T @ (weight[:, None] * design)
        solved = np.linalg.solve(normal, instruments.T @ (weight * misfit))
        shift += np.concatenate([axes[:, told] @ solved[:-_UPWARD], solved[-_UPWARD:]])
        if np.abs(solved).max() < _SETTLED_M or np.abs(shift[:2]).max() > 2 * largest_shift_m:
            break

    left = misfit - design @ solved
    scores = np.zeros((square.max() + 1, len(normal)))
    np.add.at(scores, squares, instruments * (weight * left)[:, None])
    count = int(np.count_nonzero(scores.any(axis=1)))
    inverse = np.linalg.inv(normal)
    few = count / max(count - len(normal), 1)
    spread = few * inverse @ (scores.T @ scores) @ inverse.T
    # From what the relief tells and height to east, north and up.
    turn = np.zeros((3, told.sum() + 1))
    turn[:2, :-1], turn[2, -1] = axes[:, told], 1.0
    kept = told.sum() + 1
    covariance = turn @ spread[:kept, :kept] @ turn.T
    covariance[:2, :2] += _OPEN_SIGMA_M**2 * axes[:, ~told] @ axes[:, ~told].T
    after_m = nmad(left)
    verdict: Verdict = "kept"
    if np.abs(shift[:3]).max() > largest_shift_m:
        verdict = "far"
    elif after_m > before_m:
        verdict = "worse"
    place = np.array([*middle, height.mean()])
    return Displacement(place, shift[:3], covariance, int(np.count_nonzero(weight)), before_m, after_m, verdict)


def _relief(of_model: FloatArray, of_reference: FloatArray, weight: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Two directions of plan, as columns, and along which of them the slopes of model and reference agree."""
    model, reference = (of - np.average(of, axis=0, weights=weight) for of in (of_model, of_reference))
    common = model.T @ (weight[:, None] * reference)
    axes = np.linalg.eigh((common + common.T) / 2)[1]
    along = model @ axes, reference @ axes
    size = np.sqrt((weight @ along[0] ** 2) * (weight @ along[1] ** 2))
    return axes, np.asarray(weight @ (along[0] * along[1]) > _LEAST_AGREEMENT * size)


def verdicts(found: Sequence[Displacement]) -> dict[str, int]:
    """How many displacements came to which verdict."""
    return {verdict: sum(one.verdict == verdict for one in found) for verdict in get_args(Verdict)}
