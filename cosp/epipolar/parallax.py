"""What the rectification leaves across the rows: y-parallax of an epipolar pair, measured by correlation on a grid."""

from __future__ import annotations

import logging
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cosp.arrays import FloatArray
from cosp.epipolar import kernels
from cosp.epipolar.correction import RowCorrection, correction_field
from cosp.epipolar.patches import Patches
from cosp.epipolar.rectification import Rectification
from cosp.epipolar.smoothing import local_median, smooth_field
from cosp.errors import NotEnoughMatchesError
from cosp.geometry.grids import PixelGrid
from cosp.geometry.statistics import nmad
from cosp.imaging.correlation import FLAT, subpixel_peaks

_log = logging.getLogger(__name__)

# Columns of the coarsest search, in its own pixels: the pyramid is as high as this asks for.
_COARSEST_SPAN_PX = 48
# From one level to the next a disparity may be wrong by so many pixels of the new level: a slope of the terrain between
# nodes and twice the error of the coarser one.
_COLUMN_SEARCH_PX = 8
# Rows are searched so far at every level, about what the level above found.
_ROW_SEARCH_PX = 3
# Rows of the picture read at a time.
_STRIP_ROWS = 2048
# Share of black pixels (outside the film) that a template may hold.
_MOST_BLACK = 0.02
# A disparity is taken for wrong if it is further from the median of its neighbours than this many pixels of its level
# and this part of the distance between nodes (a slope of disparity no terrain has over so wide a window).
_MEDIAN_RADIUS = 2
_ODD_PX, _ODD_SLOPE = 3.0, 0.25


@dataclass(frozen=True)
class YParallax:
    """Aft row minus fore row on a grid of nodes of the fore image.

    Parameters
    ----------
    grid : PixelGrid
        Of the nodes, in pixels of the fore image (x column, y row).
    raw_px : (rows, columns) array
        As measured; NaN where the ground is without texture, ambiguous, or outside one of the films.
    smooth_px : (rows, columns) array
        Smooth field through it, at every node.
    score : (rows, columns) array
        Correlation; NaN where nothing was correlated.
    disparity_px : (rows, columns) array
        Aft column minus fore column that goes with `raw_px`.
    """

    grid: PixelGrid
    raw_px: NDArray[np.float64]
    smooth_px: NDArray[np.float64]
    score: NDArray[np.float64]
    disparity_px: NDArray[np.float64]

    def summary(self) -> dict[str, float | int]:
        """Median, spread and count of what was measured, and its spread about the smooth field."""
        measured = self.raw_px[np.isfinite(self.raw_px)]
        noise = (self.raw_px - self.smooth_px)[np.isfinite(self.raw_px)]
        return {
            "count": int(measured.size),
            "nodes": int(np.isfinite(self.score).sum()),
            "median_px": float(np.median(measured)),
            "sd_px": float(measured.std()),
            "nmad_px": float(nmad(measured)),
            "share_within_1_px": float((np.abs(measured) <= 1.0).mean()),
            "sd_about_smooth_px": float(noise.std()),
            "nmad_about_smooth_px": float(nmad(noise)),
        }


