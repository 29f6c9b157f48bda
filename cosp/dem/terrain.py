"""Slope, aspect and where the terrain is stable."""

from __future__ import annotations

import numpy as np

from cosp.arrays import BoolArray, Float32Array, FloatArray


def gradient(heights_m: FloatArray, step_x: float, step_y: float) -> tuple[Float32Array, Float32Array]:
    """Rise per metre along x and along y of the map; NaN beside missing heights.

    Parameters
    ----------
    heights_m : (R, C) array
    step_x, step_y : float, m
        Signed steps per column and per row, as of a PixelGrid.
    """
    heights_m = np.asarray(heights_m, np.float32)
    along_y, along_x = np.gradient(heights_m, step_y, step_x)
    return np.asarray(along_x, np.float32), np.asarray(along_y, np.float32)


def slope_deg(heights_m: FloatArray, step_x: float, step_y: float) -> Float32Array:
    """Steepest slope in degrees, of the grid's shape; NaN beside missing heights."""
    along_x, along_y = gradient(heights_m, step_x, step_y)
    return np.degrees(np.arctan(np.hypot(along_x, along_y))).astype(np.float32)


def aspect_deg(heights_m: FloatArray, step_x: float, step_y: float) -> Float32Array:
    """Direction of steepest descent, degrees clockwise from the map's north; of no meaning where it is flat."""
    along_x, along_y = gradient(heights_m, step_x, step_y)
    return np.mod(np.degrees(np.arctan2(-along_x, -along_y)), 360).astype(np.float32)


def stable_terrain(slope: FloatArray, unstable: BoolArray | None, *, slope_limit_deg: float) -> BoolArray:
    """Cells that should not have changed and can be measured: outside unstable terrain, of known and moderate slope.

    Parameters
    ----------
    slope : (R, C) array, degrees
        Of the reference model; NaN is not stable.
    unstable : (R, C) boolean array or None
        Glaciers, lakes, slides; None for none known.
    slope_limit_deg : float
    """
    with np.errstate(invalid="ignore"):
        stable = np.asarray(slope <= slope_limit_deg)
    return stable if unstable is None else stable & ~unstable
