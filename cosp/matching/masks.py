"""Where no control is taken: steep or unstable ground, still water, film without a picture, scratches."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from cosp.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from cosp.geometry.grids import PixelGrid
from cosp.imaging.resampling import sample
from cosp.imaging.windows import Window
from cosp.matching.film_image import FilmImage

# Elevation models hold lakes as level surfaces; no ground is level to this over so many postings.
_LEVEL_M = 0.02
_LEVEL_POSTINGS = 5
# A scratch is narrower than this and runs along the film for at least so far.
_SCRATCH_WIDTH_MM = 0.06
_SCRATCH_LENGTH_MM = 1.0
# Share of its length over which a scratch stands out.
_SCRATCH_SHARE = 0.8


def slope_deg(heights_m: Float32Array, posting_m: float) -> Float32Array:
    """Slope of a height grid, degrees; NaN beside gaps."""
    down, right = gradient(heights_m, posting_m)
    return np.asarray(np.degrees(np.arctan(np.hypot(down, right))), np.float32)


def gradient(heights_m: Float32Array, posting_m: float) -> tuple[Float32Array, Float32Array]:
    """Rise of a height grid per metre down its rows and along them."""
    down, right = np.gradient(heights_m.astype(np.float32), posting_m)
    return np.asarray(down), np.asarray(right)


def still_water(heights_m: Float32Array) -> BoolArray:
    """Pixels of a height grid that lie on a level surface, as elevation models hold lakes and the sea."""
    known = np.isfinite(heights_m)
    kernel = np.ones((_LEVEL_POSTINGS, _LEVEL_POSTINGS), np.uint8)
    filled = np.where(known, heights_m, np.float32(1e9)).astype(np.float32)
    lowest = cv2.erode(filled, kernel)
    highest = cv2.dilate(np.where(known, filled, np.float32(-1e9)), kernel)
    level = (highest - lowest < _LEVEL_M) & (cv2.erode(known.astype(np.uint8), kernel, borderValue=0) > 0)
    # Back to the shore: a level window is water all over.
    return np.asarray(cv2.dilate(level.astype(np.uint8), kernel) > 0)


def at_points(raster: Any, grid: PixelGrid, easting_northing: FloatArray, *, nearest: bool = False) -> FloatArray:
    """Values of a raster at map points (N, 2), between its pixels or of the nearest one; NaN outside."""
    rows, columns = grid.pixels(easting_northing)
    values = sample(
        np.asarray(raster, np.float32), rows, columns, interpolation="nearest" if nearest else "linear", border=np.nan
    )
    return np.asarray(values, float)


def film_faults(
    film: FilmImage, film_mm: FloatArray, *, window_mm: float, white: int, max_share: float, scratch_grey: float
) -> tuple[BoolArray, BoolArray]:
    """Points whose surroundings on the film are overexposed, and points on a scratch, each (N,) bool.

    Nothing is said against points at the very border of the film.

    Parameters
    ----------
    film : FilmImage
    film_mm : (N, 2) array
    window_mm : float
        Side of the surroundings.
    white : int
        Grey value from which a pixel holds no picture.
    max_share : float
        Of such pixels.
    scratch_grey : float
        Contrast of a scratch with both its sides.
    """
    overexposed, scratched = np.zeros(len(film_mm), bool), np.zeros(len(film_mm), bool)
    rows, columns = (np.floor(v + 0.5).astype(np.intp) for v in film.grid.pixels(np.nan_to_num(film_mm)))
    half = max(1, round(window_mm / film.pixel_mm / 2))
    reach = max(half, round(_SCRATCH_LENGTH_MM / film.pixel_mm / 2))
    buffered = film.buffered()
    height, width = film.grid.shape
    for index in np.argsort(columns, kind="stable"):
        row, column = int(rows[index]), int(columns[index])
        inside = half <= row < height - half and reach <= column < width - reach
        if not inside:
            continue
        pixels = buffered.read(Window(row - half, row + half + 1, column - reach, column + reach + 1))
        middle = pixels[:, reach - half : reach + half + 1]
        overexposed[index] = bool((middle >= white).mean() > max_share)
        scratched[index] = is_scratched(pixels, film.pixel_mm, scratch_grey)
    return overexposed, scratched


def is_scratched(pixels: ByteArray, pixel_mm: float, contrast_grey: float) -> bool:
    """Whether a thin line along the rows stands out from both its sides over most of its length."""
    lag = max(1, round(_SCRATCH_WIDTH_MM / pixel_mm))
    if len(pixels) <= 2 * lag:
        return False
    # A scratch may wander by a pixel: what counts is the mean over its width, here three rows.
    grey = cv2.blur(pixels.astype(np.float32), (1, 3) if lag > 2 else (1, 1))
    middle, above, below = grey[lag:-lag], grey[: -2 * lag], grey[2 * lag :]
    for sign in (1, -1):
        stands_out = sign * middle - np.maximum(sign * above, sign * below)
        if ((stands_out > contrast_grey).mean(axis=1) >= _SCRATCH_SHARE).any():
            return True
    return False
