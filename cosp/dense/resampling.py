"""The right picture brought onto the left one with what is known so far, and that knowledge made whole and smooth."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from cosp.arrays import ByteArray, Float32Array
from cosp.dense import kernels
from cosp.dense.memory import Workspace
from cosp.geometry.lattices import between_nodes
from cosp.imaging.windows import Window

_log = logging.getLogger(__name__)

CONTEXT_PX = 8
"""What a prior looks at of the level before beyond its window, px of that level."""

_EDGE_REACH_PX = 12  # of a coarse level, that a prior goes on beyond the outermost matches of a row
_EDGE_BASE_PX = 24  # whose slope it takes for that
_STEEPEST = 0.6  # pixels of disparity a pixel: ground that falls away from both cameras


@dataclass(frozen=True)
class SmoothField:
    """A quantity that varies slowly over a picture, given at nodes and bilinear between them.

    values : (nodes down, nodes across) array, finite
    first_row, first_column : pixel of node (0, 0)
    row_step, column_step : pixels from node to node
    """

    values: Float32Array
    first_row: float
    first_column: float
    row_step: float
    column_step: float

    def moved(self, rows: float, columns: float) -> SmoothField:
        """The same field for a picture that begins `rows` and `columns` further on."""
        return SmoothField(
            self.values, self.first_row - rows, self.first_column - columns, self.row_step, self.column_step
        )

    def over(self, window: Window, level: int) -> Float32Array:
        """Values at the pixels of a window of a level of the pyramid, the outermost beyond the nodes."""
        scale = 2**level
        return between_nodes(
            self.values,
            (
                (scale * window.row0 - self.first_row) / self.row_step,
                (scale * window.column0 - self.first_column) / self.column_step,
            ),
            (scale / self.row_step, scale / self.column_step),
            window.shape,
        )


@dataclass(frozen=True)
class StartInterval:
    """Between which disparities a match must lie, px of level 0, as a known surface tells."""

    lowest: SmoothField
    highest: SmoothField

    def over(self, window: Window, level: int) -> tuple[Float32Array, Float32Array]:
        """Lowest and highest disparity at the pixels of a window of a level, in its pixels."""
        scale = np.float32(2.0**-level)
        return self.lowest.over(window, level) * scale, self.highest.over(window, level) * scale


def resample_right(
    right: ByteArray,
    prior: Float32Array,
    first_row: int,
    first_column: int,
    *,
    y_parallax: SmoothField,
    level: int,
    memory: Workspace | None = None,
) -> ByteArray:
    """Right picture as it would look had it no disparity but what `prior` does not know; 0 where it has no data.

    Parameters
    ----------
    right : (rows, columns) array
        Whole right picture at this level of the pyramid.
    prior : (tile rows, tile columns) array, px of this level
        Disparity of the tile whose first pixel is (first_row, first_column) of the left picture.
    y_parallax : SmoothField, px of level 0
        Right row minus left row.
    memory : Workspace
        Where the result lies, which then lasts until it is used for the next.
    """
    scale = 2.0**-level
    lowest, highest = float(y_parallax.values.min()) * scale, float(y_parallax.values.max()) * scale
    window = Window(
        max(int(np.floor(first_row + lowest)) - 2, 0),
        min(int(np.ceil(first_row + prior.shape[0] + highest)) + 2, right.shape[0]),
        max(int(np.floor(first_column + float(prior.min()))) - 2, 0),
        min(int(np.ceil(first_column + prior.shape[1] + float(prior.max()))) + 2, right.shape[1]),
    )
    if window.row1 <= window.row0 or window.column1 <= window.column0:
        return np.zeros(prior.shape, np.uint8)
    place = (
        (first_row / scale - y_parallax.first_row) / y_parallax.row_step,
        (first_column / scale - y_parallax.first_column) / y_parallax.column_step,
        1 / scale / y_parallax.row_step,
        1 / scale / y_parallax.column_step,
    )
    # Linear: as accurate here as cubic, quicker, and what has data never comes out as 0.
    source = np.pad(right[window.slices], kernels.RIM)
    target: ByteArray = (memory or Workspace()).array("resampled", prior.shape, np.uint8)
    resample = _resample() if prior.shape[1] >= kernels.SAMPLE_BLOCK else kernels.resample_plain
    resample(
        source,
        prior,
        y_parallax.values,
        place,
        scale,
        float(first_column - window.column0),
        float(first_row - window.row0),
        target,
    )
    return target


@cache
def _resample() -> Callable[..., None]:
    """The vector form where this machine's compiler takes it, else the plain loops."""
    zeros = np.zeros((1, kernels.SAMPLE_BLOCK), np.float32)
    source = np.zeros((2 * kernels.RIM, 2 * kernels.RIM), np.uint8)
    try:
        kernels.resample_vector(
            source, zeros, zeros[:, :1].copy(), (0.0, 0.0, 1.0, 1.0), 1.0, 0.0, 0.0, zeros.astype(np.uint8)
        )
    except Exception as error:  # whatever the compiler stumbles over, the loops give the same bits
        _log.warning("vector form of the resampling does not compile here, plain loops are used: %s", error)
        return kernels.resample_plain
    return kernels.resample_vector


