"""Between which disparities a known surface lets each place of an epipolar pair match."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from cosp.arrays import BoolArray, FloatArray
from cosp.epipolar.rectification import Rectification
from cosp.imaging.windows import Window

POSTINGS = 3.0
"""Points of the surface to a node, along and across, so that none is without."""


def disparities_about(
    rectification: Rectification,
    fore: Callable[[FloatArray], FloatArray],
    aft: Callable[[FloatArray], FloatArray],
    lonlat: FloatArray,
    lowest_m: FloatArray,
    highest_m: FloatArray,
    unsure: BoolArray,
    window: Window,
    *,
    margin_m: float,
    least_spacing_px: float,
) -> tuple[FloatArray, FloatArray, float]:
    """Lowest and highest disparity of ground within `margin_m` of a surface, at nodes over a window of the fore image.

    Between nodes they may be taken as bilinear: each node answers for what surrounds it as far as the next.

    Parameters
    ----------
    fore, aft : functions
        Film points (..., 2), mm, of longitudes, latitudes (degrees) and ellipsoidal heights (..., 3).
    lonlat : (H, W, 2) array, degrees
        Places of the surface, on a grid.
    lowest_m, highest_m : (H, W) arrays
        Ellipsoidal heights of the surface about each; NaN where it is not known.
    unsure : (H, W) array
        Where the surface may have changed by more, as glaciers do.
    margin_m : float
        Of height, up and down.
    least_spacing_px : float
        From node to node; more where the surface's grid is coarse.

    Returns
    -------
    lowest, highest : (R, C) arrays, px
        Node (0, 0) lies on the window's first pixel. The whole range of the pair where the surface is not known or not
        sure.
    spacing_px : float
    """
    columns = window.column1 - window.column0
    found = []
    for height_m in (lowest_m - margin_m, highest_m + margin_m):
        ground = np.concatenate([lonlat, height_m[..., None]], axis=-1)
        rows, fore_columns = rectification.fore_epipolar(fore(ground))
        _, aft_columns = rectification.aft_epipolar(aft(ground))
        found.append((rows - window.row0, fore_columns - window.column0, aft_columns - fore_columns))
    down, across, _ = found[0]
    with np.errstate(invalid="ignore"):
        steps = [np.hypot(np.diff(down, axis=axis), np.diff(across, axis=axis)) for axis in (0, 1)]
    known = [step[np.isfinite(step)] for step in steps]
    posting_px = max((float(np.median(step)) for step in known if step.size), default=0.0)
    spacing_px = max(least_spacing_px, POSTINGS * posting_px)
    shape = tuple(int(np.ceil(size / spacing_px)) + 1 for size in (window.row1 - window.row0, columns))
    lowest, highest, doubtful = np.full(shape, np.inf), np.full(shape, -np.inf), np.zeros(shape, bool)
    for down, across, disparity in found:
        with np.errstate(invalid="ignore"):
            i, j = np.rint(down / spacing_px), np.rint(across / spacing_px)
            inside = np.isfinite(disparity) & (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
        i, j, values = i[inside].astype(int), j[inside].astype(int), disparity[inside]
        np.minimum.at(lowest, (i, j), values)
        np.maximum.at(highest, (i, j), values)
        np.logical_or.at(doubtful, (i, j), unsure[inside])
    doubtful |= ~np.isfinite(lowest)
    lowest[doubtful], highest[doubtful] = -np.inf, np.inf
    limits = rectification.disparity_range_px
    return (
        np.clip(minimum_filter(lowest, 3, mode="nearest"), *limits),
        np.clip(maximum_filter(highest, 3, mode="nearest"), *limits),
        spacing_px,
    )
