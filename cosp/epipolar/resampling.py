"""The rectified image itself: one resampling from film to epipolar grid, window by window."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np

from cosp.arrays import ByteArray
from cosp.epipolar.rectification import EpipolarMap
from cosp.geometry.grids import PixelGrid
from cosp.imaging.windows import Window

Kernel = Literal["linear", "cubic", "lanczos"]
_FLAGS = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos": cv2.INTER_LANCZOS4}
# Pixels that the widest kernel (Lanczos, 8 x 8) reaches to either side, and one for rounding.
_HALO_PX = 5


def resample_window(
    read_film: Callable[[Window], ByteArray],
    film_grid: PixelGrid,
    epipolar_map: EpipolarMap,
    window: Window,
    *,
    interpolation: Kernel,
) -> ByteArray:
    """Grey values of a window of the rectified image; 0 outside the film and where the film itself is 0.

    Parameters
    ----------
    read_film : function
        Grey values of a window of the film raster.
    film_grid : PixelGrid
        Of the film raster, mm.
    epipolar_map : EpipolarMap
    window : Window
        Of the rectified image; with what it shows of the film less than 32 767 px a side.
    interpolation : "linear", "cubic" or "lanczos"
    """
    shown = epipolar_map.film_window(window, film_grid)
    if min(shown.shape) <= 0:
        return np.zeros(window.shape, np.uint8)
    shown = shown.grown(_HALO_PX, film_grid.shape)
    rows, columns = epipolar_map.film_pixels(window, film_grid, (shown.row0, shown.column0))
    # Black outside, as the film's own surroundings.
    grey = cv2.remap(read_film(shown), columns, rows, _FLAGS[interpolation], borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(grey, np.uint8)