def picture_pyramid(image: ByteArray, levels: int) -> list[ByteArray]:
    """Picture at full size, half size and so on: pixel i of one level lies on pixel 2 i of the one before.

    What has no data (0) takes no part in the means and stays 0 where it prevails.
    """
    pyramid = [image]
    for _ in range(levels):
        finer = pyramid[-1]
        coarser = np.asarray(cv2.pyrDown(finer), np.uint8)
        if not finer.all():
            seen = cv2.pyrDown(cv2.threshold(finer, 0, 255, cv2.THRESH_BINARY)[1])
            kernels.weigh_means(coarser, seen)
        pyramid.append(coarser)
    return pyramid


def fill_holes(values: Float32Array) -> Float32Array:
    """Values with their holes (NaN) closed smoothly from around, by halving until none is left and doubling again."""
    levels = [values.copy()]
    missing = int(np.isnan(values).sum())
    if missing == values.size:
        raise ValueError("there is no value to fill holes from")
    while missing:
        coarser, missing = kernels.halve(levels[-1])
        levels.append(coarser)
    for finer, coarser in zip(levels[-2::-1], levels[:0:-1], strict=True):
        kernels.fill_from(finer, coarser)
    return levels[0]


def continue_beyond_edges(disparity: Float32Array) -> None:
    """Let the disparity of every row go on beyond its first and last match as it slopes there, in place.

    At film edges the next pass has nothing else to go by. Closed like other holes, from the mean of what is near, it
    would be flat there, and pull matches near the edge inwards. Further out it stays as it is where that reach ends, so
    that left pixels beyond an edge do not fall back on right ones within, and contest them.
    """
    kernels.continue_rows(disparity, _EDGE_REACH_PX, _EDGE_BASE_PX, _STEEPEST)


def median_of_given(disparity: Float32Array) -> Float32Array:
    """5 x 5 median of disparity; holes stay holes."""
    if np.isnan(disparity).all():
        return disparity
    median = np.asarray(cv2.medianBlur(fill_holes(disparity), 5), np.float32)
    median[np.isnan(disparity)] = np.nan
    return median


def prior_of(
    disparity: Float32Array,
    window: Window,
    *,
    finer: bool,
    otherwise: float,
    limits: tuple[float, float] = (-np.inf, np.inf),
    memory: Workspace | None = None,
) -> Float32Array:
    """What a pass knows beforehand in a window: the disparity of the pass before, whole, without outliers and smooth.

    Parameters
    ----------
    disparity : (rows, columns) array, px of its own level
        Whole result of the pass before.
    window : Window
        In pixels of the level to come; may reach beyond the picture, where the outermost values go on.
    finer : bool
        The level to come is the next finer one, so that numbers double too.
    otherwise : float
        What to take where the pass before found nothing at all, in pixels of its level.
    limits : (lowest, highest)
        That no prior exceeds, in pixels of the level to come.
    memory : Workspace
        Where the result lies, which then lasts until it is used for the next.
    """
    ratio = 2 if finer else 1
    around = Window(
        min(max(window.row0 // ratio - CONTEXT_PX, 0), disparity.shape[0] - 1),
        max(min(-(-window.row1 // ratio) + CONTEXT_PX, disparity.shape[0]), 1),
        min(max(window.column0 // ratio - CONTEXT_PX, 0), disparity.shape[1] - 1),
        max(min(-(-window.column1 // ratio) + CONTEXT_PX, disparity.shape[1]), 1),
    )
    known = disparity[around.slices]
    if np.isnan(known).all():
        return np.full(window.shape, otherwise * ratio, np.float32)
    smooth = cv2.GaussianBlur(cv2.medianBlur(fill_holes(known), 5), (0, 0), 1.0)
    np.clip(smooth, limits[0] / ratio, limits[1] / ratio, out=smooth)
    prior: Float32Array = (memory or Workspace()).array("prior", window.shape, np.float32)
    if finer:
        kernels.enlarge(smooth, window.row0 - 2 * around.row0, window.column0 - 2 * around.column0, prior)
        return prior
    rows, columns = (
        np.clip(np.arange(start, stop) - first, 0, size - 1)
        for start, stop, first, size in (
            (window.row0, window.row1, around.row0, smooth.shape[0]),
            (window.column0, window.column1, around.column0, smooth.shape[1]),
        )
    )
    return np.asarray(smooth[rows[:, None], columns], np.float32)