def node_grid(shape: tuple[int, int], *, spacing_px: int, fewest_nodes: int) -> PixelGrid:
    """Nodes over an image, evenly spaced; closer than asked for where the image is too small for enough of them."""
    spacing = spacing_px
    while spacing > 16 and (shape[0] // spacing) * (shape[1] // spacing) < fewest_nodes:
        spacing //= 2
    counts = (max(shape[0] // spacing, 1), max(shape[1] // spacing, 1))
    row0, column0 = ((n - 1 - (k - 1) * spacing) // 2 for n, k in zip(shape, counts, strict=True))
    return PixelGrid(float(column0), float(row0), float(spacing), float(spacing), counts)


def measure_y_parallax(
    fore: Patches,
    aft: Patches,
    nodes: PixelGrid,
    disparity_bounds: tuple[FloatArray, FloatArray],
    *,
    template_px: int,
    least_score: float,
    largest_ratio: float,
    smoothing_nodes: float,
    fewest_matches: int,
    threads: int,
) -> YParallax:
    """y-parallax of an epipolar pair on a grid of nodes, with a smooth field through it.

    Windows about the nodes are correlated in both directions, coarse to fine: the coarsest level searches the whole
    disparity interval along the row, each finer one a few pixels about the median-filtered disparity before.

    Parameters
    ----------
    fore, aft : Patches
        Windows of the rectified images; 0 outside the film.
    nodes : PixelGrid
        Of the nodes in pixels of the fore image.
    disparity_bounds : (lowest, highest), arrays of the nodes' shape, px
        Interval to be searched at each node; NaN leaves a node out.
    template_px : int
        Side of the windows; even.
    least_score, largest_ratio : float
        A match counts if its correlation is at least the one and the second highest peak, as a part of the highest,
        at most the other.
    smoothing_nodes : float
        Standard deviation of the window of the smooth field, in nodes.
    fewest_matches : int
    threads : int

    Raises
    ------
    NotEnoughMatchesError
        If fewer nodes than `fewest_matches` could be measured.
    """
    low, high = (np.asarray(b, float) for b in disparity_bounds)
    span = float(np.nanmax(high - low))
    factor = 2 ** max(0, math.ceil(math.log2(max(span, 1.0) / _COARSEST_SPAN_PX)))
    disparity, y_parallax = (low + high) / 2, np.where(np.isfinite(low), 0.0, np.nan)
    search = (_ROW_SEARCH_PX, math.ceil(span / 2 / factor) + 2)
    while True:
        _log.info("correlating %d x %d nodes at 1 : %d", *nodes.shape, factor)
        measured = _correlate(fore, aft, nodes, (y_parallax, disparity), factor, search, template_px, threads)
        good = (measured.score >= least_score) & (measured.ratio <= largest_ratio)
        found = np.where(good, measured.disparity_px, np.nan)
        odd = np.abs(found - local_median(found, _MEDIAN_RADIUS)) > _ODD_PX * factor + _ODD_SLOPE * nodes.step_x
        good &= ~odd & np.isfinite(measured.y_parallax_px)
        count = int(good.sum())
        if count < fewest_matches:
            raise NotEnoughMatchesError(
                f"y-parallax: {count} of the {fewest_matches} nodes needed could be matched at 1 : {factor}, "
                f"of {int(np.isfinite(measured.score).sum())} on both films"
            )
        if factor == 1:
            break
        with ThreadPoolExecutor(min(threads, 2)) as pool:
            disparity, y_parallax = (
                np.where(np.isfinite(low), field, np.nan)
                for field in pool.map(
                    _filled_medians,
                    [np.where(good, values, np.nan) for values in (measured.disparity_px, measured.y_parallax_px)],
                    [1, _MEDIAN_RADIUS],
                )
            )
        factor //= 2
        search = (_ROW_SEARCH_PX, _COLUMN_SEARCH_PX)
    raw = np.where(good, measured.y_parallax_px, np.nan)
    smooth = smooth_field(raw, np.where(good, measured.score**2, 0.0), sigma_nodes=smoothing_nodes)
    return YParallax(nodes, raw, smooth, measured.score, np.where(good, measured.disparity_px, np.nan))


def fold_y_parallax(rectification: Rectification, found: YParallax, *, smoothing_nodes: float) -> Rectification:
    """The rectification with a smooth field of measured y-parallax taken out of the rows of its aft image.

    The field belongs to the place on the aft image, and is drawn there. What distorts one film and what distorts the
    other go together only as far as disparity is small beside the length over which they change, which it is.

    Parameters
    ----------
    rectification : Rectification
        Without a correction so far: it is what `found` was measured with.
    found : YParallax
    smoothing_nodes : float
        Standard deviation of the smoothing window, in nodes.
    """
    measured = np.isfinite(found.raw_px)
    place = found.grid.centres()[measured]
    field = correction_field(
        place[:, 1],
        place[:, 0] + found.disparity_px[measured],
        found.raw_px[measured],
        found.score[measured] ** 2,
        found.grid,
        smoothing_nodes=smoothing_nodes,
    )
    aft = rectification.aft
    correction = RowCorrection.through(
        field, found.grid, pixel_mm=aft.pixel_mm, row0_mm=aft.row0_mm, column0_mm=aft.column0_mm
    )
    return replace(rectification, aft=replace(aft, correction=correction))


@dataclass(frozen=True)
class _Measured:
    """Result of one level, arrays of the nodes' shape in pixels of the full images."""

    y_parallax_px: NDArray[np.float64]
    disparity_px: NDArray[np.float64]
    score: NDArray[np.float64]
    ratio: NDArray[np.float64]


def _filled_medians(measured: FloatArray, radius: int) -> NDArray[np.float64]:
    """Medians of what was measured about each node, gaps filled by the smooth field through them."""
    values = local_median(measured, radius)
    smooth = smooth_field(values, np.ones(values.shape), sigma_nodes=1.0)
    return np.where(np.isfinite(values), values, smooth)


def _correlate(
    fore: Patches,
    aft: Patches,
    nodes: PixelGrid,
    expected: tuple[FloatArray, FloatArray],
    factor: int,
    search: tuple[int, int],
    template_px: int,
    threads: int,
) -> _Measured:
    """Correlation of every node at one level, by strips of node rows."""
    per_strip = max(1, int(_STRIP_ROWS / nodes.step_y))
    strips = [slice(r, min(r + per_strip, nodes.shape[0])) for r in range(0, nodes.shape[0], per_strip)]

    def one(strip: slice) -> _Measured:
        part = nodes.window(strip.start, strip.stop, 0, nodes.shape[1])
        guess = (expected[0][strip], expected[1][strip])
        return _correlate_strip(fore, aft, part, guess, factor, search, template_px)

    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(one, strips))
    return _Measured(
        *(
            np.concatenate([getattr(p, name) for p in parts])
            for name in ("y_parallax_px", "disparity_px", "score", "ratio")
        )
    )


def _correlate_strip(
    fore: Patches,
    aft: Patches,
    nodes: PixelGrid,
    expected: tuple[FloatArray, FloatArray],
    factor: int,
    search: tuple[int, int],
    template_px: int,
) -> _Measured:
    """Correlation of the nodes of a strip at one level."""
    result = _Measured(*(np.full(nodes.shape, np.nan) for _ in range(4)))
    usable = np.isfinite(expected[0]) & np.isfinite(expected[1])
    if not usable.any():
        return result
    half = template_px // 2
    centres = nodes.centres()
    # First pixels of templates and of searches, in pixels of the level.
    row = np.rint((centres[..., 1] + 0.5) / factor).astype(int) - half
    column = np.rint((centres[..., 0] + 0.5) / factor).astype(int) - half
    aside_row = np.rint(np.where(usable, expected[0], 0.0) / factor).astype(int)
    aside_column = np.rint(np.where(usable, expected[1], 0.0) / factor).astype(int)
    aft_row, aft_column = row + aside_row - search[0], column + aside_column - search[1]
    aft_shape = (template_px + 2 * search[0], template_px + 2 * search[1])

    templates = fore(row[usable], column[usable], (template_px, template_px), factor)
    searches = aft(aft_row[usable], aft_column[usable], aft_shape, factor)
    lit = (templates == 0).mean(axis=(1, 2)) <= _MOST_BLACK
    surfaces = np.empty((int(lit.sum()), 2 * search[0] + 1, 2 * search[1] + 1), np.float32)
    kernels.correlate(templates[lit], searches[lit], FLAT, surfaces)
    shift, score, ratio = subpixel_peaks(surfaces)
    rows, columns = (index[lit] for index in np.nonzero(usable))
    result.y_parallax_px[rows, columns] = (shift[:, 0] + aside_row[rows, columns]) * factor
    result.disparity_px[rows, columns] = (shift[:, 1] + aside_column[rows, columns]) * factor
    result.score[rows, columns] = score
    result.ratio[rows, columns] = ratio
    return result
