"""Steps of the scanner inside one part, where the picture does not continue from a column to the next.

Within a block neighbouring columns of a part show neighbouring places of the film: they are most alike when laid side
by side as they are, and the farther apart the less alike. Where a block ends, its neighbour is most alike after a shift
across the film, which is the step across; and columns to both sides of the boundary are as much alike as columns that
are a little more or less far apart elsewhere, which is the step along the film.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from cosp.arrays import ByteArray, FloatArray
from cosp.film import kernels
from cosp.geometry.robust import running_median
from cosp.geometry.statistics import nmad

_MOST = 400  # a step of grey counts at most: sums of products must stay within 32 bits
_LEAST_BREAK = 3.0  # standard deviations; less is none
_GAPS = 4  # columns between two that are compared, at most
_ROWS = 2048  # that are looked at; more tell hardly more
_STRIP_ROWS = 128
_CHUNK_COLUMNS = 1024
_CLIP = 3.0  # standard deviations: no single line along the film rules a column
_USUAL_COLUMNS = 81  # that tell how much alike columns are hereabouts
_SCATTER_COLUMNS = 301
_LEAST_LIKENESS = 0.3  # of neighbouring columns; bare film shows the scanner's noise
_LEAST_SD_PX = 0.01
_LEAST_SCATTER = 0.003
_NO_BREAK_COLUMNS = 48  # at the ends of a part
_AROUND = 100  # columns to either side that tell how likeness falls with distance
_CORRELATED = 1.5  # likeness at neighbouring shifts and gaps errs alike


@dataclass(frozen=True)
class Boundary:
    """Where two blocks of a part meet.

    Parameters
    ----------
    column_px : float
        Between two columns of the part.
    size_px, sd_px : (x, y)
        By how much farther the right block is displaced than the left one, and its standard deviation.
    significance : float
        Of the break in the picture, in standard deviations.
    """

    column_px: float
    size_px: tuple[float, float]
    sd_px: tuple[float, float]
    significance: float


@dataclass(frozen=True)
class Continuity:
    """How the picture of a part goes on from column to column.

    Parameters
    ----------
    part : (rows, columns) uint8 array
    reach_px : int
        Largest step that is looked for.
    breaks : (columns,) array
        Break of the picture behind each column, in standard deviations; 0 where there is no picture.
    """

    part: ByteArray
    reach_px: int
    breaks: FloatArray

    def break_columns(self, least: float) -> FloatArray:
        """Places (N,) between columns where the picture breaks by at least `least` and most around."""
        breaks = self.breaks.copy()
        breaks[:_NO_BREAK_COLUMNS] = breaks[-_NO_BREAK_COLUMNS:] = 0.0
        most = breaks >= maximum_filter1d(breaks, 2 * _GAPS + 5)
        return np.flatnonzero(most & (breaks >= least)) + 0.5

    def strongest(self, place_px: float, reach: int) -> Boundary:
        """The step where the picture breaks most within `reach` columns of a place; of no known size if nowhere."""
        first = max(round(place_px - 0.5) - reach, 0)
        near = self.breaks[first : round(place_px - 0.5) + reach + 1]
        if near.max(initial=0.0) < _LEAST_BREAK:
            limit = float(self.reach_px)
            return Boundary(place_px, (0.0, 0.0), (limit, limit), 0.0)
        return self.boundary(first + int(near.argmax()))

    def boundary(self, column: int) -> Boundary:
        """The step behind a column, whether significant or not.

        It is the displacement at which likeness over the joint equals that of columns so far apart hereabouts.
        """
        reach, rows = self.reach_px, self.part.shape[0]
        begin = max(column - _AROUND - _GAPS, 0)
        end = min(column + _AROUND, self.part.shape[1])
        strips = range(0, max(rows - _STRIP_ROWS, 1), _STRIP_ROWS)
        alike = _over_joints(_likeness(self.part, (begin, end), strips, _STRIP_ROWS + 2 * reach, reach))
        around = np.arange(_GAPS, end - begin)
        around = around[np.abs(around - (column - begin)) > _GAPS]
        usual = np.median(alike[:, :, around], axis=2)
        scatter = np.array([max(nmad(each), 1e-3) for each in alike[:, :, around] - usual[..., None]])
        # Likeness falls with distance the same way to both sides, steeply from one column to two; at no distance at all
        # it holds the scanner's noise.
        distances = np.arange(1, _GAPS + 1)
        mirrored = usual[:, ::-1]
        top = make_interp_spline(
            np.r_[-distances[::-1], distances], np.concatenate([mirrored[::-1], usual]), k=3, axis=0
        )
        right, left = (make_interp_spline(distances, side, k=3, axis=0) for side in (usual, mirrored))

        def misfit(along: FloatArray, across: FloatArray) -> FloatArray:
            apart = np.clip(distances[None] - along[:, None], -_GAPS, _GAPS)[..., None]
            beside = np.maximum(np.abs(apart[..., 0]), 1.0)
            likeness = np.where(np.abs(apart) < 1, top(apart[..., 0]), np.where(apart > 0, right(beside), left(beside)))
            shifts = np.clip(np.arange(2 * reach + 1) - across[:, None], 0, 2 * reach)
            expected = make_interp_spline(np.arange(2 * reach + 1), likeness, k=3, axis=2)(shifts)
            off = alike[:, None, :, column - begin] - expected  # (along, gap, across, shift)
            return np.asarray(((off / scatter[:, None, None]) ** 2).sum(axis=(1, 3)))

        along = across = np.zeros(1)
        for width, step in ((reach, 0.25), (0.3, 0.02)):
            tried = np.arange(-width, width + step / 2, step)
            grid = [np.clip(axis + tried, -reach, reach) for axis in (along, across)]
            cost = misfit(*grid)
            first = np.unravel_index(int(cost.argmin()), cost.shape)
            along, across = (axis[[k]] for axis, k in zip(grid, first, strict=True))
        h = 0.1
        near = misfit(along + np.array([-h, 0.0, h]), across + np.array([-h, 0.0, h]))
        curvature = np.array([near[0, 1] + near[2, 1], near[1, 0] + near[1, 2]]) - 2 * near[1, 1]
        sd = np.clip(_CORRELATED * h * np.sqrt(2.0 / np.maximum(curvature, 1e-6)), _LEAST_SD_PX, float(reach))
        if max(abs(along[0]), abs(across[0])) >= reach:  # nothing fits
            sd[:] = reach
        return Boundary(
            column + 0.5,
            (float(along[0]), float(across[0])),
            (float(sd[0]), float(sd[1])),
            float(self.breaks[column]),
        )


def measure_continuity(part: ByteArray, *, reach_px: int, threads: int) -> Continuity:
    """Likeness of neighbouring columns all along a part.

    Parameters
    ----------
    part : (rows, columns) uint8 array
    reach_px : int
        Largest step that is looked for.
    threads : int
    """
    rows, columns = part.shape
    chunks = [(c, min(c + _CHUNK_COLUMNS, columns)) for c in range(0, columns, _CHUNK_COLUMNS)]
    count = max(1, min(_ROWS, rows) // _STRIP_ROWS)
    height = min(_STRIP_ROWS, rows)
    strips = np.linspace(0, rows - height, count).astype(int).tolist()

    def work(chunk: tuple[int, int]) -> FloatArray:
        return _likeness(part, chunk, strips, height, reach_px)

    with ThreadPoolExecutor(threads) as pool:
        pairs = np.concatenate(list(pool.map(work, chunks)), axis=2)
    alike = _over_joints(pairs)
    across, _ = _peaks(alike[0])
    best = np.stack([_peaks(each)[1] for each in alike[:2]])
    usual = np.stack([running_median(each, _USUAL_COLUMNS) for each in best])
    across_sd = np.maximum(1.4826 * running_median(np.abs(across), _SCATTER_COLUMNS), _LEAST_SD_PX)
    scatter = np.stack([1.4826 * running_median(np.abs(each), _SCATTER_COLUMNS) for each in best - usual])
    less = (best - usual) / np.maximum(scatter, _LEAST_SCATTER)
    breaks = np.sqrt((across / across_sd) ** 2 + (less**2).mean(axis=0))
    return Continuity(part, reach_px, np.where(usual[0] > _LEAST_LIKENESS, breaks, 0.0))


def _over_joints(pairs: FloatArray) -> FloatArray:
    """Likeness (gaps, shifts, C) over the joint behind each column of columns 1, 2, ... apart, means of all such pairs.

    pairs : likeness of each column with those 1, 2, ... to its right.
    """
    alike = np.zeros_like(pairs)
    for g in range(1, _GAPS + 1):
        for k in range(g):  # the pairs over the joint behind column c begin at c, c - 1, ...
            alike[g - 1, :, k:] += pairs[g - 1, :, : pairs.shape[2] - k] / g
    return alike


def _likeness(part: ByteArray, chunk: tuple[int, int], strips: Sequence[int], height: int, reach: int) -> FloatArray:
    """Correlation (gaps, 2 reach + 1, C) of each column of a chunk with its neighbours to the right."""
    first, last = chunk
    stop = min(last + _GAPS, part.shape[1])
    steps = []
    for row in strips:
        grey = part[row : row + height, first:stop].astype(np.int16)
        steps.append(grey[3:] + grey[2:-1] - grey[1:-2] - grey[:-3])
    size = 1.4826 * np.median(np.abs(np.concatenate(steps)[:: 1 + len(steps) // 4]), axis=0)
    limit = np.clip(np.rint(_CLIP * uniform_filter1d(size, 33)), 2, _MOST).astype(np.int16)
    products = np.zeros((_GAPS + 1, 2 * reach + 1, stop - first), np.int32)
    for step in steps:
        kernels.add_products(np.clip(step, -limit, limit), reach, products)
    own = np.maximum(products[0, reach].astype(float), 1.0)
    out = np.zeros((_GAPS, 2 * reach + 1, last - first))
    for g in range(1, _GAPS + 1):
        n = min(last - first, stop - first - g)
        out[g - 1, :, :n] = products[g, :, :n] / np.sqrt(own[:n] * own[g : g + n])
    return out


def _peaks(curves: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Place (N,), from the middle, and height of the top of curves (M, N), from a parabola through three values."""
    last = curves.shape[0] - 1
    top = np.clip(curves.argmax(axis=0), 1, last - 1)
    here = np.arange(curves.shape[1])
    a, b, c = (curves[top + k, here] for k in (-1, 0, 1))
    curvature = np.minimum(a - 2 * b + c, -1e-9)
    part = np.clip(0.5 * (a - c) / curvature, -1.0, 1.0)
    return top - last / 2 + part, b - 0.25 * (a - c) * part
