"""Shaded relief: what stands in for a reference image where there is none."""

from __future__ import annotations

import numpy as np

from cosp.arrays import Float32Array, FloatArray
from cosp.geometry.grids import PixelGrid
from cosp.matching.ground import OnGrid

# Opposite suns give negatives of one another, which gradient orientation modulo 180 degrees does not tell apart.
SUN_AZIMUTHS_DEG = (0.0, 45.0, 90.0, 135.0)
_SUN_ELEVATION_DEG = 35.0
# What matches with relief are good for, in pixels of the relief, once their neighbours agree: low scores come of ground
# cover that the relief does not hold, which lowers the peak more than it moves it.
_SIGMA_LIMITS_PX = (0.3, 0.5)


def hillshade(heights_m: Float32Array, posting_m: float, azimuth_deg: float) -> Float32Array:
    """Brightness of a north-up height grid under the sun, 0 to 255; NaN beside gaps."""
    north_slope, east_slope = np.gradient(heights_m.astype(np.float32), posting_m)
    azimuth, elevation = np.radians([azimuth_deg, _SUN_ELEVATION_DEG])
    towards_east, towards_north = np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation)
    # Rows run south, so the gradient along rows is minus the slope towards north.
    light = np.sin(elevation) - east_slope * towards_east + north_slope * towards_north
    light /= np.sqrt(1 + north_slope**2 + east_slope**2)
    return np.asarray(255 * np.maximum(light, 0), np.float32)


def relief_reference(heights_on: OnGrid, azimuth_deg: float) -> OnGrid:
    """A reference that is the shaded relief of an elevation model."""

    def on_grid(grid: PixelGrid) -> Float32Array:
        rows, columns = grid.shape
        heights = heights_on(grid.window(-1, rows + 1, -1, columns + 1))
        return hillshade(heights, grid.step_x, azimuth_deg)[1:-1, 1:-1]

    return on_grid


def relief_sigma_m(sigma_m: FloatArray, posting_m: float) -> FloatArray:
    """Standard deviations of matches with shaded relief of a posting, from those that their scores alone say."""
    low, high = _SIGMA_LIMITS_PX
    return np.asarray(np.clip(sigma_m, low * posting_m, high * posting_m))
