"""Centres of the rail holes, for assessment: they are known to bend otherwise than the picture and correct nothing."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_laplace, label, maximum_filter

from cosp.arrays import Float32Array, FloatArray


def find_rail_holes(
    band: Float32Array,
    x_mm: FloatArray,
    y_mm: FloatArray,
    *,
    diameter_mm: float,
    spacing_mm: float,
    min_contrast: float,
) -> FloatArray:
    """Centres (N, 2) of bright spots of one row along the film, mm.

    Parameters
    ----------
    band : (rows, columns) float32 array
        Grey values of the film beside the picture.
    x_mm : (columns,) array
    y_mm : (rows,) array
        Both evenly spaced by the same step.
    diameter_mm : float
        Of a hole.
    spacing_mm : float
        From hole to hole.
    min_contrast : float
        Grey levels by which a spot stands out.
    """
    step = float(abs(x_mm[1] - x_mm[0]))
    sigma = diameter_mm / (2 * np.sqrt(2.0) * step)
    blob = -gaussian_laplace(band.astype(np.float64), sigma) * sigma**2
    # Holes come once in every spacing all along the film, letters and scratches do not: the row of most spacings wins.
    radius = max(2, round(diameter_mm / step))
    cell = max(1, round(spacing_mm / step))
    cells = max(1, band.shape[1] // cell)
    tallest = blob[:, : cells * cell].reshape(band.shape[0], cells, -1).max(axis=2)
    common = np.median(maximum_filter(tallest, size=(radius, 1)), axis=1)
    first, last = max(int(common.argmax()) - radius, 0), int(common.argmax()) + radius + 1
    row = blob[first:last]
    reach = int(0.35 * spacing_mm / step) * 2 + 1
    groups, count = label((row == maximum_filter(row, size=(2 * row.shape[0] + 1, reach))) & (row > min_contrast))
    peaks = [np.argwhere(groups == k + 1).mean(axis=0).round().astype(int) + (first, 0) for k in range(count)]
    centres = []
    for r, c in peaks:
        r0, r1, c0, c1 = r - radius, r + radius + 1, c - radius, c + radius + 1
        if r0 < 0 or c0 < 0 or r1 > band.shape[0] or c1 > band.shape[1]:
            continue
        patch = band[r0:r1, c0:c1].astype(np.float64)
        # The centroid of what is above half height, weighted, lies where the disc does.
        weight = np.clip(patch - np.median(np.r_[patch[0], patch[-1], patch[:, 0], patch[:, -1]]), 0.0, None)
        weight = np.where(weight > 0.3 * weight.max(), weight, 0.0)
        rows, columns = np.arange(r0, r1), np.arange(c0, c1)
        centre_r = (weight.sum(axis=1) * rows).sum() / weight.sum()
        centre_c = (weight.sum(axis=0) * columns).sum() / weight.sum()
        centres.append((np.interp(centre_c, np.arange(len(x_mm)), x_mm), y_mm[0] + centre_r * (y_mm[1] - y_mm[0])))
    return np.array(centres).reshape(-1, 2)
